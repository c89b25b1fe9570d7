"""Who sets which names, and who needs them."""

import ast
import functools

import pytest

from course_lib.checks import names
from course_lib.checks.notebook import Stop, needed, new_namespace, run_cell


@pytest.fixture(autouse=True)
def _main_module(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import a.b, c as d\nfrom e import f, g as h", "a d f h"),
        ("x, (y, *z) = 1, 2\nw: int = 3\nv += 1", "x y z w v"),
        ("for i in j:\n    k = 1\nwith l as m:\n    n = 1\nif (o := 1): pass", "i k m n o"),
        ("def p(q):\n    r = 1\nclass S:\n    t = 1\nu = [x for x in y]", "p S u"),
        ("from a import *", "*"),
        ("get_ipython().run_line_magic('run', 'x.py')", "*"),
    ],
)
def test_names_that_statements_set(source, found):
    assert names.set_by(ast.parse(source).body) == set(found.split())


def test_names_of_what_cannot_be_parsed():
    source = "import a as b\nfrom c import d\ndef e(:\n    f = 1\nclass G\nh == 1"
    assert {"b", "d", "e", "f", "G"} <= names.roughly_set_by(source) and "h" not in names.roughly_set_by(source)


def test_what_a_function_uses_with_all_that_it_calls_and_wraps():
    space = new_namespace()
    run_cell(
        "import functools\ndef deep(): return [missing for _ in range(3)]\nclass A:\n    def g(self): return deep() + print(one)\n"
        "def wrapped(f):\n    def inner(*x): return f(*x) + two\n    return inner\n@wrapped\ndef f(x):\n    A().g(); return len(x)\n"
        "h = functools.partial(f, 1)\n",
        space,
    )
    assert set(names.used_by(space["h"], space)) == {"A", "deep", "missing", "one", "two"}
    assert names.used_by(functools.partial(print), space) == names.used_by(3, space) == []


def test_a_cell_is_needed_for_the_names_that_it_sets():
    stops = {1: Stop(1, "E", ("a", "b")), 2: Stop(1, "E", ("*",)), 3: Stop(1, "E", ("f",)), 4: Stop(1, "E", ("c",))}
    assert needed(stops, "f", ["a"]) == [1, 3]
    assert needed(stops, "f", [], "NameError: name 'c' is not defined") == [2, 3, 4]
