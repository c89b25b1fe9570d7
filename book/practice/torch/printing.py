"""How tensors show themselves: with four decimals, or fewer if they are whole, or in powers of ten if they are very unlike."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

LINE = 80


def shown(entries: Sequence[Any], nested: Any, shape: Sequence[int], indent: int) -> str:
    """The nested lists of a tensor's entries, as torch prints them; `indent` is what stands before."""
    entry, width = _style(entries)
    return _lines(nested, len(shape), entry, width, indent)


def _style(entries: Sequence[Any]) -> tuple[Callable[[Any], str], int]:
    """How a single entry is written, and how wide all of them are."""
    if not entries or not isinstance(entries[0], float):
        return str, max((len(str(value)) for value in entries), default=1)
    sizes = [abs(value) for value in entries if math.isfinite(value) and value]
    uneven = bool(sizes) and (max(sizes) / min(sizes) > 1000 or max(sizes) > 1e8)
    if all(size == math.ceil(size) for size in sizes):
        style = "{:.4e}" if uneven else "{:.0f}."
    else:
        style = "{:.4e}" if uneven or min(sizes) < 1e-4 else "{:.4f}"

    def entry(value: float) -> str:
        return style.format(value) if math.isfinite(value) else str(value)

    return entry, max((len(entry(value)) for value in entries if math.isfinite(value) and value), default=1)


def _lines(nested: Any, axes: int, entry: Callable[[Any], str], width: int, indent: int) -> str:
    if not axes:
        return entry(nested)
    if axes == 1:
        fit = max(1, (LINE - indent) // (width + 2))
        words = [entry(value).rjust(width) for value in nested]
        rows = [", ".join(words[i : i + fit]) for i in range(0, len(words), fit)]
        return "[" + (",\n" + " " * (indent + 1)).join(rows) + "]"
    between = "," + "\n" * (axes - 1) + " " * (indent + 1)
    return "[" + between.join(_lines(part, axes - 1, entry, width, indent + 1) for part in nested) + "]"
