"""The page's torch is torch, as far as it goes: the same numbers, kinds, shapes, gradients and errors, and a word about what it lacks.

Random programs are drawn from the tables of `both_torches`. A longer run: `PRACTICE_EXAMPLES=100000 pytest tests/book/practice`.
"""

from __future__ import annotations

import math
import os
import random

import both_torches
import pytest
import torch
from both_torches import Program, Tensor, difference, drawn, page

EXAMPLES = int(os.environ.get("PRACTICE_EXAMPLES", "1500"))
# The same programs every time: Hypothesis would draw by whatever modules the process has imported. A longer run takes others each time.
FIRST = 0 if EXAMPLES <= 1500 else random.SystemRandom().getrandbits(60)


def test_an_operation_gives_what_torch_gives():
    for seed in range(FIRST, FIRST + EXAMPLES):
        program = drawn(random.Random(seed))
        assert difference(program) == "", (seed, program)


def test_a_program_with_views_and_changes_in_place_gives_what_torch_gives():
    for seed in range(FIRST, FIRST + EXAMPLES // 2):
        program = drawn(random.Random(seed), steps=3 + seed % 4)
        assert difference(program) == "", (seed, program)


def test_binary_cross_entropy_is_torchs_at_the_ends_too():
    x, y = [0.0, 1.0, 0.3, 0.5], [1.0, 0.0, 0.3, 1.0]
    assert run(["r = F.binary_cross_entropy(x, y)"], x=(x, (4,), "float64"), y=(y, (4,), "float64")) == ""


@pytest.mark.parametrize("offset", [-2, -1, 0, 1, 3])
@pytest.mark.parametrize("shape", [(3,), (2, 2), (1, 0)])
def test_numbers_laid_on_a_diagonal_lie_where_torch_lays_them(offset, shape):
    entries = [float(number) + 1 for number in range(math.prod(shape))]
    assert run([f"r = torch.diag_embed(x, {offset})"], x=(entries, shape, "float64")) == ""


@pytest.mark.parametrize(
    "target",
    [
        "T.tensor([0, 1, 4])", "T.tensor([0, -1, 2])", "T.tensor([0, 1, 4]), ignore_index=4", "T.tensor([0., 1, 2])", "T.tensor([0, 1])",
        "T.tensor([0., 1, 2]).double()", "T.tensor([0, 1, 2]).int()", "T.tensor([True, False, True])", "T.tensor([[0, 1, 2]])",
        "T.tensor([[0], [1], [2]])", "T.tensor(1)", "[0, 1, 2]", "x.long()", "x.softmax(1)", "x.softmax(1), ignore_index=2",
        "T.tensor([0, 1, 9]), label_smoothing=0.1", "T.tensor([0, 1, 3]), reduction='none'", "T.tensor([0, 1, 2]), reduction='mean of all'",
    ],
)  # fmt: skip
@pytest.mark.parametrize("loss", ["cross_entropy", "nll_loss"])
def test_classes_that_are_none_are_refused_in_torchs_words(loss, target):
    x = ([0.1 * number for number in range(12)], (3, 4), "float64")
    if loss == "nll_loss" and "label" in target:
        target = target.replace(", label_smoothing=0.1", "")
    if not (loss == "nll_loss" and "softmax" in target):  # that takes no probabilities, in words about its own kernels
        assert run([f"r = F.{loss}(x, {target})"], x=x) == ""
    assert run(["r = F.cross_entropy(x[0], T.tensor(4))"], x=x) == run(["r = F.cross_entropy(x[0], T.tensor(3))"], x=x) == ""
    assert run(["r = F.cross_entropy(x[None], T.tensor([[0, 1, 2, 3]]))"], x=x) == ""
    assert run(["r = F.cross_entropy(x[None], T.tensor([0]))"], x=x) == ""


@pytest.mark.parametrize(
    "call",
    [
        *(f"x.{name}(0, {value})" for name in ("sum", "mean", "prod", "amax", "argmin", "logsumexp") for value in (1, 0, None, "x")),
        *(f"x.{name}({given})" for name in ("std", "var") for given in ("0, 1", "0, True, 1", "0, keepdim=1", "unbiased=0", "0, None")),
        "x.sum(1, 2)", "T.sum(x, 1, 2)", "x.sum(0, keepdim=1)", "x.max(0, 1)", "x.any(0, 1)", "x.quantile(0.5, 0, 1)", "x.sort(0, 1)[0]",
        "x.sort(stable=1)[0]", "x.argsort(descending=1)", "x.topk(1, 0, 1)[0]", "T.zeros(2, requires_grad=1)", "T.isclose(x, x, 0, 0, 1)",
        "x.sum((0, 1), True)", "x.std(0, True, True)", "x.sort(stable=True)[0]", "x.var(0, False)", "x.mean(1, keepdim=False)",
    ],
)  # fmt: skip
def test_a_number_is_no_yes_or_no(call):
    x = ([0.1 * number for number in range(12)], (3, 4), "float64")
    assert run([f"r = {call}"], x=x) == ""


def run(statements, graph=True, **tensors):
    """How the two torches differ on a program."""
    made = {name: Tensor(tuple(entries), shape, kind) for name, (entries, shape, kind) in tensors.items()}
    return difference(Program(tuple(statements), tuple(made.items()), graph))


SPECIAL = (0.0, -0.0, 1.0, -1.0, 30.0, -30.0, 800.0, -800.0, 1e-300, math.inf, -math.inf, math.nan)


@pytest.mark.parametrize("kind", ["float64", "float32"])
@pytest.mark.parametrize(
    "expression",
    [
        *(
            "x.exp()",
            "x.log()",
            "x.log1p()",
            "x.sqrt()",
            "x.sigmoid()",
            "x.tanh()",
            "x.abs()",
            "x.sign()",
            "x.square()",
            "x.expm1()",
        ),
        *("F.logsigmoid(x)", "F.softplus(x)", "F.relu(x)", "x.clamp(-1, 1)", "x.clamp(min=0)", "T.where(x > 0, x, 0)"),
        *("x > 0", "x <= 0", "x == x", "x != x", "x.isnan()", "x.isfinite()", "x.isinf()", "T.maximum(x, T.zeros_like(x))"),
        *("x.max()", "x.min()", "x.argmax()", "x.sort().values", "x.argsort(stable=True)", "x.sum()", "x.mean()", "x.nansum()"),
        *(
            "x.nan_to_num()",
            "x.softmax(0)",
            "x.log_softmax(0)",
            "x.logsumexp(0)",
            "x.cumsum(0)",
            "x ** 2",
            "x ** 0",
            "1 / x",
            "x * 0",
        ),
        *("x.floor()", "x.round()", "x % 1", "x.long()", "x.bool()", "x.any()", "x.all()", "x.prod()", "x.std()", "x.median()"),
    ],
)
def test_at_the_edges_of_numbers(expression, kind):
    assert run([f"r = {expression}"], graph=False, x=(SPECIAL, (len(SPECIAL),), kind)) == ""
    for value in SPECIAL:
        assert run([f"r = {expression}"], graph=False, x=((value,), (1,), kind)) == "", value


@pytest.mark.parametrize(
    "expression",
    [
        *(
            "x.max()",
            "x.min()",
            "x.amax(0)",
            "T.maximum(x, y)",
            "T.minimum(x, y)",
            "x.max(0).values",
            "x.abs()",
            "x.sign()",
            "x.std()",
        ),
        *(
            "x.clamp(0, 1)",
            "x.clamp(min=y)",
            "T.relu(x)",
            "x ** 2",
            "x ** y",
            "x ** 0",
            "x.norm()",
            "x.prod()",
            "x.cumprod(0)",
            "x.sqrt()",
        ),
        *(
            "x.sort().values",
            "x.median()",
            "x.logsumexp(0)",
            "F.smooth_l1_loss(x, y)",
            "F.huber_loss(x, y)",
            "T.where(x > 0, x, y)",
        ),
    ],
)
def test_gradients_at_ties_and_at_zero(expression):
    for entries in ((0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (2.0, 2.0, 2.0)):
        assert run([f"r = {expression}"], x=(entries, (3,), "float64"), y=((1.0, 0.0, 2.0), (3,), "float64")) == ""


KINDS = ("bool", "uint8", "int32", "int64", "float16", "float32", "float64")


@pytest.mark.parametrize("operator", ["+", "*", "/", ">", "=="])
def test_kinds_are_promoted_alike(operator):
    for a in KINDS:
        for b in KINDS:
            for shape in ((1,), ()):
                assert run([f"r = x {operator} y"], graph=False, x=((1,), (1,), a), y=((1,), shape, b)) == "", (a, b, shape)
        for number in ("1", "1.5", "True"):
            assert run([f"r = x {operator} {number}"], graph=False, x=((1,), (1,), a)) == "", (a, number)
            assert run([f"r = x {operator} {number}"], graph=False, x=((1,), (), a)) == "", (a, number)


@pytest.mark.parametrize(
    "expression",
    [
        "T.zeros(2, dtype=bool)", "T.tensor([1, 2], dtype=float)", "x.to(int)", "x.to(dtype=float)", "x.sum(dtype=float)",
        "T.zeros_like(x, dtype=bool)", "x.new_zeros(2, dtype=int)", "x.long().type(bool)", "T.as_tensor([1], dtype=float)",
    ],
)  # fmt: skip
def test_pythons_own_types_are_kinds(expression):
    assert run([f"r = {expression}"], graph=False, x=((1.5, 0.0), (2,), "float32")) == ""


@pytest.mark.parametrize("shape", [(), (6,), (2, 3), (1, 2, 3), (1, 2, 1, 3)])
def test_a_softmax_that_names_no_axis_takes_torchs(shape):
    entries = tuple(float(i * i) for i in range(6))[: math.prod(shape)]
    for name in ("softmax", "log_softmax"):
        assert run([f"r = F.{name}(x)"], x=(entries, shape, "float64")) == ""
        assert run([f"r = T.{name}(x)"], x=(entries, shape, "float64")) == ""  # an error


@pytest.mark.parametrize("kind", ["float16", "float32", "float64"])
def test_a_sigmoid_vanishes_where_torchs_does(kind):
    entries = (-709.7, -709.8, -740.0, -88.72, -88.723, -100.0, -87.0, 5.0, 1000.0)
    for entry in entries:
        assert run(["r = x.sigmoid() == 0"], graph=False, x=((entry,), (1,), kind)) == "", entry
        assert run(["r = T.sigmoid(x).log()"], graph=False, x=((entry,), (1,), kind)) == "", entry


def test_who_wants_a_gradient_is_said_of_leaves_alone():
    x = ((1.0, 2.0), (2,), "float64")
    for value in (True, False):
        assert run([f"r = x.exp(); r.requires_grad = {value}"], x=x) == ""
        assert run([f"r = x.exp(); r.requires_grad_({value})"], x=x) == ""
        assert run([f"r = x.detach(); r.requires_grad = {value}"], x=x) == ""
        assert run([f"r = x.long(); r.requires_grad = {value}"], x=x) == ""
        assert run([f"r = x.long().requires_grad_({value})"], x=x) == ""


LEARNERS = {
    "nothing is made a number": ["r = T.tensor([None, 1.0])"],
    "a computed tensor is taken out of the graph": ["x.requires_grad = False", "r = x"],
    "a mask is subtracted from 1": ["r = 1 - m"],
    "a mask is negated": ["r = -m"],
    "a float is inverted": ["r = ~x"],
    "shapes that do not meet": ["r = x + T.ones(5)"],
    "several entries are one number": ["r = T.tensor(x.item())"],
    "several entries are one truth": ["r = x if x > 0 else y"],
    "no such axis": ["r = x.sum(2)"],
    "unequal rows are stacked": ["r = T.stack([x, x[1:]])"],
    "unequal rows are joined": ["r = T.cat([x[None], x[1:][None]])"],
    "a view of the wrong size": ["r = x.view(7)"],
    "a view of a transposed matrix": ["r = x[None].expand(2, -1).t().view(-1)"],
    "no such place": ["r = x[9]"],
    "too many places": ["r = x[0, 0]"],
    "a mask of another shape": ["r = x[T.ones(2, dtype=T.bool)]"],
    "a mean of integers": ["r = T.arange(3).mean()"],
    "a list in place of a tensor": ["r = T.exp([1.0])"],
    "a number in place of a tensor": ["r = T.maximum(x, 0.0)"],
    "a number in place of a condition": ["r = T.where(x, x, y)"],
    "a leaf is changed": ["x = T.ones(2, requires_grad=True)", "x += 1", "r = x"],
    "a view of a leaf is changed": ["x = T.ones(2, requires_grad=True)", "x[0] = 1", "r = x"],
    "what exp made is changed": ["r = x.exp()", "r += 1"],
    "what a product needs is changed": ["r = x * y", "x += 1"],
    "a row is changed while they are gone through": ["for row in x[None]:\n    row += 1", "r = x"],
    "backward of several": ["x.exp().backward()", "r = x"],
    "backward twice": ["s = x.exp().sum()", "s.backward()", "s.backward()", "r = x"],
    "backward of no graph": ["x.detach().sum().backward()", "r = x"],
    "a name that torch has not": ["r = T.clamped(x)"],
    "a method that tensors have not": ["r = x.clamped()"],
    "a loss that is not": ["r = F.clamped(x)"],
    "None is added": ["r = x + None"],
    "overlapping parts": ["x[1:] = x[:-1]", "r = x"],
    "entries of an expanded tensor are written": ["z = x[None].expand(2, -1)", "z += 1", "r = z"],
    "integers are divided in place": ["z = T.arange(3)", "z /= 2", "r = z"],
    "a tensor as a range": ["r = T.tensor(list(range(x)))"],
    "no tensors": ["r = T.cat([])"],
    "the largest of none": ["r = x[:0].max()"],
    "matrices that do not fit": ["r = x[None] @ y[None]"],
    "a product of two kinds": ["r = x @ y.float()"],
}


@pytest.mark.parametrize("mistake", LEARNERS)
def test_what_learners_write_fails_in_the_same_words(mistake):
    tensors = {
        "x": ((1.0, 2.0, 3.0), (3,), "float64"),
        "y": ((1.0, 0.5, 2.0), (3,), "float64"),
        "m": ((True, False, True), (3,), "bool"),
    }
    program = Program(tuple(LEARNERS[mistake]), tuple((name, Tensor(*one)) for name, one in tensors.items()), True)
    here, right = both_torches.ran(page, program), both_torches.ran(torch, program)
    if right.error:
        assert (here.error, here.message) == (right.error, right.message)
    else:  # the error comes with the gradient
        assert isinstance(right.gradients, both_torches.Ran), right
        assert (here.gradients.error, here.gradients.message) == (right.gradients.error, right.gradients.message)


@pytest.mark.parametrize(
    ("expression", "what"),
    [
        ("T.einsum('i->', x)", "torch.einsum"),
        ("x.cpu().lgamma()", "Tensor.lgamma"),
        ("F.conv2d(x)", "torch.nn.functional.conv2d"),
        ("T.nn.Linear(2, 2)", "torch.nn.Linear"),
        ("T.linalg.solve(x, x)", "torch.linalg.solve"),
        ("T.autograd.Function", "torch.autograd.Function"),
        ("x.sum(0, out=x)", "Tensor.sum with out="),
        ("T.Generator()", "torch.Generator"),
        ("x.numpy()", "Tensor.numpy"),
        ("T.tensor(1j)", "torch.complex64"),
        ("x * 1j", "torch.complex64"),
        ("x.to('cuda')", "torch.device('cuda')"),
        ("T.Tensor([1.0])", "torch.Tensor as a function"),
        ("x.type()", "Tensor.type of names"),
        ("x.long() << 1", "Tensor.bitwise_left_shift and its like"),
        ("1 >> x.long()", "Tensor.bitwise_left_shift and its like"),
        ("x.repeat_interleave(x.long())", "torch.repeat_interleave by a tensor"),
        ("T.autograd.grad(x, x, create_graph=True)", "torch.autograd.grad with create_graph="),
        ("x.backward(create_graph=True)", "Tensor.backward with create_graph="),
        ("x.backward(inputs=[x])", "Tensor.backward with inputs="),
    ],
)
def test_what_is_lacking_is_named(expression, what):
    with pytest.raises(AttributeError) as caught:
        eval(expression, {"T": page, "F": page.nn.functional, "x": page.ones(2)})
    assert str(caught.value) == f"{what} is not in the page's torch; it is in the notebook"


@pytest.mark.parametrize(
    "expression",
    [
        *(
            "T.tensor(1.5)",
            "T.tensor([1.0, 2.0])",
            "T.tensor([0.1, 0.25])",
            "T.tensor([[1.0, -2.5], [0.0, 3.25]])",
            "T.tensor([1, -20])",
        ),
        *(
            "T.tensor([True, False])",
            "T.tensor([1e-6, 1.0])",
            "T.tensor([1.0, 1e9])",
            "T.tensor([1.0, float('nan'), float('-inf')])",
        ),
        *(
            "T.arange(40).float() / 7",
            "T.zeros(2, 2, 3)",
            "T.zeros(0)",
            "T.zeros(0, 3)",
            "T.ones(2, dtype=T.float64) / 3",
            "T.tensor(7)",
        ),
        *(
            "T.ones(2, requires_grad=True)",
            "T.ones(2, requires_grad=True) * 2",
            "T.ones(2, requires_grad=True).exp()",
            "T.zeros(2, 1)",
        ),
        *(
            "T.zeros(3).shape",
            "T.float32",
            "T.ones(2).max(0)",
            "T.arange(3).int()",
            "T.tensor([0.0, 0.0])",
            "T.arange(60).reshape(2, 30)",
        ),
    ],
)
def test_tensors_show_themselves_alike(expression):
    assert repr(eval(expression, {"T": page})) == repr(eval(expression, {"T": torch}))


def test_it_has_no_name_that_torch_has_not():
    own = {name for name in dir(page) if not name.startswith("_")}
    assert own - set(dir(torch)) == set()
    assert {name for name in dir(page.nn.functional) if not name.startswith("_")} - set(dir(torch.nn.functional)) == set()
    inner = {
        "base",
        "flat",
        "follow_base",
        "one_of",
        "places",
        "refuse_if_leaf",
        "step",
        "storage",
        "strides",
        "as_view",
        "write",
        "offset",
    }
    assert {name for name in dir(page.Tensor) if not name.startswith("_")} - set(dir(torch.Tensor)) - inner == set()
