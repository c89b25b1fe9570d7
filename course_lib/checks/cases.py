"""The data of a check: what goes into an exercise's function and what was observed to come out of it.

Everything here is plain data (strings, numbers, arrays), so that it can be frozen into a file for learners and sent over a
pipe to a sandbox without running anything on arrival: no pickle is ever read.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

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
      arguments: what it is called with; plain data, arrays, or `built` again.
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
    outputs: dict[str, np.ndarray] = field(default_factory=dict)
    graph: list[str] = field(default_factory=list)
    gradients: dict[str, np.ndarray | None] = field(default_factory=dict)
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


def save(path: Path, exercise: FrozenExercise) -> None:
    """Write an exercise's frozen cases as an npz file that `load` reads without pickle."""
    text, arrays = _flatten(asdict(exercise))
    np.savez_compressed(path, allow_pickle=False, json=np.array(text), **arrays)


def load(path: Path) -> FrozenExercise:
    """Read what `save` wrote."""
    with np.load(path, allow_pickle=False) as archive:
        data = _unflatten(str(archive["json"]), archive)
    cases = [
        FrozenCase(
            **case
            | {
                "expected": [Observation(**seen) for seen in case["expected"]],
                "misconceptions": {name: Observation(**seen) for name, seen in case["misconceptions"].items()},
            }
        )
        for case in data.pop("cases")
    ]
    return FrozenExercise(cases=cases, **data)


def encode(data: Any) -> bytes:
    """Plain data with arrays, as bytes in the safetensors format (which cannot hold code, and whose sizes are checked)."""
    text, arrays = _flatten(data)
    return safetensors.numpy.save({"json": np.frombuffer(text.encode(), np.uint8), **arrays})


def decode(payload: bytes, text_limit: int | None = None) -> Any:
    """The data that `encode` made. Raises ValueError for anything else, and for more than `text_limit` bytes beside the arrays:
    a small text of brackets parses into objects of thirty times its size."""
    try:
        if text_limit is not None and int.from_bytes(payload[:8], "little") > text_limit:  # the length of the arrays' directory
            raise ValueError("too many arrays")
        arrays = safetensors.numpy.load(payload)
        if text_limit is not None and arrays["json"].nbytes > text_limit:
            raise ValueError("too much text")
        return _unflatten(arrays["json"].tobytes().decode(), arrays)
    except Exception as error:  # whatever a hostile sender provokes in a parser is one and the same to the receiver
        raise ValueError(f"not a message: {type(error).__name__}") from None


def _flatten(data: Any) -> tuple[str, dict[str, np.ndarray]]:
    arrays: dict[str, np.ndarray] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            key = f"a{len(arrays)}"
            arrays[key] = np.ascontiguousarray(value).reshape(value.shape)
            return {"@array": key}
        if isinstance(value, dict):
            return {str(name): plain(entry) for name, entry in value.items()}
        if isinstance(value, list | tuple):
            return [plain(entry) for entry in value]
        return value

    return json.dumps(plain(data)), arrays


def _unflatten(text: str, arrays: Any) -> Any:
    def whole(value: Any) -> Any:
        if isinstance(value, dict):
            return arrays[value["@array"]] if "@array" in value else {name: whole(entry) for name, entry in value.items()}
        return [whole(entry) for entry in value] if isinstance(value, list) else value

    return whole(json.loads(text))
