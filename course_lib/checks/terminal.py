"""Print to whatever standard output there is: where it is not UTF-8 (Windows, a redirected one), in plain letters."""

from __future__ import annotations

import codecs
import sys
import unicodedata

PLAIN = {
    "✓": "ok",
    "✗": "x",
    "…": "...",
    "“": '"',
    "”": '"',
    "‘": "'",
    "’": "'",
    "–": "-",
    "—": "-",
    "−": "-",
    "×": "x",
    "→": "->",
}


def plainly(error: UnicodeError) -> tuple[str, int]:
    """What stands for the characters that an encoding has not.

    >>> codecs.register_error("plainly", plainly)
    >>> "✓ “Zoë” é ≤".encode("ascii", "plainly")
    b'ok "Zoe" e ?'
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = [PLAIN.get(one) or _without_accents(one) for one in error.object[error.start : error.end]]
    return "".join(letters), error.end


def _without_accents(character: str) -> str:
    return unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode() or "?"


def print_anything() -> None:
    """From now on, no character that is printed raises an exception."""
    codecs.register_error("plainly", plainly)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="plainly")
