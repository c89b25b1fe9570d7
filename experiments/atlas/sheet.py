"""What a library's script uses, in the library's own environment: the input, and a place to put rows. Nothing but the standard library.

A script says `from sheet import given, row`. `given.rewards` is a list (experiments/atlas/given.py says of what). `row` prints one line
of JSON for the runner; what a library itself prints goes to standard error, so that no line can be mistaken for another.
"""

from __future__ import annotations

import ast
import json
import os
import sys
from types import SimpleNamespace

_out = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
sys.stdout = sys.stderr

given = SimpleNamespace(**json.loads(os.environ.get("ATLAS_GIVEN", "{}")))


def row(formula, numbers, call, source, setting="", note="", tolerance=None):
    """One result of the library.

    Args:
      formula: its name in experiments/atlas/given.py.
      numbers: a number, a list of them or of lists, or anything with `tolist()`.
      call: what was called.
      source: the library's file that holds it, as installed.
      setting: how it was set, where there are several ways.
      note: one sentence, if one is needed.
      tolerance: if another than the usual one will do, the note says why.
    """
    entry = {"formula": formula, "setting": setting, "numbers": _plain(numbers), "call": call, "source": source, "note": note}
    print(json.dumps(entry | ({} if tolerance is None else {"tolerance": tolerance})), file=_out, flush=True)


def _plain(numbers):
    if hasattr(numbers, "detach"):
        numbers = numbers.detach()
    if hasattr(numbers, "tolist"):
        numbers = numbers.tolist()
    return [_plain(one) for one in numbers] if isinstance(numbers, list | tuple) else float(numbers)


def statements(path, chosen, names):
    """Run those statements of a library's file for which `chosen(text)` holds, on our values: for code that is no function of its own.

    Args:
      path: the file, as installed.
      chosen: is given each statement's source, outermost first; what is chosen is not looked into.
      names: what the statements read, and where they leave what they bind.
    """
    text = _text(path)
    found, lines = [], text.splitlines(keepends=True)

    def look(node):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.stmt) and chosen(_source(lines, child)):
                found.append(child)
            else:
                look(child)

    look(ast.parse(text))
    if not found:
        raise LookupError(f"{path} has no such statement")
    exec(compile(ast.Module(found, []), path, "exec"), names)
    return names


def function(path, name, names):
    """A function, method or class of a library's file that can't be imported whole, built from that file with these globals."""
    text = _text(path)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            node.decorator_list = []
            exec(compile(ast.Module([ast.parse("from __future__ import annotations").body[0], node], []), path, "exec"), names)
            return names[name]
    raise LookupError(f"{path} has no {name}")


def _source(lines, node):
    """As ast.get_source_segment, which would split the file anew each time."""
    return "".join(lines[node.lineno - 1 : node.end_lineno])[node.col_offset :]


def _text(path):
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except FileNotFoundError:
        raise LookupError(f"{str(path).rpartition('site-packages/')[2]}: this version has no such file") from None


def installed(package, *parts):
    """A file of an installed package, which is not imported."""
    import importlib.util

    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise LookupError(f"{package} is not installed")
    return os.path.join(next(iter(spec.submodule_search_locations)), *parts)
