"""Bytes → notebook: whatever encoding and version they have, without outputs, and never an exception but BadNotebook.

Outputs, attachments and the state of widgets are cut out before anything is parsed: a video in them costs a pass over the bytes and no
memory. What is left is bounded in bytes, brackets and depth, so that no document, however hostile, costs the grader more.
"""

from __future__ import annotations

import codecs
import json
import re
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import nbformat

MAX_RAW = 200 << 20
"""Bytes of a notebook with its outputs."""
MAX_NOTEBOOK = 20 << 20
"""Bytes of what is left without them."""
MAX_CELLS = 2000
MAX_TOKENS = 1_000_000
"""Brackets, braces and keys of what is left."""
MAX_SKIPPED = 3_000_000
"""Brackets and braces of what is cut out."""
MAX_DEPTH = 100
UNREAD = {b'"outputs"', b'"attachments"', b'"widgets"'}
LARGE = 20 << 20
OTHER_LANGUAGES = frozenset(
    ("r", "julia", "octave", "matlab", "scala", "javascript", "java", "c++", "c#", "sql", "bash", "sas", "ruby", "rust")
)

# possessive throughout: a string of a hundred megabytes is passed without a stack
_STRING = rb'"[^"\\]*+(?:\\.[^"\\]*+)*+"'
_TOKEN = re.compile(  # the lines of a list in one piece; a string with its colon, if it is a key
    rb"(?P<lines>(?:" + _STRING + rb"\s*+,\s*+)++)|(?P<string>" + _STRING + rb')(?P<key>\s*+:)?|[\[\]{}"]', re.DOTALL
)
_BRACKET = re.compile(rb'[^"\[\]{}]*+(?:' + _STRING + rb'[^"\[\]{}]*+)*+([\[\]{}])', re.DOTALL)
_BLANK = re.compile(rb"\s*+")
_one_large_file_at_a_time = threading.Lock()


class BadNotebook(ValueError):
    """The notebook cannot be read; the message says why, to the learner."""


@dataclass
class Read:
    """A notebook and what had to be said of it."""

    notebook: nbformat.NotebookNode
    flags: list[str] = field(default_factory=list)


def read(content: bytes) -> Read:
    """The notebook in these bytes, as nbformat 4 without outputs. Raises BadNotebook for anything else, whatever it is."""
    if len(content) <= LARGE:
        return _read(content)
    with _one_large_file_at_a_time:
        return _read(content)


def _read(content: bytes) -> Read:
    if complaint := other_kind(content):
        raise BadNotebook(complaint)
    text = _utf8(content)
    try:
        document = json.loads(_without_outputs(text))
        return _converted(document)
    except BadNotebook:
        raise
    except json.JSONDecodeError as error:
        raise BadNotebook(not_json(text, error.lineno)) from None
    except Exception as error:  # a hostile document may break any converter in any way
        raise BadNotebook(f"The notebook is malformed ({type(error).__name__}). Open and save it in Jupyter.") from None


# ---------------------------------------------------------------------------------------------------------------- what else it is

_MAGIC = (
    (b"%PDF-", "is a PDF"),
    (b"\x89PNG", "is a picture"),
    (b"\xff\xd8\xff", "is a picture"),
    (b"GIF8", "is a picture"),
    (b"{\\rtf", "is a word processor's file (RTF)"),
    (b"\xd0\xcf\x11\xe0", "is a file of an old word processor"),
    (b"\x1f\x8b", "is a compressed archive (gzip)"),
    (b"7z\xbc\xaf'\x1c", "is a compressed archive (7z)"),
    (b"Rar!", "is a compressed archive (RAR)"),
    (b"\x00\x05\x16\x07", "is what macOS keeps beside a file (._NAME), not the file"),
)
_NOTEBOOK_WANTED = "Hand in the notebook itself, an .ipynb file"
_CONFLICT = re.compile(rb"^[ \t]*(?:<{7}|>{7})(?: |$)", re.MULTILINE)
_PYTHON = re.compile(rb"^(?:from [\w.]+ import |import \w|def \w+\(|class \w+[(:]|# ?%%|@\w)", re.MULTILINE)


def other_kind(content: bytes) -> str:
    """A sentence that says what these bytes are, and what to do, if they are plainly something else than a notebook; else ""."""
    head = content[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    lower = head[:2048].lower()
    if not content:
        return f"The file is empty (0 bytes): saving, the download or the upload failed. {_NOTEBOOK_WANTED}, and look at its size first."
    if not head and not content[: 1 << 20].strip(b"\xef\xbb\xbf \t\r\n"):
        return f"The file holds nothing but blanks. {_NOTEBOOK_WANTED}, and look at its size first."
    if not content[:4096].strip(b"\0"):
        return f"The file holds nothing but zero bytes, as after a full disk or an interrupted copy. {_NOTEBOOK_WANTED}."
    for magic, kind in _MAGIC:
        if content.startswith(magic):
            return f"The file {kind}, not a notebook. {_NOTEBOOK_WANTED}."
    if content.startswith(b"PK\x03\x04"):
        kind = "a Word file" if b"word/" in content else "a zip archive or an office document"
        return f"The file is {kind}, not a notebook. {_NOTEBOOK_WANTED}."
    if lower.startswith((b"<!doctype html", b"<html", b"<head", b"<?xml", b"<svg")) or (
        lower[:1] == b"<" and b"<html" in lower[:500]
    ):
        return (
            "The file is a web page (HTML), not the notebook: the browser saved the page that shows it, or it was exported as HTML. "
            "Download the notebook itself (File > Download in Jupyter, File > Download > Download .ipynb in Colab, the raw file on GitHub)."
        )
    if head.startswith(b"version https://git-lfs.github.com/"):
        return "The file is a pointer of Git LFS, not the notebook: run `git lfs pull`, then hand in the notebook."
    if lower[:1] != b"{" and _PYTHON.search(content[: 1 << 20]) and b"\0" not in content[:4096]:
        return f"The file is a Python script, not a notebook. {_NOTEBOOK_WANTED} (in Jupyter and Colab: File > Download)."
    return ""


def not_json(content: bytes, line: int) -> str:
    """What to say of text that begins like a notebook and is none."""
    if mark := _CONFLICT.search(content):
        where = content.count(b"\n", 0, mark.start()) + 1
        return (
            f"The notebook holds Git's marks of an unresolved merge conflict (line {where}). Choose one side of each (`nbdime` "
            "shows them), open the notebook once, and hand it in again."
        )
    if not content.lstrip().startswith(b"{"):
        return f"The file is not a notebook: a notebook is JSON and begins with a brace. {_NOTEBOOK_WANTED}."
    if not content.rstrip().endswith(b"}"):
        return f"The notebook ends in the middle (after line {line}): it is truncated. Save it again and hand it in again."
    return f"The notebook is not valid JSON (line {line}): it may be truncated or edited by hand. Save it again in Jupyter."


# ---------------------------------------------------------------------------------------------------------------- text

_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),  # before UTF-16's, with which it begins
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def _utf8(content: bytes) -> bytes:
    """The same text in UTF-8 without a byte-order mark. UTF-16 and UTF-32 are known by their marks, or by where their zeros stand."""
    if content.startswith(codecs.BOM_UTF8):
        return _checked(content[3:])
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), "")
    if not encoding and b"\0" in content[:4]:
        zeros = "".join(".0"[byte == 0] for byte in content[:4])
        encoding = {".0.0": "utf-16-le", "0.0.": "utf-16-be", ".000": "utf-32-le", "000.": "utf-32-be"}.get(zeros, "")
    if not encoding:
        return _checked(content)
    try:
        text = content.decode(encoding).encode("utf-8", "surrogatepass")
    except UnicodeDecodeError:
        raise BadNotebook(
            f"The notebook begins as {encoding.upper()} text and does not go on so. Save it again as UTF-8."
        ) from None
    if complaint := other_kind(text):
        raise BadNotebook(complaint)
    return text


def _checked(content: bytes) -> bytes:
    decoder = codecs.getincrementaldecoder("utf-8")()
    view, size = memoryview(content), 1 << 20
    for start in range(0, len(content), size):
        try:
            decoder.decode(view[start : start + size], start + size >= len(content))
        except UnicodeDecodeError as error:
            line = content.count(b"\n", 0, start) + error.object[: error.start].count(b"\n") + 1
            hint = ", as in Latin-1 or Windows-1252" if content.lstrip()[:1] == b"{" else ""
            raise BadNotebook(
                f"The notebook is not UTF-8 text (byte 0x{error.object[error.start]:02X} in line {line}{hint}). Save it again as UTF-8."
            ) from None
    return content


# ---------------------------------------------------------------------------------------------------------------- outputs


def _without_outputs(text: bytes) -> bytes:
    """The same JSON with `null` for the values of UNREAD, within all limits. What is no JSON stays as it is, for the parser to refuse."""
    kept: list[bytes] = []
    start = position = depth = tokens = size = 0
    while token := _TOKEN.search(text, position):
        tokens += 1
        position = token.end()
        if token["lines"] is not None:
            pass
        elif token["string"] is None:
            if token[0] == b'"':  # a string without an end
                break
            depth += 1 if token[0] in b"[{" else -1
            if depth > MAX_DEPTH:
                raise BadNotebook(f"The notebook is malformed: brackets more than {MAX_DEPTH} deep. Open and save it in Jupyter.")
        elif token["key"] and token["string"] in UNREAD:
            end = _value_end(text, position)
            if end < 0:
                raise BadNotebook(not_json(text, text.count(b"\n", 0, position) + 1))
            if end:
                kept += [text[start:position], b"null"]
                size += position - start + 4
                start = position = end
        if tokens > MAX_TOKENS or size + position - start > MAX_NOTEBOOK:
            raise _too_large()
    if size + len(text) - start > MAX_NOTEBOOK:
        raise _too_large()
    return b"".join((*kept, text[start:])) if kept else text


def _too_large() -> BadNotebook:
    return BadNotebook(
        f"The notebook is larger than {MAX_NOTEBOOK >> 20} MB without its outputs: take embedded data out of its cells and save it again."
    )


def _value_end(text: bytes, position: int) -> int:
    """Where the array or object that begins at `position` ends; -1 if it has no end, 0 if something else begins there."""
    begin = _BLANK.match(text, position).end()  # type: ignore[union-attr]
    if text[begin : begin + 1] not in (b"[", b"{"):
        return 0
    depth, position = 1, begin + 1
    for _ in range(MAX_SKIPPED):
        bracket = _BRACKET.match(text, position)
        if bracket is None:
            return -1
        position = bracket.end()
        depth += 1 if bracket[1] in b"[{" else -1
        if depth == 0:
            return position
    raise BadNotebook("The notebook's outputs are malformed: clear them and save it again.")


# ---------------------------------------------------------------------------------------------------------------- versions and cells


def _converted(document: Any) -> Read:
    if not isinstance(document, dict):
        raise BadNotebook("The file is JSON but no notebook.")
    version = document.get("nbformat", 4)
    if isinstance(version, int) and version > 4:
        raise BadNotebook(f"The notebook is of nbformat {version}, newer than the 4 that is graded. Save it as nbformat 4.")
    old = version < 4
    if old:
        document = _upgraded(document, version)
    entries = document.get("cells")
    if not isinstance(entries, list):
        raise BadNotebook(f"The file is JSON but no notebook: it has no list of cells. {_NOTEBOOK_WANTED}.")
    if len(entries) > MAX_CELLS:
        raise BadNotebook(f"The notebook has {len(entries)} cells; at most {MAX_CELLS} are graded.")
    cells = [made for entry in entries if (made := _cell(entry, old))]
    flags = []
    if len(cells) < len(entries):
        if not cells:
            raise BadNotebook(
                "The notebook is malformed: none of its cells has a type and a source. Open and save it in Jupyter."
            )
        flags.append(f"ignored_cells: {len(entries) - len(cells)} of {len(entries)} have no type or source")
    if language := _language(document.get("metadata")):
        flags.append(f"other_kernel: {language}; its cells were run as Python")
    plain = {"nbformat": 4, "nbformat_minor": 5, "metadata": _version(document.get("metadata")), "cells": cells}
    return Read(nbformat.from_dict(plain), flags)


def _version(metadata: Any) -> dict[str, Any]:
    """Of the notebook's metadata, the version of Python that saved it, if it looks like one; it is only named, in a message."""
    with suppress(AttributeError, KeyError, TypeError):
        version = metadata["language_info"]["version"]
        if re.fullmatch(r"\d\.\d{1,3}(\.\d{1,3})?[a-z\d+]{0,6}", version):
            return {"language_info": {"name": "python", "version": version}}
    return {}


def _upgraded(document: dict[str, Any], version: int) -> dict[str, Any]:
    """A document of nbformat 1 to 3 as one of 4, its texts joined first, as nbformat's own reader does it."""
    for sheet in document.get("worksheets") or [document]:
        for cell in sheet.get("cells") or []:
            if isinstance(cell, dict):
                cell.pop("outputs", None)
                for key in ("input", "source"):
                    if isinstance(cell.get(key), list):
                        whole = any(line.endswith("\n") for line in cell[key][:-1])  # nbformat 2 splits without line ends
                        cell[key] = ("" if whole else "\n").join(cell[key])
                if cell.get("cell_type") == "code":
                    cell.update(outputs=[], input=cell.get("input") or "", language="python")
    return nbformat.convert(nbformat.from_dict(document), 4)


def _cell(cell: Any, old: bool) -> dict[str, Any] | None:
    """A cell's type, source and metadata; outputs are never looked at. None for what has no type or source."""
    if not isinstance(cell, dict) or not isinstance(cell.get("cell_type"), str):
        return None
    source = cell.get("source", cell.get("input"))
    if isinstance(source, list) and all(isinstance(line, str) for line in source):
        source = "".join(source)
    if not isinstance(source, str):
        return None
    kind = cell["cell_type"] if cell["cell_type"] in ("code", "markdown", "raw") else "raw"
    metadata = cell.get("metadata")
    kept = {key: metadata[key] for key in ("nbgrader", "tags") if key in metadata} if isinstance(metadata, dict) else {}
    plain: dict[str, Any] = {"cell_type": kind, "source": source, "metadata": kept}
    if not isinstance(plain["metadata"].get("nbgrader", {}), dict):
        del plain["metadata"]["nbgrader"]
    if isinstance(cell.get("id"), str) and not old:  # an id that the conversion has drawn says nothing
        plain["id"] = cell["id"]
    return plain | ({"outputs": [], "execution_count": None} if kind == "code" else {})


def _language(metadata: Any) -> str:
    """The language of the notebook's kernel, if it is a well-known one other than Python."""
    if not isinstance(metadata, dict):
        return ""
    named = [metadata.get(part) for part in ("kernelspec", "language_info")]
    names = [part.get(key) for part in named if isinstance(part, dict) for key in ("language", "name")]
    return next((name for name in names if isinstance(name, str) and name.lower() in OTHER_LANGUAGES), "")
