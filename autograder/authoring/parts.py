"""Parts of checks that many exercises share: inputs in other shapes, and the ways in which any right answer can be spoilt."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from autograder.authoring.spec import Case, Inputs, Misconception

Check = Callable[[Mapping[str, Any]], None]
"""Looks at the arguments of a call by name, and raises a ValueError that names those which it refuses."""

SCALAR = "Return a 0-dim tensor, not a Python float: .item() cuts the graph that the optimiser needs."
DTYPE = (
    "The result has lost the inputs' dtype: make buffers with torch.zeros_like, cast masks and counts with .to(x.dtype), not with .float(),"
    " and leave constants Python floats."
)
CUT = "Nothing can be learnt from this: the result carries no graph. Detach data only, never what is being learnt."
NUMBER = "Return a 0-dim tensor, not a Python float: .item() makes a device wait; convert once, where you log."
METRIC = "A reported number carries no graph: detach it, or it keeps the whole network's activations alive."
SHAPES = (
    "Shapes that differ broadcast silently, (B, 1) against (B,) to all pairs (B, B), and impossible settings give nonsense. Check the"
    " arguments first: course_lib.validate raises errors that name them."
)
IN_PLACE = "The caller's tensor is changed (by -=, *= or a method that ends in _): whoever uses it next finds other data."


def normal(generator: torch.Generator, *shape: int) -> torch.Tensor:
    """Standard normal numbers in double precision."""
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def uniform(generator: torch.Generator, *shape: int) -> torch.Tensor:
    """Numbers in [0, 1) in double precision."""
    return torch.rand(shape, generator=generator, dtype=torch.float64)


def integers(generator: torch.Generator, low: int, high: int, *shape: int) -> torch.Tensor:
    """Integers from low to high - 1."""
    return torch.randint(low, high, shape, generator=generator)


def replaced(inputs: Inputs, **changes: Any) -> Inputs:
    """The same arguments with some of them fixed."""
    return lambda generator: inputs(generator) | changes


def without(inputs: Inputs, *names: str) -> Inputs:
    """The same arguments with some left to their defaults."""
    return lambda generator: {name: value for name, value in inputs(generator).items() if name not in names}


def reshaped(inputs: Inputs, name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> Inputs:
    """The same arguments with one in another shape."""

    def wrong(generator: torch.Generator) -> dict[str, Any]:
        drawn = inputs(generator)
        return drawn | {name: change(drawn[name])}

    return wrong


def loud_padding(inputs: Inputs, *names: str, mask: str = "mask", size: float = 1e4) -> Inputs:
    """The same arguments with ±size wherever the mask is False: what counts for nothing must matter to nothing, gradients included.

    Finite, as a product with the mask is a right way to leave padding out, and 0 times infinity is none of its faults.
    """

    def loud(generator: torch.Generator) -> dict[str, Any]:
        drawn = inputs(generator)
        for name in names:
            x = drawn[name]
            kept = drawn[mask].bool().reshape(*drawn[mask].shape, *[1] * (x.dim() - drawn[mask].dim()))
            drawn[name] = torch.where(kept, x, size * normal(generator, *x.shape).sign().to(x.dtype))
        return drawn

    return loud


def drawing(draw: Callable[..., dict[str, Any]]) -> Callable[..., Inputs]:
    """Makes inputs with settings of a function that draws them: `@drawing` on `def steps(generator, size=8)`, then `steps(size=5)`."""
    return lambda *settings, **named: lambda generator: draw(generator, *settings, **named)


def shape_cases(inputs: Inputs, names: Sequence[str]) -> tuple[Case, ...]:
    """Each argument once without its first row; a single row in its place would broadcast, and so it comes once that way."""
    cases = [
        Case(f"{name} without its first row", reshaped(inputs, name, lambda x: x[1:]), raises=names, draws=1) for name in names
    ]
    single = Case(
        f"{names[-1]} of a single row", reshaped(inputs, names[-1], lambda x: x[:1]), raises=names, visible=True, draws=1
    )
    return (*cases, single)


def refused(inputs: Inputs, visible: bool = False, **impossible: Any) -> Case:
    """A setting that must be refused."""
    ((name, value),) = impossible.items()
    return Case(f"{name} = {value}", replaced(inputs, **impossible), raises=[name], visible=visible, draws=1)


def drawn_once(*cases: Case) -> tuple[Case, ...]:
    """Cases that do not say otherwise are drawn once for the judge: with many cases each fault shows in several of them."""
    return tuple(replace(case, draws=1) if case.draws == Case.draws else case for case in cases)


def after(function: Callable, change: Callable) -> Callable:
    """Right, and then spoilt."""
    return lambda *args, **kwargs: change(function(*args, **kwargs))


def versions_of(reference: Callable, *checks: Check, data: Sequence[str] = ()) -> Callable:
    """What makes a formula a whole answer to an exercise, right or wrong: `versions_of(...)(formula)`.

    The answer has the reference's parameters and defaults, and hands them to `formula` in this order. Before, it lets `checks` look at
    them, unless it is made with `checked=False`, and detaches those that `data` names, unless with `leak=True`.
    """
    signature = inspect.signature(reference)

    def version(formula: Callable, checked: bool = True, leak: bool = False) -> Callable:
        def answer(*args, **kwargs):
            bound = signature.bind(*args, **kwargs)
            bound.apply_defaults()
            given = bound.arguments
            for check in checks if checked else ():
                check(given)
            for name in () if leak else data:
                if isinstance(given[name], torch.Tensor):
                    given[name] = given[name].detach()
            return formula(*given.values())

        return answer

    return version


def one_shape(*names: str) -> Check:
    """A check that arguments agree in shape, in another style than the references', which use course_lib.validate."""

    def check(given: Mapping[str, Any]) -> None:
        shapes = {name: tuple(given[name].shape) for name in names}
        if len(set(shapes.values())) > 1:
            raise ValueError(f"shapes that must agree, and do not: {shapes}")

    return check


def satisfies(rule: Callable[..., Any]) -> Check:
    """A check by a rule: its parameters are named as the arguments that it is about, and so does the error name them."""
    names = list(inspect.signature(rule).parameters)

    def check(given: Mapping[str, Any]) -> None:
        if not rule(*(given[name] for name in names)):
            raise ValueError(f"refused: {' and '.join(names)}")

    return check


def number(*values: float) -> Callable:
    """A closed form of cases in which the answer is known: this number, or the vector of these."""
    return lambda **_given: torch.tensor(values if len(values) > 1 else values[0], dtype=torch.float64)


def wrong(answers: Mapping[str, tuple[Any, str]], of: Callable = lambda answer: answer) -> tuple[Misconception, ...]:
    """Wrong answers by name, each with what its author should look at. `of` makes them whole where they are formulas only."""
    return tuple(Misconception(name, of(answer), message) for name, (answer, message) in answers.items())


def bad_input_accepted(answer: Callable, message: str = SHAPES) -> Misconception:
    """Right, but for what should be refused."""
    return Misconception("bad-input-accepted", answer, message)


def dtype_lost(function: Callable) -> Misconception:
    """Right, but in another dtype."""
    return Misconception("dtype-lost", after(function, torch.Tensor.float), DTYPE)


def python_float(function: Callable, message: str = SCALAR) -> Misconception:
    """Right, but a Python float in place of a tensor."""
    return Misconception("python-float", after(function, torch.Tensor.item), message)


def cut_from_graph(function: Callable) -> Misconception:
    """Right, but without a graph."""
    return Misconception("cut-from-graph", after(function, torch.Tensor.detach), CUT)


def in_place(function: Callable, name: str, position: int = 0) -> Misconception:
    """Right, but the argument of this name has changed afterwards."""

    def wrong(*args, **kwargs):
        result = function(*args, **kwargs)
        with torch.no_grad():
            given = args[position] if position < len(args) else kwargs[name]
            given.mul_(0.5) if given.is_floating_point() else given.bitwise_not_()
        return result

    return Misconception("input-changed", wrong, IN_PLACE)


def altered(inputs: Inputs, change: Callable[[dict[str, Any]], dict[str, Any]]) -> Inputs:
    """The same arguments with some of them made anew from the others."""

    def drawn_and_altered(generator: torch.Generator) -> dict[str, Any]:
        drawn = inputs(generator)
        return drawn | change(drawn)

    return drawn_and_altered


def rows_cut(formula: Callable) -> Callable:
    """A formula that accepts tensors of unequal length: all are cut to the shortest, but single rows are repeated, as broadcasting does."""

    def accepting(*given: Any) -> Any:
        rows = min((len(x) for x in given if isinstance(x, torch.Tensor) and len(x) > 1), default=1)
        return formula(*(x[:rows].expand(rows, *x.shape[1:]) if isinstance(x, torch.Tensor) else x for x in given))

    return accepting


def spoilt(function: Callable, *ways: Callable[[Callable], Misconception], changed: str = "") -> tuple[Misconception, ...]:
    """Right, but in each of these ways, such as dtype_lost and cut_from_graph; and once more with the argument `changed` in place."""
    position = list(inspect.signature(function).parameters).index(changed) if changed else 0
    return (*(way(function) for way in ways), *([in_place(function, changed, position)] if changed else []))


def misshapen(name: str, inputs: Inputs, argument: str, change: Callable, raises: Sequence[str] = (), **options: Any) -> Case:
    """A case with one argument in another shape, to be refused by an error that names it, or one of those in `raises`."""
    return Case(name, reshaped(inputs, argument, change), raises=raises or [argument], **options)
