"""The data of a check: what goes into an exercise's function and what was observed to come out of it.

Everything here is plain data (strings, numbers, tensors), so that it can be frozen into a file for learners, sent to a sandbox, and
put into a page; course_lib.checks.stored does the first two.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch

FACETS = ("values", "gradient", "dtype", "inputs", "errors")
"""What a check looks at: returned values and shapes; gradients and graphs; dtypes; untouched inputs; errors on bad input."""

FACET_TEXT = {
    "values": "returns the right values",
    "gradient": "passes gradient exactly where it should",
    "dtype": "keeps the dtype of its inputs",
    "inputs": "leaves its inputs unchanged",
    "errors": "refuses bad input with a ValueError",
}


def built(maker: str, **arguments: Any) -> dict[str, Any]:
    """An argument that is made anew for each call, where the function runs: `built("seeding.generator", seed=5)`.

    Args:
      maker: a public class or function of course_lib, as "module.name".
      arguments: what it is called with; plain data, tensors, or `built` again.
    """
    return {"@built": maker, "arguments": arguments}


@dataclass
class Observation:
    """What one call of a function did.

    `error` is the name of the exception it raised ("" if it returned) and `message` its text. `kind` says what came back
    ("tensor", "tuple of 2", or the name of another type); `outputs` holds its tensors and numbers: key "" for a single one, the
    path to it otherwise ("0", "1.entropy"). `graph` names the outputs that carry a graph, `gradients` has the gradient of each
    differentiated argument (None: no gradient reaches it), `mutated` names the arguments that the call changed.
    """

    error: str = ""
    message: str = ""
    kind: str = ""
    outputs: dict[str, torch.Tensor] = field(default_factory=dict)
    graph: list[str] = field(default_factory=list)
    gradients: dict[str, torch.Tensor | None] = field(default_factory=dict)
    mutated: list[str] = field(default_factory=list)


@dataclass
class FrozenCase:
    """One call: its arguments, every observation that counts as right, and what each misconception would show.

    `differentiate` names the arguments that require gradient. The function is called `repeat` times; if `returns` names arguments,
    what these hold afterwards is looked at, and not what the function returned. `view` is the name of a function of course_lib.checks.views
    through which all outputs are seen. `facet` is what an unexpected exception costs. Where the call must raise, `raises` has the
    argument names of which the ValueError must mention one.
    """

    name: str
    arguments: dict[str, Any]
    expected: list[Observation]
    misconceptions: dict[str, Observation] = field(default_factory=dict)
    differentiate: list[str] = field(default_factory=list)
    repeat: int = 1
    returns: list[str] = field(default_factory=list)
    view: str = ""
    raises: list[str] = field(default_factory=list)
    facet: str = "values"
    visible: bool = True
    rtol: float = 1e-5  # loose enough for a style as common as `gamma * ~ended`, which PyTorch computes in single precision
    atol: float = 1e-5

    @property
    def call(self) -> dict[str, Any]:
        """The arguments of course_lib.checks.observing.observe, beside the function: all that the learner's process is told."""
        return {name: getattr(self, name) for name in ("arguments", "differentiate", "repeat", "returns")}


@dataclass
class FrozenExercise:
    """All cases of one exercise. `criteria` maps facets to points, `messages` misconceptions to what the learner reads, and
    `signatures` misconceptions to the facets in which they differ from what is right.

    `axes` names the axes of the outputs; `last_step_first` is set where errors travel backwards in time, so that the latest wrong
    step is the one to look at.
    """

    name: str
    criteria: dict[str, float]
    messages: dict[str, str]
    cases: list[FrozenCase]
    signatures: dict[str, list[str]] = field(default_factory=dict)
    axes: list[str] = field(default_factory=list)
    last_step_first: bool = False

    @property
    def points(self) -> float:
        return round(sum(self.criteria.values()), 6)


def exercise_of(data: dict[str, Any]) -> FrozenExercise:
    """A frozen exercise, of its fields as plain data."""
    cases = [
        FrozenCase(
            **case
            | {
                "expected": [Observation(**seen) for seen in case["expected"]],
                "misconceptions": {name: Observation(**seen) for name, seen in case["misconceptions"].items()},
            }
        )
        for case in data["cases"]
    ]
    return FrozenExercise(**data | {"cases": cases})
