"""The page's torch beside the real one, under a name of its own; and random programs that run on both."""

from __future__ import annotations

import importlib.util
import math
import random
import sys
import warnings
from dataclasses import dataclass
from typing import Any

import torch

from autograder.proving.practice import PAGE


def loaded() -> Any:
    """The page's torch, as the module `page_torch`, knowing the real one's names."""
    if "page_torch" not in sys.modules:
        folder = PAGE / "torch"
        spec = importlib.util.spec_from_file_location(
            "page_torch", folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        assert spec and spec.loader
        module = importlib.util.module_from_spec(spec)
        sys.modules["page_torch"] = module
        spec.loader.exec_module(module)
        sys.modules["page_torch.missing"].know(sys.modules["page_torch.missing"].real_names(torch))
    return sys.modules["page_torch"]


page = loaded()
SAME_TEXT = (
    "Trying to backward", "element 0 of tensors", "grad can be implicitly", "One of the differentiated", "a leaf Variable",
    "a view of a leaf",
    "Negation", "Subtraction", "~ (operator", "The size of tensor a", "mat1 and mat2", "shape '", "view size is not", "stack expects",
    "Sizes of tensors must match", "Dimension out of range", "too many indices", "The shape of the mask", "Boolean value of Tensor",
    "a Tensor with", "only one element tensors", "mean(): could not", "std and var only", "argument 'input'", "where expected condition",
"Index tensor must", "unsupported operand type", "module 'torch'", "'Tensor' object has", "Integers to negative",
"zero-dimensional tensor", "Index put requires", "max(): Expected", "min(): Expected",
    "is out of bounds.", "expected target dtype", "Expected input batch_size", "Expected floating point type for target", "multi-target",
    "Expected target size", "ignore_index is not", "argument 'target'", "argument 'keepdim'", "argument 'largest'",
    "masked_fill", "both arguments to matmul", "expected m1 and m2", "inconsistent tensor size",
)  # fmt: skip
"""How errors begin, or what is in them, whose whole text is the same."""

FUNCTIONS = """
{a} + {b}; {a} - {b}; {a} * {b}; {a} / {b}; {a} // {b}; {a} % {b}; {a} ** {b}; {a} @ {b}; {a} == {b}; {a} < {b}; {a} >= {b}
{a} != {b}; {a} & {b}; {a} ^ {b}; {a} | {b}; -{a}; ~{a}; abs({a}); {a} + 1; {a} * 2.5; 1 - {a}; 2 / {a}; {a} ** 2; {a} ** -1
2 ** {a}; {a} // 2; {a} % 3; {a} % 2.0; {a} > 0; {a} == 1; 0.1 < {a}; {a} + True; True - {a}; {a} * 3 - {a}; T.exp({a})
{a}.log(); {a}.sqrt(); {a}.sigmoid(); T.tanh({a}); {a}.abs(); {a}.sign(); {a}.square(); {a}.floor(); {a}.ceil(); {a}.round()
T.relu({a}); {a}.log1p(); {a}.expm1(); {a}.reciprocal(); {a}.rsqrt(); {a}.isnan(); {a}.isinf(); {a}.isfinite()
{a}.logical_not(); {a}.erf(); {a}.neg(); {a}.sin(); {a}.cos(); {a}.log2(); {a}.nan_to_num(); {a}.atanh(); T.special.ndtr({a})
T.logit({a}); T.minimum({a}, {b}); T.maximum({a}, {b}); T.min({a}, {b}); {a}.max({b}); {a}.clamp(-0.5, 0.5); {a}.clamp(min=0)
T.clamp({a}, max=1.0); {a}.clamp(min={b}); T.where({m}, {a}, {b}); T.where({m}, {a}, 0); T.where({m}, 0.5, {a})
{a}.masked_fill({m}, 0); {a}.masked_fill({m}, -float("inf")); {a}.where({m}, {b}); T.where({a} > 0, {a}, {b})
{a}.logical_and({b}); T.isclose({a}, {b}); {a}.eq({b}); T.where({a}, 1, 0); {a}.sum(); {a}.sum({d}); {a}.sum({d}, keepdim=True)
{a}.mean(); {a}.mean({d}); {a}.mean({d}, True); {a}.prod(); {a}.prod({d}); {a}.std(); {a}.std({d}); {a}.var({d}, unbiased=False)
{a}.var(correction=0); {a}.std({d}, correction=0, keepdim=True); {a}.max(); {a}.min(); {a}.max({d}).values; {a}.max({d})[1]
{a}.min({d}, keepdim=True)[0]; {a}.amax({d}); {a}.argmax(); {a}.argmax({d}); {a}.argmin({d}, keepdim=True); {a}.any()
{a}.all({d}); {a}.any({d}, keepdim=True); {a}.count_nonzero(); {a}.norm(); {a}.norm(dim={d}); {a}.logsumexp({d})
{a}.logsumexp({d}, keepdim=True); {a}.sum((0, 1)); {a}.mean((0, -1)); {a}.nansum(); {a}.sum(dtype=T.float64); {a}.sum(axis={d})
{a}.softmax({d}); {a}.log_softmax({d}); T.softmax({a}, dim={d}); {a}.cumsum({d}); {a}.cummax({d}).values; {a}.sort({d}).values
{a}.sort({d}, descending=True)[0]; {a}.sort(stable=True)[1]; {a}.argsort(); T.topk({a}, 2).values; {a}.diff(); {a}.quantile(0.3)
{a}.median(); {a}.logcumsumexp({d}); T.gather({a}, {d}, {i}); {a}.gather({d}, {i}); {a}[{i}]; {a}[{m}]; {a}.masked_select({m})
{a}.nonzero(); {a}.flip(0); {a}.roll(1, 0); T.cat([{a}, {b}]); T.cat([{a}, {b}], {d}); T.stack([{a}, {b}])
T.stack([{a}, {b}, {c}], dim={d}); {a}.tril(); {a}.triu(1); {a}.repeat_interleave(2, 0); {a}.reshape(-1); {a}.view(-1)
{a}.reshape(2, -1); {a}.view(3, 2); {a}.flatten(); {a}.unsqueeze({d}); {a}.squeeze(); {a}.squeeze({d}); {a}.t(); {a}.T; {a}.mT
{a}.transpose(0, 1); {a}.permute(1, 0); {a}.expand(2, 3); {a}.expand_as({b}); {a}.narrow({d}, 0, 1); {a}.unbind({d})[0]
{a}.split(2)[0]; {a}.chunk(2, {d})[-1]; T.broadcast_to({a}, {b}.shape); {a}.contiguous(); {a}.clone(); {a}.detach(); {a}[0]
{a}[-1]; {a}[1:]; {a}[:-1]; {a}[..., 0]; {a}[:, 0]; {a}[:, None]; {a}[None]; {a}[::2]; {a}[0, 1:]; {a}[..., -1:]; {a}[{a} > 0]
{a}[[0, 1]]; {a}[True]; {a}.mm({b}); T.matmul({a}, {b}); T.dot({a}, {b}); {a} @ {a}.transpose(-1, -2); T.outer({a}, {b})
{a}.float(); {a}.double(); {a}.long(); {a}.bool(); {a}.to(T.float64); {a}.to({b}.dtype); {a}.type_as({b}); {a}.half()
{a}.bfloat16(); T.zeros_like({a}); T.ones_like({a}, dtype=T.float64); T.full_like({a}, 2.5); {a}.new_zeros(2)
T.tensor({a}.tolist()); T.tensor([{a}.sum(), 2.0]); T.stack(list({a})); T.tensor(len({a})); T.tensor({a}.shape)
T.tensor(float({a})); T.tensor({a}.item()); T.tensor(int({a})); T.arange({a}.shape[0]); T.linspace(0, 1, 5); T.eye(3)
T.full((2,), True); T.tensor(bool({a})); T.tensor([float(v) for v in {a}]); sum({a}); T.tensor(1 if {a}.any() else 0)
T.arange(0, 1, 0.3); T.arange(3, 0, -1); {a} + [1, 2]; {a} + None; F.logsigmoid({a}); F.softplus({a}); F.softmax({a}, dim=-1)
F.log_softmax({a}, {d}); F.relu({a}); F.mse_loss({a}, {b}); F.l1_loss({a}, {b}, reduction="sum"); F.smooth_l1_loss({a}, {b})
F.huber_loss({a}, {a} * 0.3, delta=0.5); F.binary_cross_entropy_with_logits({a}.double(), {a}.double()); F.one_hot({i}, 4)
F.pad({a}, (1, 0)); F.pad({a}, (0, 1), value=2.0); F.normalize({a}, dim=-1); {a}.foo; T.foo({a}); T.stack([]); T.exp(2.0)
T.sum([1, 2]); {a} * "a"; T.exp({a}, foo=1); T.corrcoef({a}); T.cov({a}); T.xlogy({a}, {b}); F.silu({a}); T.lerp({a}, {b}, 0.3)
T.logaddexp({a}, {b}); {a}.index_select(0, {i}); T.hstack([{a}, {b}]); {a}.scatter(0, {i}, 1.0)
"""
CHANGES = """
{a} += {b}; {a} -= 1; {a} *= {b}; {a} /= 2; {a} **= 2; {a}[0] = {b} * 1; {a}[0] = 1.5; {a}[:, 0] = 0; {a}[{m}] = 0
{a}[{m}] = {b} * 1; {a}[{i}] = 2; {a}[1:] += 1; {a}[..., -1] *= 2; {a}.add_({b}); {a}.mul_(0.5); {a}.clamp_(min=0); {a}.zero_()
{a}.fill_(2); {a}.exp_(); {a}.masked_fill_({m}, 1); {a}[{a} > 0] = 0; {a}[:-1] = {a}[1:]; {a}[0] += {b}; {a}.relu_()
{a}.sigmoid_(); {a}.sub_({b}, alpha=2); {a}.T[0] = 3; {a}.view(-1)[0] = 7; {a}[:] = {b} * 1; {a}[None][0] = 2; {a}[..., 0] = {b}
{a}.squeeze()[0] = 1; {a}.detach().add_(1); {a}.div_({b}); {a}[-1] -= {b}; {a}.unsqueeze(0).mul_(2); {a}.t().add_({b})
{a}.sqrt_(); {a}.pow_(2); {a}.tanh_(); {a}.neg_(); {a}.abs_()
"""


def _listed(table: str) -> list[str]:
    return [entry.strip() for line in table.strip().splitlines() for entry in line.split(";")]


@dataclass(frozen=True)
class Tensor:
    """What a tensor is made of, in either torch."""

    entries: tuple
    shape: tuple[int, ...]
    kind: str

    def made(self, library: Any) -> Any:
        return library.tensor(list(self.entries), dtype=getattr(library, self.kind)).reshape(self.shape)


@dataclass(frozen=True)
class Program:
    """Statements over tensors x, y, z, a mask m and indices i; `r` is what comes out. With `graph`, x, y and z are computed from leaves."""

    statements: tuple[str, ...]
    tensors: tuple[tuple[str, Tensor], ...]
    graph: bool

    @property
    def is_rough(self) -> bool:
        text = " ".join(self.statements)
        return "half" in text or "bfloat16" in text

    @property
    def is_single(self) -> bool:
        return "float()" in " ".join(self.statements) or any(one.kind == "float32" for _, one in self.tensors)


VALUES = (0.0, 1.0, -1.0, 2.0, 0.5, -0.5, 3.0, -2.0, 1.5, 0.1, -0.3, 0.7, 100.0)
STRANGE = (math.inf, -math.inf, math.nan)


def drawn(rng: random.Random, *, steps: int = 1, strange: bool = False) -> Program:
    """A random program of so many statements."""

    def number(kind: str) -> Any:
        if kind == "bool":
            return rng.random() < 0.5
        if kind == "int64":
            return rng.choice((0, 1, 2, 3, 5, -1, -3))
        if strange and rng.random() < 0.3:
            return rng.choice(STRANGE)
        return rng.choice(VALUES) if rng.random() < 0.5 else rng.gauss(0, 1)

    def tensor(kind: str, shape: tuple[int, ...]) -> Tensor:
        return Tensor(tuple(number(kind) for _ in range(math.prod(shape))), shape, kind)

    shape = tuple(rng.choice((1, 1, 2, 2, 3, 3, 0)) for _ in range(rng.choice((0, 1, 1, 2, 2, 3))))

    def related() -> tuple[int, ...]:
        if rng.random() < 0.6 or not shape:
            return shape
        changed = list(shape)
        place = rng.randrange(len(changed))
        changed[place] = rng.choice((1, changed[place], changed[place], 2))
        return tuple(changed[rng.random() < 0.3 :])

    kind = rng.choice(("float64",) * 6 + ("float32",) * 3 + ("int64",) * 2 + ("bool",))
    other = kind if rng.random() < 0.7 else rng.choice(("float64", "float32", "int64"))
    highest = max(shape[0], 1) if shape else 1
    places = tensor("int64", related() if rng.random() < 0.5 else (2,))
    index = Tensor(tuple(rng.randrange(highest) for _ in places.entries), places.shape, "int64")
    tensors = {"x": tensor(kind, shape), "y": tensor(other, related()), "z": tensor(kind, related())}
    tensors |= {"m": tensor("bool", related()), "i": index}
    names, statements = ["x", "y", "z"], []

    def filled(template: str) -> str:
        a, b, c = (rng.choice(names) for _ in range(3))
        return template.format(a=a, b=b, c=c, m="m", i="i", d=rng.choice((0, 0, -1, -1, 1, -2)))

    for _ in range(steps - 1):
        if rng.random() < 0.5:
            statements.append(filled(rng.choice(_CHANGES)))
        else:
            names.append(rng.choice("uvw"))
            statements.append(f"{names[-1]} = {filled(rng.choice(_FUNCTIONS))}")
            names = [name for name in names if name in "xyz"] + [name for name in names if name not in "xyz"]
            if " = " + names[-1] in statements[-1]:  # nothing is defined by itself
                statements[-1] = f"{names[-1]} = x"
    statements.append(f"r = {filled(rng.choice(_FUNCTIONS))}")
    return Program(tuple(statements), tuple(tensors.items()), rng.random() < 0.6)


_FUNCTIONS, _CHANGES = _listed(FUNCTIONS), _listed(CHANGES)


@dataclass
class Ran:
    """What a program came to: an error, or entries with kind and shape, gradients (or the error instead), and the inputs afterwards."""

    error: str = ""
    message: str = ""
    kind: str = ""
    shape: tuple[int, ...] = ()
    entries: Any = None
    graph: bool = False
    gradients: Any = None
    inputs: dict[str, list] | None = None

    @property
    def is_told_to_go_elsewhere(self) -> bool:
        return self.error == "Missing" or (isinstance(self.gradients, Ran) and self.gradients.error == "Missing")


def ran(library: Any, program: Program) -> Ran:
    """Run a program on a torch."""
    leaves, namespace = {}, {"T": library, "F": library.nn.functional}
    for name, one in program.tensors:
        leaf = one.made(library)
        leaves[name] = leaf
        if program.graph and leaf.is_floating_point():
            leaf.requires_grad_()
        namespace[name] = leaf.clone()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for statement in program.statements:
                exec(statement, namespace)
        except Exception as error:
            return Ran(type(error).__name__, str(error).partition("\n")[0])
        result = namespace["r"]
        if not isinstance(result, library.Tensor):
            return Ran(kind=type(result).__name__, entries=[result])
        found = Ran("", "", str(result.dtype), tuple(result.shape), _flat(result), result.requires_grad)
        if result.requires_grad:
            weights = library.arange(result.numel(), dtype=result.dtype).cos().reshape(result.shape)
            asked = [leaf for leaf in leaves.values() if leaf.requires_grad]
            try:
                back = library.autograd.grad([result], asked, [weights], allow_unused=True)
                found.gradients = [None if one is None else (str(one.dtype), _flat(one)) for one in back]
            except Exception as error:
                found.gradients = Ran(type(error).__name__, str(error).partition("\n")[0])
    found.inputs = {name: _flat(namespace[name]) for name, _ in program.tensors}
    return found


def _flat(tensor: Any) -> list:
    return tensor.detach().reshape(-1).tolist()


def difference(program: Program) -> str:
    """How the page's torch differs from the real one, in words; "" if it does not, or says that it lacks something."""
    here, right = ran(page, program), ran(torch, program)
    if here.is_told_to_go_elsewhere:
        return ""
    if here.error != right.error:
        return f"raises {here.error or 'nothing'} {here.message}, torch {right.error or 'nothing'} {right.message}"
    if right.error:
        listed = any(start in right.message for start in SAME_TEXT)
        same = sorted(here.message.split()) == sorted(right.message.split())  # which of two operands is called a is no matter
        return f"says {here.message!r}, torch {right.message!r}" if listed and not same else ""
    near, far = (
        (2e-2, 1e-2) if program.is_rough else (3e-5, 1e-5) if program.is_single or "float32" in right.kind else (1e-11, 1e-12)
    )
    if (here.kind, here.shape, here.graph) != (right.kind, right.shape, right.graph):
        return f"gives {(here.kind, here.shape, here.graph)}, torch {(right.kind, right.shape, right.graph)}"
    if not _all_close(here.entries, right.entries, near, far):
        return f"gives {here.entries}, torch {right.entries}"
    for name, after in (right.inputs or {}).items():
        if not _all_close((here.inputs or {})[name], after, near, far):
            return f"leaves {name} as {(here.inputs or {})[name]}, torch as {after}"
    return _gradients_differ(here.gradients, right.gradients, max(20 * near, 1e-9), max(20 * far, 1e-9))


def _gradients_differ(here: Any, right: Any, near: float, far: float) -> str:
    if isinstance(here, Ran) or isinstance(right, Ran):
        if not (isinstance(here, Ran) and isinstance(right, Ran)) or here.error != right.error:
            return f"gradient: {here}, torch: {right}"
        return ""
    for mine, theirs in zip(here or [], right or [], strict=True):
        if mine is None or theirs is None:
            entries = (mine or theirs or ("", []))[1]
            if any(entries):  # a gradient of zeros is as good as none
                return f"gradient {mine}, torch {theirs}"
        elif mine[0] != theirs[0] or not _all_close(mine[1], theirs[1], near, far):
            return f"gradient {mine}, torch {theirs}"
    return ""


def _all_close(here: list, right: list, near: float, far: float) -> bool:
    return len(here) == len(right) and all(_close(a, b, near, far) for a, b in zip(here, right, strict=True))


def _close(a: Any, b: Any, near: float, far: float) -> bool:
    if a is b or a == b:
        return True
    if not isinstance(a, int | float) or not isinstance(b, int | float):
        return False
    if a != a or b != b:
        return a != a and b != b
    if isinstance(a, int) and isinstance(b, int):
        return False
    return abs(a) != math.inf and abs(b) != math.inf and abs(a - b) <= far + near * max(abs(a), abs(b))
