"""Turn an exercise's specification into frozen cases: draw the inputs, run the reference and every misconception on them.

The reference is called by name: a case whose arguments are not its own is refused, where a learner's function would be called by position.
`visible` gives what a learner's notebook gets, `hidden` what the judge uses on top of it. The draws of the two never share a seed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from autograder.authoring import artefacts, complaints
from autograder.authoring.spec import Artefact, Case, Exercise, Tuning
from course_lib.checks import artefact as files
from course_lib.checks import cells, tuning
from course_lib.checks.cases import FrozenCase, FrozenExercise, Observation
from course_lib.checks.diagnosis import differing_facets, signature, view, with_article
from course_lib.checks.observing import observe
from course_lib.checks.stored import save


class FreezeError(ValueError):
    """A specification that contradicts itself; the message names its file, the exercise and the case."""

    def __init__(self, exercise: Exercise, complaint: str) -> None:
        file = complaints.checks_file(exercise)
        super().__init__(f"{file}: {complaint}" if file else complaint)


def refusals(exercise: Exercise) -> Iterator[str]:
    """All that would keep an exercise from being frozen and can be told without calling its reference."""
    yield from complaints.of_criteria(exercise)
    for case in exercise.cases:
        yield from complaints.of_view(exercise, case)
        try:
            arguments = _arguments(exercise, case, 0, 0)
        except Exception as error:  # whatever a slip in the inputs' function provokes
            yield f"{exercise.name}, case {case.name!r}: no inputs can be drawn, {type(error).__name__}: {error}"
        else:
            yield from complaints.of_case(exercise, case, arguments)
            yield from complaints.of_built(exercise, case, arguments)


def visible(exercise: Exercise, seed: int = 0) -> FrozenExercise:
    """The cases that learners see, with one draw each."""
    cases = [_freeze(exercise, case, seed, 0, True) for case in exercise.cases if case.visible]
    return _exercise(exercise, cases)


def complete(exercise: Exercise, seed: int = 0) -> FrozenExercise:
    """All cases: the visible ones as learners see them, then `draws` hidden draws of every case."""
    hidden = [_freeze(exercise, case, seed, draw, False) for case in exercise.cases for draw in range(1, case.draws + 1)]
    return _exercise(exercise, visible(exercise, seed).cases + hidden)


def write(exercises: Iterable[Exercise | Artefact | Tuning], directory: Path) -> None:
    """Write `directory/NAME.npz` with an exercise's visible cases; NAME.json where a file is judged, NAME.tuning where settings are."""
    directory.mkdir(parents=True, exist_ok=True)
    for exercise in exercises:
        if isinstance(exercise, Artefact):
            files.save(directory / f"{exercise.name}.json", artefacts.visible(exercise))
        elif isinstance(exercise, Tuning):
            tuning.save(directory / f"{exercise.name}.tuning", artefacts.trained_by_learners(exercise))
        else:
            save(directory / f"{exercise.name}.npz", visible(exercise))


def write_cells(
    assignment: str, exercises: Iterable[tuple[str, float]], questions: Iterable[tuple[str, float]], directory: Path
) -> None:
    """Write `directory/ASSIGNMENT.cells`, the names of an assignment's graded cells, by which a notebook is looked through."""
    directory.mkdir(parents=True, exist_ok=True)
    outline = cells.Outline(tuple(name for name, _ in exercises), tuple(name for name, _ in questions))
    cells.save(directory, assignment, outline)


def _exercise(exercise: Exercise, cases: list[FrozenCase]) -> FrozenExercise:
    return FrozenExercise(
        name=exercise.name,
        criteria=dict(exercise.criteria),
        messages={mistake.name: mistake.message for mistake in exercise.misconceptions},
        signatures={mistake.name: signature(mistake.name, cases) for mistake in exercise.misconceptions},
        cases=cases,
        axes=list(exercise.axes),
        last_step_first=exercise.last_step_first,
    )


def _freeze(exercise: Exercise, case: Case, seed: int, draw: int, is_visible: bool) -> FrozenCase:
    inputs = _arguments(exercise, case, seed, draw)
    for complaint in complaints.of_case(exercise, case, inputs):
        raise FreezeError(exercise, complaint)
    frozen = FrozenCase(
        name=case.name,
        arguments=inputs,
        expected=[],
        differentiate=list(case.differentiate),
        repeat=case.repeat,
        returns=list(case.returns),
        view=case.view,
        raises=list(case.raises),
        facet=case.facet,
        visible=is_visible,
        rtol=case.rtol,
        atol=case.atol,
    )

    def seen(function: Callable) -> Observation:
        return view(frozen, observe(function, **frozen.call))

    frozen.expected = [seen(right) for right in (exercise.reference, *exercise.also_right)]
    frozen.misconceptions = {mistake.name: seen(mistake.function) for mistake in exercise.misconceptions}
    _prove(exercise, case, frozen, seen)
    return frozen


def _prove(exercise: Exercise, case: Case, frozen: FrozenCase, seen: Callable) -> None:
    place = f"{exercise.name}, case {case.name!r}"
    for right in frozen.expected:
        if case.raises and not (right.error == "ValueError" and any(name in right.message for name in case.raises)):
            asked = f"the reference must raise a ValueError that names {' or '.join(case.raises)}"
            raise FreezeError(exercise, f"{place}: {asked}; it {_ended(right)}")
        if right.error and not case.raises:
            raise FreezeError(exercise, f"{place}: the reference {_ended(right)}; a case that it must refuse says so by `raises`")
    if case.closed_form and "values" in differing_facets(seen(case.closed_form), frozen.expected[0], frozen):
        raise FreezeError(exercise, f"{place}: the reference and the closed form differ")


def _ended(seen: Observation) -> str:
    """How a call ended, in words."""
    return f"raises {seen.error}: {seen.message or 'without a word'}" if seen.error else f"returns {with_article(seen.kind)}"


def _arguments(exercise: Exercise, case: Case, seed: int, draw: int) -> dict[str, Any]:
    return _plain(case.inputs(_generator(exercise, case, seed, draw)), case.dtype)


def _generator(exercise: Exercise, case: Case, seed: int, draw: int) -> torch.Generator:
    digest = hashlib.sha256(f"{exercise.name}/{case.name}/{seed}/{draw}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))


def _plain(value: Any, dtype: torch.dtype) -> Any:
    if isinstance(value, dict):
        return {name: _plain(entry, dtype) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry, dtype) for entry in value]
    if isinstance(value, torch.Tensor):
        return (value.to(dtype) if value.is_floating_point() else value).detach().clone()
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.copy())
    return value
