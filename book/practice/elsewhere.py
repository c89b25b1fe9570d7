"""What a cell imports and the page does not have: a stand-in that can be named, and says so when it is used.

`import numpy as np` works, `np.pi` too, and `np.array([1.0])` says that numpy is in the notebook.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import math
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

from torch import missing  # type: ignore[attr-defined]  # of the page's torch

PACKAGES = (
    *(
        "numpy",
        "scipy",
        "pandas",
        "matplotlib",
        "sklearn",
        "gymnasium",
        "transformers",
        "safetensors",
        "pyarrow",
        "huggingface_hub",
    ),
    *("_multiprocessing", "sqlite3", "tkinter", "curses"),  # Python's own, which are not in every Python
    *("threadpoolctl", "IPython", "ipywidgets", "seaborn", "tqdm", "einops", "jax", "vaderSentiment", "course_lib", "torch"),
)
"""What a notebook of the course may import; of any other name Python says that there is no such module, as it does there."""

SYSTEM = {
    "builtins": {"input": "input", "breakpoint": "breakpoint"},
    "threading": {"Thread.start": "threading.Thread"},
    "_thread": {"start_new_thread": "_thread.start_new_thread"},
    "subprocess": {"Popen.__init__": "subprocess.Popen"},
    "os": {"system": "os.system", "popen": "os.popen", "fork": "os.fork"},
}
"""What Python asks the system for, which a page can't give: by module, where it stands and what it is called."""

NUMBERS = {"pi": math.pi, "e": math.e, "inf": math.inf, "nan": math.nan, "newaxis": None}


class StandIn(type):
    """The type of a stand-in, which is a class: it may stand in annotations, in `isinstance`, and as a base. Anything else is a use."""

    lenient = False
    """Whether uses give further stand-ins, as when modules are read of which only a few functions are wanted."""

    def _used(cls, *_args: Any, **_kwargs: Any) -> Any:
        if StandIn.lenient:
            return cls
        raise missing.Missing(cls.what, cls.where)  # type: ignore[attr-defined]

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        return cls._used()

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return stand_in(cls.what, cls.where) if StandIn.lenient else cls._used()  # type: ignore[attr-defined]

    def __instancecheck__(cls, value: Any) -> bool:
        return False

    __iter__ = __len__ = __bool__ = __float__ = __int__ = __index__ = __getitem__ = __neg__ = __invert__ = _used
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __pow__ = __rpow__ = _used
    __matmul__ = __rmatmul__ = __lt__ = __le__ = __gt__ = __ge__ = __enter__ = __exit__ = _used


def stand_in(what: str, where: str = "the page") -> StandIn:
    """For `what`, which is not in `where`."""
    return StandIn(
        what.rpartition(".")[2], (), {"what": what, "where": where, "__init_subclass__": classmethod(lambda cls, **_kw: None)}
    )


class _Module(ModuleType):
    """A module of stand-ins. Those of torch and of the course are named in full; of numpy, numpy."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        package = self.__name__.partition(".")[0]
        if package == "numpy" and name in NUMBERS:
            return NUMBERS[name]
        if package == "torch":
            return stand_in(f"{self.__name__}.{name}", "the page's torch")
        return stand_in(f"{self.__name__}.{name}" if package == "course_lib" else package.lstrip("_"))


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        if name.partition(".")[0] in PACKAGES:
            return importlib.machinery.ModuleSpec(name, self, is_package=True)
        return None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        return _Module(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """There is nothing in it."""


def _refused(what: str) -> Callable:
    def function(*_args: Any, **_kwargs: Any) -> Any:
        raise missing.Missing(what, "the page")

    return function


def install() -> None:
    """From now on, what is imported and not found is stood in for, if it is one of PACKAGES, and SYSTEM is refused in our words."""
    if any(isinstance(finder, _Finder) for finder in sys.meta_path):
        return
    for module, names in SYSTEM.items():
        for place, what in names.items():
            owner, _, name = place.rpartition(".")
            found = importlib.import_module(module)
            setattr(getattr(found, owner) if owner else found, name, _refused(what))
    sys.meta_path.append(_Finder())
