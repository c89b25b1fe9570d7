"""Which names a cell sets and a function uses: who needs whom, and what will not be there.

A cell that can't be parsed is read line by line, roughly.
"""

from __future__ import annotations

import ast
import builtins
import functools
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

WORD = re.compile(r"[^\W\d]\w*")
SETS = re.compile(
    r"^[ \t]*(?:(?:async[ \t]+)?(?:def|class)[ \t]+(\w+)|(\w+)[ \t]*=[^=]|(?:from|import)[ \t]+([^\n#]*))", re.MULTILINE
)
RUNS_A_FILE = ("get_ipython().run_line_magic('run'", "get_ipython().run_line_magic('pylab'")
MOST = 500
"""Names of one cell or function; honest ones have a tenth of it."""


def set_by(statements: Sequence[ast.stmt]) -> set[str]:
    """The names that these statements set where they stand; "*" for those of a module or a file that is run."""
    names: set[str] = set()
    for node in at_this_level(statements):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node).startswith(RUNS_A_FILE):
            names.add("*")
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return names


def roughly_set_by(source: str) -> set[str]:
    """The same of a cell that can't be parsed."""
    return {name for groups in SETS.findall(source) for group in groups for name in WORD.findall(group)}


def at_this_level(statements: Sequence[ast.AST]) -> Iterator[ast.AST]:
    """All nodes but those in the bodies of functions, classes and comprehensions."""
    waiting: list[ast.AST] = list(statements)
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Lambda | ast.comprehension):
            waiting += ast.iter_child_nodes(node)


def wanted_of(live: Sequence[ast.stmt], own: Sequence[ast.stmt]) -> set[str]:
    """The names that `own` statements use and do not set, and those that the `live` ones use which set one of them, and so on.

    >>> live = ast.parse("import numpy as np; import seaborn; rows = 3\\ndef total(x):\\n    return np.sum(x)")
    >>> own = ast.parse("answer = lambda seaborn: total(seaborn)  # not seaborn itself")
    >>> sorted(wanted_of(live.body, own.body) - {"answer"})
    ['np', 'total']
    """
    wanted = used_in(own) - set_by(own)
    left = [(set_by([statement]), statement) for statement in live]
    while found := [statement for names, statement in left if names & wanted]:
        left = [(names, statement) for names, statement in left if not names & wanted]
        wanted |= used_in(found)
    return wanted


def used_in(statements: Sequence[ast.stmt]) -> set[str]:
    """The names that these statements and the functions in them take from the notebook."""
    used: set[str] = set()
    for statement in statements:
        with suppress(SyntaxError, ValueError, RecursionError):
            flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
            code = compile(ast.Module([statement], []), "", "exec", flags, dont_inherit=True)
            used.update(_global_names(code))
    return used


def used_by(function: Any, namespace: Mapping[str, Any]) -> list[str]:
    """The names of the namespace that a function uses, and what it calls there: those that are missing, too; built-in ones not."""
    used: dict[str, None] = {}
    seen: set[int] = set()
    waiting = [function]
    while waiting and len(used) < MOST:
        thing = waiting.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        for code in _codes(thing, namespace):
            names = [
                name for name in _global_names(code) if name not in used and (name in namespace or not hasattr(builtins, name))
            ]
            used |= dict.fromkeys(names)
            waiting += [namespace[name] for name in names if name in namespace]
        waiting += _parts(thing)
    return list(used)


def _codes(thing: Any, namespace: Mapping[str, Any]) -> list[types.CodeType]:
    """The code of a function or of a class's methods that were written in the namespace."""
    functions = list(vars(thing).values()) if type(thing) is type else [thing]
    functions = [getattr(one, "__func__", one) if isinstance(one, staticmethod | classmethod) else one for one in functions]
    return [one.__code__ for one in functions if isinstance(one, types.FunctionType) and one.__globals__ is namespace]


def _parts(thing: Any) -> list[Any]:
    """What a function wraps."""
    if isinstance(thing, functools.partial):
        return [thing.func]
    if isinstance(thing, types.MethodType):
        return [thing.__func__, type(thing.__self__)]
    if isinstance(thing, types.FunctionType):
        return [cell.cell_contents for cell in thing.__closure__ or () if _is_full(cell)]
    return [vars(thing)["__wrapped__"]] if "__wrapped__" in getattr(thing, "__dict__", {}) else []


def _is_full(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is not None
    except ValueError:
        return False


def _global_names(code: types.CodeType) -> list[str]:
    import dis

    names = [one.argval for one in dis.get_instructions(code) if one.opname in ("LOAD_GLOBAL", "LOAD_NAME")]
    inner = [name for constant in code.co_consts if isinstance(constant, types.CodeType) for name in _global_names(constant)]
    return [name for name in (*names, *inner) if not name.startswith("__")]
