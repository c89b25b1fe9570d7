"""Learners' notebooks without anything active, for the teacher's browser.

A teacher reads submissions in formgrader and in feedback, pages with the right to change grades. Whatever a learner wrote is shown there as
text: no markup, link, script or active TeX command begins in it, and of outputs only text and base64 pictures are left.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from nbformat import NotebookNode
from nbformat.v4 import new_output

# What Markdown or MathJax would turn into markup: a tag, a link (nbconvert lets javascript: links pass), an active TeX command.
_ACTIVE = re.compile(r"<(?=[A-Za-z/!?])|\](?=[(:\[])|\\(?=href|require|style|class|cssId)")
_BASE64 = re.compile(r"[A-Za-z0-9+/=\s]*")
_OUTPUT_CHARACTERS = 10_000


def text(markdown: str) -> str:
    """The same text with a space wherever something active would begin; lone surrogates, which no file can hold, become "?"."""
    return _ACTIVE.sub(lambda match: match[0] + " ", markdown).encode(errors="replace").decode()


def cell(theirs: NotebookNode, untouched: Mapping[str, NotebookNode]) -> NotebookNode:
    """A fresh cell with the same text, of which nothing is active. `untouched` has the cells that were handed out, by their texts: what a
    chapter's author wrote may have links and pictures. It has no id, and nbformat's check of it is left to the notebook's."""
    metadata = NotebookNode(theirs.metadata)
    original: Mapping[str, Any] = untouched.get(theirs.source, {})
    if theirs.cell_type == "code":
        outputs = [kept for output in theirs.get("outputs", []) if (kept := _output(output))]
        return NotebookNode(cell_type="code", execution_count=None, source=theirs.source, outputs=outputs, metadata=metadata)
    source = theirs.source if original else text(theirs.source)
    if theirs.cell_type == "markdown":
        pictures = {"attachments": original["attachments"]} if "attachments" in original else {}
        return NotebookNode(cell_type="markdown", source=source, metadata=metadata, **pictures)
    return NotebookNode(cell_type="raw", source=source, metadata=metadata)


def _output(output: NotebookNode) -> NotebookNode | None:
    if output.output_type == "stream":
        return new_output("stream", name=output.name, text=output.text[:_OUTPUT_CHARACTERS])
    if output.output_type == "error":
        traceback = "\n".join(output.traceback)[:_OUTPUT_CHARACTERS]
        return new_output("error", ename=output.ename, evalue=output.evalue, traceback=[traceback])
    data = output.get("data", {})
    kept = {kind: data[kind] for kind in ("image/png", "image/jpeg") if _BASE64.fullmatch(data.get(kind, "-"))}
    if "text/plain" in data:
        kept["text/plain"] = data["text/plain"][:_OUTPUT_CHARACTERS]
    return new_output("display_data", data=kept) if kept else None
