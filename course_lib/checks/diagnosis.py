"""Compare what a function did with what was expected, and name the mistake.

Used by the learner's notebook on the visible cases and by the trusted judge on all of them. But for `examine`, these are pure functions
of data: nothing of the learner's is executed here.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import torch

from course_lib.checks.cases import FACET_TEXT, FrozenCase, FrozenExercise, Observation
from course_lib.checks.observing import observe

NO_DEVICE = ("AssertionError", "RuntimeError", "AcceleratorError", "NotImplementedError", "ValueError")
"""How PyTorch refuses a device that is not there."""

SINGLE_RTOL, SINGLE_ATOL = 1e-4, 1e-5
"""How far a float32 result may stray."""


@dataclass
class Finding:
    """The outcome of one exercise. `state` is one of correct, partial, wrong, not_implemented, error, timeout."""

    exercise: str
    state: str
    score: float
    max_score: float
    misconceptions: list[str] = field(default_factory=list)
    message: str = ""
    failed: list[str] = field(default_factory=list)


def examine(exercise: FrozenExercise, function: Callable) -> Finding:
    """Judge a function in this process: a learner's own notebook, or code that is trusted."""
    return diagnose(exercise, [view(case, observe(function, **case.call)) for case in exercise.cases])


def begin_with(finding: Finding, others: Iterable[Finding]) -> Finding:
    """The finding, whose message first names those of the `others` that its answer calls and that do not pass either.

    >>> ratio = Finding("importance_ratio", "wrong", 0.0, 1.0)
    >>> begin_with(Finding("clip_fraction", "wrong", 0.0, 1.0, message="1 where 0 is right."), [ratio]).message
    'It calls importance_ratio, which does not pass its own check: begin there.\\n1 where 0 is right.'
    """
    names = [one.exercise for one in others if one.state != "correct" and one.exercise != finding.exercise]
    if finding.state == "correct" or not names:
        return finding
    rest = (
        "which does not pass its own check: begin there" if len(names) == 1 else "which do not pass their own checks: begin there"
    )
    return replace(finding, message=f"It calls {' and '.join(names)}, {rest}.\n{finding.message}")


def view(case: FrozenCase, seen: Observation) -> Observation:
    """What the case's view makes of the outputs; of outputs that it cannot read, a kind that says why."""
    if not case.view or seen.error:
        return seen
    from course_lib.checks import stored, views  # these need NumPy, and little else here does

    try:
        outputs = stored.tensors_of(getattr(views, case.view)(stored.arrays_of(case.arguments), stored.arrays_of(seen.outputs)))
    except Exception as error:  # the outputs may be anything at all
        return replace(seen, outputs={}, kind=f"{seen.kind} ({error})")
    return replace(seen, outputs=outputs, graph=["" for _ in seen.graph[:1]], kind=views.READABLE)


def diagnose(exercise: FrozenExercise, observations: Sequence[Observation]) -> Finding:
    """Judge one function by what was observed of it, seen through the cases' views.

    Points are paid by facet, and only together with right values. A misconception is named if, in every facet in which it differs
    from the reference, the function did what the misconception does, in every case; of two that explain, one that explains
    strictly less is left out. If none explains everything, those that explain all wrong values are named.

    Args:
      exercise: the frozen cases.
      observations: one for each case, in order.

    Returns: a Finding; its message shows no expected number of a hidden case.
    """
    pairs = list(zip(exercise.cases, observations, strict=True))
    if any(seen.error == "NotImplementedError" for _, seen in pairs):
        return Finding(exercise.name, "not_implemented", 0.0, exercise.points, message="Not implemented yet.")
    differing = [_differs_from_expected(case, seen) for case, seen in pairs]
    failed = [facet for facet in FACET_TEXT if any(facet in facets for facets in differing)]
    if not failed:
        return Finding(exercise.name, "correct", exercise.points, exercise.points)
    paid = 0.0 if "values" in failed else sum(points for facet, points in exercise.criteria.items() if facet not in failed)
    named = _explanations(exercise, pairs, failed)
    crashed = next((pair for pair, facets in zip(pairs, differing, strict=True) if "values" in facets and pair[1].error), None)
    state = "partial" if paid else "error" if crashed and not named else "wrong"
    lines = [f"Looks like {name}: {exercise.messages[name]}" for name in named]
    lines += _descriptions(exercise, pairs, differing, failed, crashed if state == "error" else None)
    return Finding(exercise.name, state, round(paid, 4), exercise.points, named, "\n".join(lines), failed)


def differing_facets(seen: Observation, target: Observation, case: FrozenCase) -> set[str]:
    """The facets in which two observations of one case differ."""
    if case.raises:
        return set() if _refusal(seen, case) == _refusal(target, case) else {"errors"}
    if seen.error or target.error:
        return set() if seen.error == target.error else {case.facet}
    facets = set()
    if not _same_form(seen, target):
        facets.add("values")
    else:
        pairs = [(seen.outputs[key], target.outputs[key]) for key in target.outputs]
        if not all(_values_agree(*pair, case) for pair in pairs):
            facets.add("values")
        if any(here.dtype != there.dtype for here, there in pairs):
            facets.add("dtype")
    if seen.graph != target.graph or not _gradients_agree(seen, target, case):
        facets.add("gradient")
    if seen.mutated != target.mutated:
        facets.add("inputs")
    return facets


def _same_form(seen: Observation, target: Observation) -> bool:
    return seen.kind == target.kind and seen.outputs.keys() == target.outputs.keys()


def _differs_from_expected(case: FrozenCase, seen: Observation) -> set[str]:
    return min((differing_facets(seen, right, case) for right in case.expected), key=len)


def _refusal(seen: Observation, case: FrozenCase) -> str:
    """How a call that must raise ended: "refused" if rightly, the exception's name, or "returned"."""
    if seen.error == "ValueError" and any(_is_named(name, seen.message) for name in case.raises):
        return "refused"
    return seen.error or "returned"


def _is_named(name: str, message: str) -> bool:
    """Whether a message names an argument; one of a single letter, such as n, stands between no others."""
    return bool(re.search(rf"(?<![A-Za-z]){name}(?![A-Za-z])", message)) if len(name) == 1 else name in message


def _close(seen: torch.Tensor, target: torch.Tensor, case: FrozenCase) -> torch.Tensor:
    single = torch.float32 in (seen.dtype, target.dtype)
    rtol, atol = (max(case.rtol, SINGLE_RTOL), max(case.atol, SINGLE_ATOL)) if single else (case.rtol, case.atol)
    return torch.isclose(seen.double(), target.double(), rtol=rtol, atol=atol, equal_nan=True)


def signature(name: str, cases: Sequence[FrozenCase]) -> list[str]:
    """The facets in which a misconception differs from what is right, over all cases."""
    return sorted(set().union(*(_differs_from_expected(case, case.misconceptions[name]) for case in cases)))


def _values_agree(seen: torch.Tensor, target: torch.Tensor, case: FrozenCase) -> bool:
    return seen.shape == target.shape and bool(_close(seen, target, case).all())


def _gradients_agree(seen: Observation, target: Observation, case: FrozenCase) -> bool:
    for name in case.differentiate:
        here, there = seen.gradients.get(name), target.gradients.get(name)
        if (here is None) != (there is None):
            return False
        if here is not None and there is not None and not _values_agree(here, there, case):
            return False
    return True


def _explanations(exercise: FrozenExercise, pairs: list[tuple[FrozenCase, Observation]], failed: list[str]) -> list[str]:
    """The misconceptions that did all that they do or, failing that, those that did what they do to the values: a leaking gradient beside
    wrong values can wait.

    An example. Where 1 is right, `doubled` returns 2, `greedy` changes its input `x`, `sloppy` does both, and `tripled` returns 3 and
    changes `x`.

    >>> def did(value, changed=()):
    ...     return Observation(kind="float", outputs={"": torch.tensor(value)}, mutated=list(changed))
    >>> wrong = {"doubled": did(2.0), "greedy": did(1.0, ["x"]), "sloppy": did(2.0, ["x"]), "tripled": did(3.0, ["x"])}
    >>> case = FrozenCase("one", {}, [did(1.0)], wrong)
    >>> facets = {name: signature(name, [case]) for name in wrong}
    >>> facets
    {'doubled': ['values'], 'greedy': ['inputs'], 'sloppy': ['inputs', 'values'], 'tripled': ['inputs', 'values']}
    >>> exercise = FrozenExercise("f", {"values": 1.0, "inputs": 1.0}, dict.fromkeys(wrong, "…"), [case], facets)
    >>> def named(seen):
    ...     failed = [facet for facet in FACET_TEXT if facet in differing_facets(seen, did(1.0), case)]
    ...     return _explanations(exercise, [(case, seen)], failed)

    `doubled`, `greedy` and `sloppy` all fit. `sloppy` explains most, and of those that explain strictly less none is named beside it:

    >>> named(did(2.0, ["x"]))
    ['sloppy']

    Here `sloppy` is ruled out, as `x` is left alone; there everything but `greedy`, as the values are right:

    >>> named(did(2.0)), named(did(1.0, ["x"]))
    (['doubled'], ['greedy'])

    `tripled` changes `x`, not `y`, so this is not all that it does; but nothing else fits, and it explains the wrong values. That
    `greedy` fits does not help someone whose values are wrong for another reason:

    >>> named(did(3.0, ["y"])), named(did(4.0, ["x"]))
    (['tripled'], [])
    """
    if "values" not in failed:
        return _explaining(exercise, pairs, failed, set(FACET_TEXT))
    return _explaining(exercise, pairs, failed, set(FACET_TEXT), "values") or _explaining(exercise, pairs, failed, {"values"})


def _explaining(
    exercise: FrozenExercise,
    pairs: list[tuple[FrozenCase, Observation]],
    failed: list[str],
    considered: set[str],
    foremost: str = "",
) -> list[str]:
    """The misconceptions whose `considered` facets were all seen as they would show them, in every case; see `_explanations`.

    One that is wrong in none of these facets explains nothing, and one that is wrong in a facet that did not fail is not what happened.
    With wrong values, one that is about something else only would name a scratch on a wreck: `foremost` must be among the facets.
    """

    def explains(name: str, facets: set[str]) -> bool:
        if not facets or not facets <= set(failed) or (foremost and foremost not in facets):
            return False
        return not any(facets & differing_facets(seen, case.misconceptions[name], case) for case, seen in pairs)

    explained = {
        name: considered & set(facets) for name, facets in exercise.signatures.items() if explains(name, considered & set(facets))
    }
    return [name for name, facets in explained.items() if not any(facets < others for others in explained.values())]


def _descriptions(
    exercise: FrozenExercise,
    pairs: list[tuple[FrozenCase, Observation]],
    differing: list[set[str]],
    failed: list[str],
    crashed: tuple[FrozenCase, Observation] | None = None,
) -> list[str]:
    """A line for each failed facet, from the first case that shows it, or from the one that `crashed` where that is the verdict; once
    the values are wrong, they alone are described.
    """
    lines = []
    for facet in ["values"] if "values" in failed else failed:
        case, seen = crashed or next(pair for pair, facets in zip(pairs, differing, strict=True) if facet in facets)
        describe: dict[str, Callable[[FrozenExercise, FrozenCase, Observation], str]] = {
            "values": _describe_values,
            "gradient": _describe_gradient,
            "dtype": _describe_dtype,
            "inputs": lambda _exercise, _case, seen: f"It changes {' and '.join(seen.mutated)} in place: work on a copy.",
            "errors": _describe_error,
        }
        raised = f"It raises {seen.error}: {seen.message[:300]}" if seen.error and facet != "errors" else ""
        lines.append(f"Case “{case.name}”: {raised or describe[facet](exercise, case, seen)}{_remedy(exercise, seen)}")
    return lines


def _remedy(exercise: FrozenExercise, seen: Observation) -> str:
    """What to do about an exception that says where the code ran before rather than what is wrong with it."""
    if any(word in seen.message for word in ("CUDA", "NVIDIA", "MPS", "mps")) and seen.error in NO_DEVICE:
        return (
            ". There is no GPU where this is graded: leave tensors on the device that they come on, as in "
            "torch.zeros_like(x) or y.to(x.device), or ask torch.cuda.is_available() first."
        )
    if seen.error == "TypeError" and f"{exercise.name}()" in seen.message:
        given = [list(case.call["arguments"]) for case in exercise.cases]
        always = [name for name in given[0] if all(name in names for names in given)]
        at_times = list(dict.fromkeys(name for names in given for name in names if name not in always))
        also = f", and also with {' and '.join(at_times)}" if at_times else ""
        return (
            f". It is called as {exercise.name}({', '.join(always)}){also}: leave its parameters and their defaults as they were."
        )
    return ""


def _describe_values(exercise: FrozenExercise, case: FrozenCase, seen: Observation) -> str:
    right = case.expected[0]
    if not _same_form(seen, right):
        found = re.sub(r"\btuple\b", "list or tuple", with_article(seen.kind))  # either counts as the other
        return f"It returns {found} where {with_article(right.kind)} is asked for."
    for key, want in right.outputs.items():
        got = seen.outputs[key]
        label = f"Output {key}: " if key else ""
        if got.shape != want.shape:
            return f"{label}The shape is {tuple(got.shape)}; it should be {tuple(want.shape)}."
        wrong = (~_close(got, want, case)).nonzero().tolist()
        if len(wrong):
            index = tuple(wrong[-1] if exercise.last_step_first else wrong[0])
            here, there = got[index].item(), want[index].item()
            numbers = f"{here:.6g} where {there:.6g} is right" if case.visible else f"{here:.6g} is not right"
            where = f" at {_place(exercise, index)}" if index else ""
            count = f"; {len(wrong)} of {want.numel()} entries differ" if want.numel() > 1 else ""
            back = " (the latest wrong step: errors travel back in time from there)" if exercise.last_step_first and index else ""
            return f"{label}{numbers}{where}{back}{count}.{_event(exercise, case, index)}"
    raise AssertionError("no value differs")


def _describe_gradient(_exercise: FrozenExercise, case: FrozenCase, seen: Observation) -> str:
    right = case.expected[0]
    extra = [key for key in seen.graph if key not in right.graph]
    for name in case.differentiate:
        got, want = seen.gradients.get(name), right.gradients.get(name)
        if want is None and got is not None:
            return f"Gradient reaches {name}; none should."
        if want is not None and got is None:
            return f"No gradient reaches {name}; it should."
    if extra:
        return "The result carries a graph; it should carry none."
    return "The values are right and their gradient is not."


def _describe_dtype(_exercise: FrozenExercise, case: FrozenCase, seen: Observation) -> str:
    for key, want in case.expected[0].outputs.items():
        if seen.outputs[key].dtype != want.dtype:
            got, asked = (str(kind).removeprefix("torch.") for kind in (seen.outputs[key].dtype, want.dtype))
            return f"The result is {got}; it should keep the inputs' {asked}."
    raise AssertionError("no dtype differs")


def _describe_error(_exercise: FrozenExercise, case: FrozenCase, seen: Observation) -> str:
    rule = f"It should raise a ValueError that names {' or '.join(case.raises)}"
    if not seen.error:
        return f"{rule}; it returns instead."
    return f"{rule}; it raises {seen.error}: {seen.message[:300]}"


def _place(exercise: FrozenExercise, index: tuple[int, ...]) -> str:
    if len(exercise.axes) == len(index):
        return ", ".join(f"{axis}={position}" for axis, position in zip(exercise.axes, index, strict=True))
    return f"index {', '.join(map(str, index))}"


def _event(exercise: FrozenExercise, case: FrozenCase, index: tuple[int, ...]) -> str:
    """What the step was, where a bool input of the same shape says so: " t=3 is where env 1 was truncated."."""
    flags = {
        name: value for name, value in case.arguments.items() if isinstance(value, torch.Tensor) and value.dtype == torch.bool
    }
    said = [name for name, flag in flags.items() if flag.ndim == len(index) and flag[index]]
    if not said or len(index) != 2 or len(exercise.axes) != 2:
        return ""
    return f" {exercise.axes[0]}={index[0]} is where {exercise.axes[1]} {index[1]} was {' and '.join(said)}."


def with_article(kind: str) -> str:
    """ "a tensor", "an int"."""
    return f"{'an' if kind[:1] in 'aeiou' else 'a'} {kind}"
