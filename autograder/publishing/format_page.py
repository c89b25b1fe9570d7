"""The appendix on the format of a chapter: written from the tables by which chapters are read, and from the docstrings of what checks use.

`python -m autograder.publishing.format_page` prints it. Modules are looked at and not imported, so that this takes no time.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping
from pathlib import Path

from autograder.authoring import chapter, markdown
from autograder.authoring.chapter import Option
from autograder.paths import COURSE_LIB, ROOT

TYPES = {int: "a number", str: "text", list: "a list", (int, float): "a number"}
PATTERN = """````markdown
### A heading, which becomes the exercise's

The task, with maths $x$, a source {cite:p}`schulman2016`, and an equation that has a number:

$$
\\delta_t = r_t + \\gamma V(s_{t+1}) - V(s_t)
$$ (residual)

```{code-cell} ipython3
---
exercise: td_residuals
difficulty: 1
minutes: 10
---
def td_residuals(rewards, values, gamma):
    \"\"\"The docstring of the solution, letter for letter.

        δ_t = r_t + γ V(s_{t+1}) - V(s_t)

    Args:
      rewards, values: (T,).
      gamma: discount per step.

    Returns: (T - 1,) residuals.
    \"\"\"
    raise NotImplementedError
```

:::{dropdown} Hint 1 for td_residuals: where the mask goes
Which of the terms of {eq}`residual` loses its meaning when nothing follows the step?
:::

```{code-cell} ipython3
---
tags: [live]
alt: Residuals against time; they are large where the episode ends.
---
plt.plot(residuals)
plt.show()
```

:::{margin}
A thought beside the text, on [chapter 43](chapter:43) and the [notation](appendix:notation).
:::

:::{quiz} What does a residual of zero say?
- [x] the critic foresaw this step: What came is what it had promised.
- [ ] the critic is right: It may be wrong by the same amount in both states.
:::

+++ {"open_question": "why_residuals", "points": 2}

Why are residuals of a perfect critic not zero?

*Write your answer here.*
````"""


def format_page() -> str:
    """The page, in MyST."""
    sections = [
        "# The format of a chapter",
        "Whoever writes a chapter finds here all that its file may hold; anything else is refused, with file and line. `CONTRIBUTING.md`"
        " says how a chapter is added, and [the page for contributors](how-to/contributors.md) adds one.",
        "All that chapters have, once:",
        PATTERN,
        "The paragraph of a docstring that is indented further is its formula, with indices as in `s_{t+1}`. It goes to the"
        " {doc}`cheat sheet <cheat-sheet>` with the first sentence and all shapes; repairs (`repaired_…`) and procedures, which are handed"
        " a policy, an environment or a network, are left out there.",
        "## Front matter",
        _options(chapter.FRONT_MATTER | chapter.OPTIONAL, optional=chapter.OPTIONAL),
        "## Options of a code cell",
        _options(chapter.OPTIONS),
        "## Tags of a code cell",
        _table(("Tag", "What it does"), chapter.TAGS.items()),
        "A cell without a tag sets up what exercises use, such as imports: it runs when work is graded, too.",
        "## Questions for a person",
        _options(chapter.QUESTION),
        f"A question is a text that begins with `+++ {{…}}` and these, and ends with the line `{chapter.ANSWER_LINE}`",
        "## Directives",
        _table(("Directive", "What it makes"), markdown.DIRECTIVES.items()),
        "They are written with colons, outer ones with more of them than inner ones, and may begin with options, `:class: dropdown`.",
        _table(("Option", "What it does"), markdown.OPTIONS.items()),
        "## Roles",
        _table(("Role", "What it gives"), markdown.ROLES.items()),
        "## What checks are made of",
        "A case's arguments are tensors, plain data, or made where the function runs; a function of an earlier chapter is taken over.",
        _functions({"course_lib.checks.cases": ["built"], "course_lib.chapters": ["earlier"]}),
        "For solutions, `course_lib.validate` refuses bad input with an error that names the argument:",
        _functions({"course_lib.validate": []}),
        "`autograder.authoring.parts` has the inputs, cases and misconceptions that many exercises share:",
        _functions({"autograder.authoring.parts": []}),
        "Where many answers are right, a case's `view` names what they have in common:",
        _functions({"course_lib.checks.views": []}),
    ]
    return "\n\n".join(sections) + "\n"


def _options(known: Mapping[str, Option], optional: Iterable[str] = ()) -> str:
    rows = [
        (name, f"{TYPES[option.type]}{', or left out' if name in optional else ''}", option.says)
        for name, option in known.items()
    ]
    return _table(("Name", "Value", "What it says"), rows)


def _functions(wanted: Mapping[str, Iterable[str]]) -> str:
    return _table(("Function", "What it does"), [entry for module, names in wanted.items() for entry in functions(module, names)])


def functions(module: str, names: Iterable[str] = ()) -> list[tuple[str, str]]:
    """The public functions of a module of the project (or some of them), and the first paragraph of each one's docstring."""
    tree = ast.parse(_file(module).read_text(encoding="utf-8"))
    found = [node for node in tree.body if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")]
    chosen = [node for node in found if not names or node.name in names]
    return [(node.name, " ".join((ast.get_docstring(node) or "").partition("\n\n")[0].split())) for node in chosen]


def _file(module: str) -> Path:
    package, *path = module.split(".")
    return {"course_lib": COURSE_LIB}.get(package, ROOT / package).joinpath(*path).with_suffix(".py")


def _table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A table whose first column is code."""
    lines = [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
    return "\n".join(lines + [f"| `{name}` | {' | '.join(_cell(part) for part in rest)} |" for name, *rest in rows])


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    print(format_page())
