"""What names mean: which file could be an assignment's notebook, which folder an assignment's, and what nobody has handed in."""

from __future__ import annotations

import hashlib
import os
import re
import unicodedata
from collections.abc import Iterable

from autograder.grading.verdicts import clean_text, plain_name

EXACT, NAMED, OTHER = range(3)  # how sure it is that a file is the notebook: by its name, by a part of it, by being one at all

_NOTEBOOK = re.compile(r"(?P<stem>.+?)(?:\.ipynb)+(?:[._ -]?(?:json|txt|ipynb|download|copy|\(?\d+\)?))*", re.DOTALL)
_JUNK = {"__macosx", "__pycache__", "thumbs.db", "desktop.ini"}
_JUNK_FOLDERS = {"node_modules", "site-packages", "lightning_logs", "mlruns", "wandb", "tensorboard"}


def is_junk(name: str) -> bool:
    """What operating systems, editors and Python leave beside anybody's work; and what is hidden."""
    return name.startswith((".", "~$")) or name.casefold() in _JUNK


def is_junk_file(name: str) -> bool:
    """What operating systems write beside files."""
    return name.startswith("._") or name in (".DS_Store", "Thumbs.db", "desktop.ini")


def is_junk_folder(path: str) -> bool:
    """A folder that a working directory has and no notebook reads: packages, environments, logs of runs."""
    name = os.path.basename(path).casefold()
    return is_junk(name) or name in _JUNK_FOLDERS or os.path.lexists(os.path.join(path, "pyvenv.cfg"))


def label(name: str) -> str:
    """The name, in Unicode's composed form, or, if it cannot name a file of ours, what can be read of it and a hash of it."""
    name = unicodedata.normalize("NFC", name)
    try:
        return plain_name(name)
    except ValueError:
        readable = "".join(one if one.isprintable() and one not in "/\\" else "_" for one in clean_text(name, 100)).lstrip(".")
        return f"{readable or 'unnamed'}-{hashlib.sha256(name.encode(errors='surrogatepass')).hexdigest()[:8]}"


def notebook_rank(name: str, assignment: str) -> int | None:
    """How well a file's name says that it is the notebook of `assignment`: EXACT, NAMED, OTHER; None for no notebook at all."""
    if name == f"{assignment}.ipynb":
        return EXACT
    plain = unicodedata.normalize("NFKC", name).casefold().strip()
    notebook = _NOTEBOOK.fullmatch(plain)
    if is_junk(name):
        return None
    if notebook is None:  # a browser's name for it; any other JSON is data
        return NAMED if plain.endswith(".json") and folder_for(plain.removesuffix(".json"), [assignment]) else None
    if notebook["stem"].endswith("-checkpoint"):
        return None
    return NAMED if _mentions(notebook["stem"], assignment) else OTHER


def assignment_of(name: str, assignments: Iterable[str]) -> str:
    """The assignment that a folder or file of this name seems to be meant for, "" for none or several."""
    plain = unicodedata.normalize("NFKC", name).casefold()
    found = [assignment for assignment in assignments if _mentions(plain, assignment)]
    return found[0] if len(found) == 1 else ""


def folder_for(name: str, assignments: Iterable[str]) -> str:
    """The assignment whose folder this is: by its name, or by a name that a system or a person makes of it; else ""."""
    plain = unicodedata.normalize("NFKC", name).casefold().strip(" .\u200b")
    for assignment in assignments:
        if re.fullmatch(rf"{_COPY}{re.escape(assignment.casefold())}{_AGAIN}", plain):
            return assignment
    return ""


_COPY = r"(?:(?:copy of|kopie von|copie de|copia de|kopia|cópia de|copia di|kopi av) )?"
_AGAIN = r"(?:[ _-]*\(\d+\)|[ _-]+(?:\d|copy|kopie|copie|copia|kopia|cópia)(?:[ _-]*\(?\d+\)?)?)?"


def _mentions(text: str, assignment: str) -> bool:
    return bool(re.search(rf"(?<![a-z0-9]){re.escape(assignment.casefold())}(?![0-9a-z])", text.replace("_", " ")))
