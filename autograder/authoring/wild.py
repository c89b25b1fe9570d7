"""What libraries compute, as the atlas has recorded it (experiments/atlas/records): for checks that say whose rule an answer follows.

A check reads it when it is made, so that what learners get has the names of the records that lay there then, and never an older one's.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any

from experiments.atlas import keeping

_Found = tuple[Mapping[str, Any], Mapping[str, Any]]


def also(rule: str, *formulas: str, what: str = "this is") -> str:
    """A sentence for the end of a message: which libraries compute one of these formulas by this rule ("": as the course does).

    Those that do so by themselves; if there are none, those that do in some setting, which it says. Rows with a note are left out: they
    are true with a reservation. Empty if no library is left.
    """
    found = [(record, row) for record, row in _rows(*formulas) if _rule(row) == rule and not row["note"]]
    always = [one for one in found if _by_itself(*one)]
    names = list(dict.fromkeys(_name(record, "" if always else row["setting"]) for record, row in always or found))
    if not names:
        return ""
    listed = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    return f" In the wild, {what} the rule of {listed}."


@functools.cache
def _records() -> Mapping[str, Mapping[str, Any]]:
    return keeping.load_all()


def _rows(*formulas: str) -> Iterator[_Found]:
    for record in _records().values():
        yield from ((record, row) for row in record["rows"] if row["formula"] in formulas)


def _rule(row: Mapping[str, Any]) -> str | None:
    """None: a rule that nobody knows."""
    return "" if row["equal"] else row["rule"] or None


def _by_itself(record: Mapping[str, Any], row: Mapping[str, Any]) -> bool:
    """Whether nobody has to set anything for it: it is the default, or the library has no other way."""
    if not row["setting"] or "default" in row["setting"]:
        return True
    return "=" not in row["setting"] and sum(other["formula"] == row["formula"] for other in record["rows"]) == 1


def _name(record: Mapping[str, Any], setting: str) -> str:
    name = " ".join(f"{package} {version}" for package, version in record["versions"].items())
    return f"{name} ({setting})" if setting else name
