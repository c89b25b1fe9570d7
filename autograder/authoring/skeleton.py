"""What a new chapter begins with: its files, with a note wherever something must be filled in; and stubs made from solutions."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from autograder import paths

STUB_BODY = "    raise NotImplementedError"


def stub(solution: Path, name: str) -> str:
    """Signature and docstring of a reference, and a body that raises. ValueError if there is no such function, or it has no docstring."""
    source = solution.read_text(encoding="utf-8") if solution.is_file() else ""
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            if ast.get_docstring(node) is None:
                raise ValueError(f"{name} in {solution} has no docstring")
            return "\n".join([*source.split("\n")[node.lineno - 1 : node.body[0].end_lineno], STUB_BODY])
    raise ValueError(f"there is no function {name} in {solution}")


def write(number: int, title: str, names: list[str], root: Path = paths.ROOT) -> list[Path]:
    """Write the files of a new chapter and return them. ValueError, with nothing written, if one exists or a name is no identifier."""
    if wrong := [name for name in names if not re.fullmatch(r"[a-z_]\w*", name)]:
        raise ValueError(f"{wrong[0]!r} is not a function's name")
    if not names or len(set(names)) < len(names):
        raise ValueError("name each exercise once, and one at least")
    words = re.sub(r"\W+", "_", title.lower()).strip("_")
    if not words:
        raise ValueError("a chapter needs a title")
    if taken := sorted((root / "chapters").glob(f"ch{number}_*.md")):
        raise ValueError(f"{taken[0]} exists")
    files = {
        f"solutions/ch{number}.py": _solutions(number, title, names),
        f"autograder/checks/ch{number}.py": _checks(number, title, names),
        f"chapters/ch{number}_{words}.md": _chapter(number, title, names),
        f"tests/solutions/test_ch{number}.py": _tests(number, names),
    }
    for file in files:
        if (root / file).exists():
            raise ValueError(f"{root / file} exists")
    for file, text in files.items():
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_text(text, encoding="utf-8")
    return [root / file for file in files]


def _solutions(number: int, title: str, names: list[str]) -> str:
    functions = "\n\n".join(
        f'def {name}(x):\n    """TODO: one line that says what it computes.\n\n        y = TODO: the formula\n\n'
        f"    Args:\n      x: TODO meaning and shape; (B,).\n\n"
        f'    Returns: (B,) TODO.\n    """\n    return 1 * x  # TODO\n'
        for name in names
    )
    return f'"""Reference solutions of chapter {number}: {title}."""\n\nfrom __future__ import annotations\n\n\n{functions}'


def _checks(number: int, title: str, names: list[str]) -> str:
    exercises = "".join(
        f"""    Exercise(
        name="{name}",
        reference=ch{number}.{name},
        criteria={{"values": 0.75, "dtype": 0.25}},  # TODO points by facet
        cases=(  # TODO: at least three visible ones; edges, single precision, errors
            Case("any numbers", _inputs, visible=True),
            Case("single precision", _inputs, dtype=torch.float32, visible=True),
        ),
        misconceptions=(  # TODO: at least six, each with the sentence that its author should read
            Misconception("negated", lambda x: -ch{number}.{name}(x), "TODO: what to look at."),
        ),
        variants={{"the reference": ch{number}.{name}}},  # TODO: at least four, in other styles
    ),
"""
        for name in names
    )
    return f'''"""Checks of chapter {number}: {title}."""

from __future__ import annotations

from typing import Any

import torch

from autograder.authoring.parts import normal
from autograder.authoring.spec import Case, Exercise, Misconception
from solutions import ch{number}


def _inputs(generator: torch.Generator) -> dict[str, Any]:
    return {{"x": normal(generator, 5)}}  # TODO: the arguments, in double precision


EXERCISES = (
{exercises})
'''


def _chapter(number: int, title: str, names: list[str]) -> str:
    exercises = "".join(
        f"\n### TODO: a heading for {name}\n\nTODO: what to do.\n\n:::{{dropdown}} Hint 1 for {name}\nTODO\n:::\n\n"
        f"```{{code-cell}} ipython3\n---\nexercise: {name}\ndifficulty: 1\nminutes: 10\n---\n```\n"
        for name in names
    )
    return f"""---
jupytext:
  text_representation: {{extension: .md, format_name: myst}}
kernelspec: {{name: python3, display_name: Python 3, language: python}}
chapter: {number}
title: {title!r}
minutes: 60
prerequisites: []
builds: TODO what a reader will have built.
summary: TODO one sentence for the front page.
---

## The idea

TODO: why this is worth an hour.

```{{code-cell}} ipython3
from course_lib import check
```
{exercises}
:::{{quiz}} TODO: a question?
- [x] TODO: the right answer: why it is right.
- [ ] TODO: a wrong one: why it is not.
:::
""".replace("TODO: the right answer:", "The right answer (TODO):").replace("TODO: a wrong one:", "A wrong one (TODO):")


def _tests(number: int, names: list[str]) -> str:
    tests = "\n\n".join(
        f"def test_{name}_by_hand():\n    raise AssertionError('TODO: a case that can be computed by hand')\n" for name in names
    )
    return f'"""Chapter {number}\'s references, by hand."""\n\n\n{tests}'.replace("('TODO", '("TODO').replace("hand')", 'hand")')
