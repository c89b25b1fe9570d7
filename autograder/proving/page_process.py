"""Judge a chapter's answers as a page of the book does.

A program, run by autograder.proving.practice with no package but the page's own: `python -S -E page_process.py`, a JSON text on standard
input, another on standard output.

The answers are functions of modules that import more than the page has. Of what is missing, modules may name all and call all while they
are imported; when the answers are judged, every use says that it is missing. Texts of cells are judged with no more of course_lib
than the page has.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


@contextlib.contextmanager
def _lenient(torch: Any, names: Any, elsewhere: Any) -> Iterator[None]:
    """While modules are imported, whatever torch lacks is stood in for."""
    owners = [torch, torch.autograd, names.Namespace]
    strict = [owner.__getattr__ for owner in owners]
    elsewhere.StandIn.lenient = True
    torch.__getattr__ = lambda name: elsewhere.stand_in(f"torch.{name}", "the page's torch")
    torch.autograd.__getattr__ = lambda name: elsewhere.stand_in(f"torch.autograd.{name}", "the page's torch")
    names.Namespace.__getattr__ = lambda self, name: elsewhere.stand_in(f"{self.__name__}.{name}", "the page's torch")
    try:
        yield
    finally:
        elsewhere.StandIn.lenient = False
        for owner, own in zip(owners, strict, strict=True):
            owner.__getattr__ = own


def _only(library: list[str]) -> None:
    """Forget what of course_lib the page does not have: from now on, importing it gives what it gives there."""
    own = {f"course_lib/{file}".removesuffix(".py").removesuffix("/__init__").replace("/", ".") for file in library}
    for name in own:
        importlib.import_module(name)
    for name, module in list(sys.modules.items()):
        if name == "course_lib" or name in own:
            if hasattr(module, "__path__"):
                module.__path__ = []
        elif name.startswith("course_lib."):
            del sys.modules[name]
            owner, _, last = name.rpartition(".")
            if owner in sys.modules:
                vars(sys.modules[owner]).pop(last, None)


def main() -> None:
    """Answer: for each exercise, for each answer, its state, misconceptions and message, and the seconds that it took."""
    task = json.load(sys.stdin)
    sys.path[:] = [
        str(ROOT / "book" / "practice"),
        str(ROOT),
        *[path for path in sys.path if Path(path) != Path(__file__).parent],
    ]
    import elsewhere
    import judge
    import torch
    from torch import names  # type: ignore[attr-defined]  # of the page's torch

    sys.modules["course_lib"].__path__ = [str(ROOT / "course_lib")]
    with _lenient(torch, names, elsewhere):
        module = importlib.import_module(f"autograder.checks.{task['assignment']}")
    offered = judge.open_page(task["page"])
    told: dict[str, Any] = {}
    for exercise in module.EXERCISES:
        if exercise.name not in offered:
            continue
        frozen = judge.exercise_from(task["cases"][exercise.name])
        answers: list[tuple[str, str, Any]] = [("reference", "", exercise.reference)]
        answers += [("variant", name, function) for name, function in exercise.variants.items()]
        answers += [("misconception", one.name, one.function) for one in exercise.misconceptions]
        rows = []
        for kind, name, function in answers:
            start = time.perf_counter()
            result = judge.judged(frozen, function)
            rows.append([kind, name, result["state"], result["misconceptions"], result["message"], time.perf_counter() - start])
        told[exercise.name] = rows
    _only(task["library"])
    for name, rows in told.items():
        start = time.perf_counter()
        result = judge.check(name, task["references"][name])
        rows.append(["text", "", result["state"], result["misconceptions"], result["message"], time.perf_counter() - start])
    json.dump(told, sys.stdout)


if __name__ == "__main__":
    main()
