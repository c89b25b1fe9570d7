"""Is a library's number the course's, and if not, which known rule makes it? Pure functions of plain lists."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.atlas.given import TOLERANCE, Formula


def flat(numbers: Any) -> list[float]:
    """All numbers of nested lists, in order."""
    return [one for part in numbers for one in flat(part)] if isinstance(numbers, Sequence) else [float(numbers)]


def same(numbers: Any, others: Any, tolerance: float = TOLERANCE) -> bool:
    """Whether as many numbers differ by no more than the tolerance, times the largest of them where that is above 1."""
    left, right = flat(numbers), flat(others)
    if len(left) != len(right) or not all(map(math.isfinite, left)):
        return False
    scale = max([1.0, *map(abs, right)])
    return all(abs(a - b) <= tolerance * scale for a, b in zip(left, right, strict=True))


def judged(row: Mapping[str, Any], formulas: Mapping[str, Formula]) -> dict[str, Any]:
    """A row as a script printed it, with the course's numbers, whether they are equal, and the rule that explains them if not.

    Raises: ValueError if the row names no formula, or has other parts than it should.
    """
    if not isinstance(row, Mapping) or row.get("formula") not in formulas:
        raise ValueError(f"no formula of this name: {row.get('formula') if isinstance(row, Mapping) else row!r}")
    if missing := [part for part in ("numbers", "call", "source") if part not in row]:
        raise ValueError(f"the row on {row['formula']} lacks {', '.join(missing)}")
    formula, tolerance = formulas[row["formula"]], row.get("tolerance", TOLERANCE)
    equal = same(row["numbers"], formula.ours, tolerance)
    fitting = [] if equal else [rule for rule in formula.rules if same(row["numbers"], rule.numbers, tolerance)]
    return {
        "formula": formula.name,
        "setting": row.get("setting", ""),
        "numbers": _rounded(row["numbers"]),
        "ours": _rounded(formula.ours),
        "equal": equal,
        "tolerance": tolerance,
        "rule": fitting[0].name if fitting else "",
        "call": row["call"],
        "source": row["source"],
        "note": row.get("note", ""),
    }


def _rounded(numbers: Any) -> Any:
    """To nine digits: single precision has seven."""
    return [_rounded(one) for one in numbers] if isinstance(numbers, Sequence) else float(f"{numbers:.9g}") + 0.0


def unexplained(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The rows that are neither equal nor made by a known rule."""
    return [
        f"{row['formula']} ({row['setting']})" if row["setting"] else row["formula"]
        for row in rows
        if not (row["equal"] or row["rule"])
    ]


def changes(former: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """What differs between two records of a library, a line each: rows that came, went, or give another verdict or other numbers."""
    before, after = ({(row["formula"], row["setting"]): row for row in record["rows"]} for record in (former, new))
    lines = []
    for key in [*before, *(key for key in after if key not in before)]:
        name = f"{key[0]} ({key[1]})" if key[1] else key[0]
        if key not in after:
            lines.append(f"{name}: gone")
        elif key not in before:
            lines.append(f"{name}: new, {_verdict(after[key])}")
        elif _verdict(before[key]) != _verdict(after[key]):
            lines.append(f"{name}: was {_verdict(before[key])}, is {_verdict(after[key])}")
        elif not same(after[key]["numbers"], before[key]["numbers"], after[key]["tolerance"]):
            lines.append(f"{name}: other numbers, {_verdict(after[key])}")
    return lines


def _verdict(row: Mapping[str, Any]) -> str:
    return "equal" if row["equal"] else row["rule"] or "not equal, by no known rule"
