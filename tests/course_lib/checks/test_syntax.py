"""Newer syntax is told from wrong syntax, and odd spaces from those in strings."""

import sys

import pytest

from course_lib.checks import syntax

NEWER = [
    ('x = f"{d["a"]}"', "3.12"),
    ("f'{\"\\n\".join(a)}'", "3.12"),
    ('f"{f"{f"{1}"}"}" "more"', "3.12"),
    ('f"{x!r:>{w["a"]}} {{no}} {y=}"', "3.12"),
    ('f"""{\n  d["a"]  # a comment\n}"""; y = f"{d["b"]}"', "3.12"),
    ("def f[T: (int, str), *Ts, **P](x: T) -> T:\n    return x", "3.12"),
    ("class C[T](list[T]): pass", "3.12"),
    ("type X = int | str\ntype L[T] = list[T]", "3.12"),
    ("async def f[T](x): await x\ny = await f(1)", "3.12"),
    ("try:\n    pass\nexcept ValueError, TypeError:\n    pass", "3.14"),
    ('t"hello {name}"', "3.14"),
]


@pytest.mark.parametrize(("source", "version"), NEWER)
def test_newer_syntax_is_told_by_its_version(source, version):
    known = sys.version_info >= tuple(map(int, version.split(".")))
    assert syntax.newer(source) == ("" if known else version)


@pytest.mark.parametrize(
    "source",
    [
        'print("a"', 'f"{d["a"}"', 'f"{d["a"]}" + (', "def f[](x): pass", "def f[1](x): pass", "type X == 3", 'f"{}"', 'f"{a b}"',
        'f"{d["a"]', "x = 1 1",
        "for x in range(3)\n  pass", 'print "hello"', 'f"{d["a"] d["b"]}"', "def f[T(x): pass", "def f(x:\n    return x",
        "except ValueError, e:", "if x = 1:\n    pass", 'f"{', "f'", "t'{'", "class C[T:\n    pass", "a = f(x))", "def f:\n    pass",
    ],
)  # fmt: skip
def test_wrong_syntax_is_never_newer(source):
    assert syntax.newer(source) == ""


def test_spaces_from_web_pages_are_plain_but_in_strings_and_comments():
    source = 'x\u00a0= \'\u00a0\' +\u3000"""\u200b"""  #\u00a0c\n\u200b\u00a0\ufeffy'
    assert syntax.with_plain_spaces(source) == 'x = \'\u00a0\' + """\u200b"""  #\u00a0c\n y'
