"""What keeps a cell from compiling though its author did nothing wrong: spaces from web pages, and syntax newer than this Python.

Neither is looked for in a cell that compiles.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable

LITERAL = re.compile(
    r"#[^\n]*|(?:'''(?:\\.|[^\\])*?'''|\"\"\"(?:\\.|[^\\])*?\"\"\"|'(?:\\.|[^\\\n'])*'|\"(?:\\.|[^\\\n\"])*\")", re.DOTALL
)
SPACES = re.compile("[\u00a0\u1680\u2000-\u200a\u202f\u205f\u3000]")
WIDTHLESS = re.compile("[\u200b-\u200d\u2060\ufeff]")
PREFIXES = re.compile(r"(?<!\w)(?:[fF][rR]?|[rR][fF]|[tT][rR]?|[rR][tT])(?='''|\"\"\"|'|\")")
PARAMETERS = re.compile(r"^([ \t]*(?:async[ \t]+def|def|class)[ \t]+\w+[ \t]*)\[", re.MULTILINE)
TYPE_STATEMENT = re.compile(r"^([ \t]*)type[ \t]+(\w+)[ \t]*(?==(?!=)|\[)", re.MULTILINE)
EXCEPT = re.compile(r"^([ \t]*except\*?[ \t]+)([^\n():#]+(?:,[^\n():#]+)+):", re.MULTILINE)
LONGEST = 100_000  # characters of a cell in which newer syntax is looked for
BRACKETS = {"(": ")", "[": "]", "{": "}"}


def with_plain_spaces(source: str) -> str:
    """The source with every odd space outside of strings and comments made a plain one, and those without width gone."""
    pieces, at = [], 0
    for found in LITERAL.finditer(source):
        pieces += [WIDTHLESS.sub("", SPACES.sub(" ", source[at : found.start()])), found.group()]
        at = found.end()
    return "".join([*pieces, WIDTHLESS.sub("", SPACES.sub(" ", source[at:]))])


def newer(source: str) -> str:
    """The version of Python that reads a source which this one does not, such as "3.12"; "" if none is known that would.

    Each kind of newer syntax is written in the older one; if the source is read then, that was all that was wrong with it.

    >>> newer('f"{names["a"]}"') in ("3.12", "")  # "" where Python reads it itself
    True
    >>> newer('print("a"')
    ''
    """
    if len(source) > LONGEST or _is_read(source):
        return ""
    rewritings: tuple[tuple[str, Callable[[str], str]], ...] = (
        ("3.12", lambda text: _without_templates(text, "fF")),
        ("3.12", _without_type_parameters),
        ("3.14", lambda text: EXCEPT.sub(r"\1(\2):", text)),
        ("3.14", lambda text: _without_templates(text, "tT")),
    )
    for version, rewrite in rewritings:
        try:
            source = rewrite(source)
        except (ValueError, RecursionError):  # what looked like newer syntax is not
            continue
        if _is_read(source):
            return version
    return ""


def _is_read(source: str, mode: str = "exec") -> bool:
    try:
        compile(source, "", mode, ast.PyCF_ONLY_AST | ast.PyCF_ALLOW_TOP_LEVEL_AWAIT, dont_inherit=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    return True


# ------------------------------------------------------------------------------------ f-strings and t-strings


def _without_templates(source: str, kinds: str) -> str:
    """The source with an empty string for every f-string (or t-string). ValueError if one has no end or holds no expressions."""
    pieces, at = [], 0
    while at < len(source):
        prefix = PREFIXES.match(source, at)
        if prefix and set(prefix.group()) & set(kinds):
            end = _end_of_template(source, prefix.end(), kinds)
            pieces.append('""')
            at = end
            continue
        literal = LITERAL.match(source, at)
        end = literal.end() if literal else at + 1
        pieces.append(source[at:end])
        at = end
    return "".join(pieces)


def _end_of_template(source: str, at: int, kinds: str) -> int:
    """The position after a template whose quotes begin at `at`."""
    quotes = source[at] * 3 if source.startswith(source[at] * 3, at) else source[at]
    at += len(quotes)
    while not source.startswith(quotes, at):
        if at >= len(source) or (source[at] == "\n" and len(quotes) == 1):
            raise ValueError("a string without an end")
        if source[at] == "\\" or source.startswith(("{{", "}}"), at):
            at += 2
        elif source[at] == "{":
            at = _end_of_field(source, at + 1, quotes, kinds)
        else:
            at += 1
    return at + len(quotes)


def _end_of_field(source: str, at: int, quotes: str, kinds: str) -> int:
    """The position after the brace that closes a field whose expression begins at `at`; it must be an expression."""
    start, open_brackets = at, []
    while at < len(source):
        here = source[at]
        literal = LITERAL.match(source, at)
        prefix = PREFIXES.match(source, at)
        if prefix:
            at = _end_of_template(source, prefix.end(), "fFtT")
        elif literal:
            at = literal.end()
        elif here in BRACKETS:
            open_brackets.append(BRACKETS[here])
            at += 1
        elif open_brackets:
            if here in ")]}" and open_brackets.pop() != here:
                raise ValueError("brackets that do not match")
            at += 1
        elif here in ":}" or (here == "!" and source[at + 1 : at + 2] != "="):
            expression = re.sub(r"(?<![=!<>])=\s*$", "", source[start:at].strip())
            if not expression or not _is_read(f"({_without_templates(expression, kinds)}\n)", "eval"):
                raise ValueError("no expression")
            return _end_of_format(source, at, quotes, kinds)
        else:
            at += 1
    raise ValueError("a field without an end")


def _end_of_format(source: str, at: int, quotes: str, kinds: str) -> int:
    """The position after the brace that closes a field whose `!r` and `:format` begin at `at`."""
    while at < len(source) and source[at] != "}":
        if source.startswith(quotes, at):
            raise ValueError("a field without an end")
        at = _end_of_field(source, at + 1, quotes, kinds) if source[at] == "{" else at + 1
    return at + 1


# ------------------------------------------------------------------------------------ type parameters


def _without_type_parameters(source: str) -> str:
    """`def f[T](x)` as `def f(x)`, and `type X[T] = Y` as `X = Y`."""
    source = TYPE_STATEMENT.sub(lambda found: f"{found[1]}class {found[2]}" if found.end() < len(source) and
                                source[found.end()] == "[" else f"{found[1]}{found[2]} ", source)  # fmt: skip
    while found := PARAMETERS.search(source):
        end = _end_of_brackets(source, found.end())
        rest = re.compile(r"[ \t]*=").match(source, end)
        head = re.sub(r"class[ \t]+(\w+)[ \t]*$", r"\1", found[1]) if rest else found[1]
        source = source[: found.start()] + head + source[end:]
    return source


def _end_of_brackets(source: str, at: int) -> int:
    """The position after the bracket that closes one that is open before `at`; what is between must be type parameters."""
    start, depth = at, 1
    while at < len(source) and depth:
        literal = LITERAL.match(source, at)
        depth += 0 if literal else (source[at] in "([{") - (source[at] in ")]}")
        at = literal.end() if literal else at + 1
    inside = re.sub(r"(^|,)\s*\*{1,2}", r"\1", source[start : at - 1].strip().rstrip(","))
    if depth or not _is_read(f"def _({inside}): pass") or not inside:
        raise ValueError("no type parameters")
    return at
