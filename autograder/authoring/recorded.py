"""Numbers of the atlas for checks: what libraries computed (experiments/atlas/records), and the one input that all of them were given.

Beside `wild`, which names the libraries: checks that only name them need neither the input nor what it is made with.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import torch

from experiments.atlas import keeping
from experiments.atlas.given import GIVEN


def numbers(library: str, formula: str, rule: str = "") -> torch.Tensor:
    """What a library computed by this rule ("": as the course does), in double precision.

    Raises: LookupError if its record has no such row.
    """
    for record in _records().values():
        for row in record["rows"] if library in record["versions"] else ():
            if (row["formula"], row["rule"], row["equal"]) == (formula, rule, not rule):
                return torch.tensor(row["numbers"], dtype=torch.float64)
    raise LookupError(f"the atlas has no row of {library} on {formula} by the rule {rule!r}")


def given(name: str) -> torch.Tensor:
    """A part of the input that all libraries were given: floats in double precision, masks as bool."""
    value = torch.tensor(GIVEN[name], dtype=torch.float64)
    return value.bool() if name in ("terminated", "truncated", "mask") else value


@functools.cache
def _records() -> Mapping[str, Mapping[str, Any]]:
    return keeping.load_all()
