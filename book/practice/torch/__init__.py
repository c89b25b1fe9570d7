"""A torch for the page: tensors, autograd and the operations that this book's exercises meet, in plain Python.

It computes what torch computes, gradients included, on a thousand numbers in a blink, and says what it does not have. Read `autograd`
first: it is all of reverse-mode differentiation. `tensor` has strides and views, `entrywise`, `reductions`, `rows`, `moving`, `views`
and `products` have the operations with their derivatives, `inplace` those that change a tensor, and `names` what torch calls them.
"""

from __future__ import annotations

import typing

from . import names as _names
from .missing import missing as _missing


def __getattr__(name: str) -> typing.Any:
    raise _missing("torch", name)


for _name in [name for name in globals() if not name.startswith("_")]:  # the modules beside this one, and no part of torch
    del globals()[_name]
globals().update(_names.TORCH)
