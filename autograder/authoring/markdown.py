"""The chapters' Markdown: which MyST directives and roles they may use, and how the book and the notebooks write them.

`render(text, dialect)` walks a text once; everything that is not plain Markdown goes to a method of the dialect. `Book` writes
MyST for Sphinx, `Plain` the Markdown and HTML that every notebook program shows. An unknown construct raises MarkdownError.
"""

from __future__ import annotations

import html
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from string import ascii_uppercase

from autograder.authoring.bibliography import Bibliography

ADMONITIONS = {"note": "Note", "tip": "Tip", "warning": "Warning", "important": "Important"}
DIRECTIVES = {
    "note": "A box, headed *Note*; a title on its first line stands in it.",
    "tip": "A box, headed *Tip*.",
    "warning": "A box, headed *Warning*.",
    "important": "A box, headed *Important*.",
    "admonition": "A box with the title on its first line.",
    "dropdown": "A fold with the title on its first line. Hints are folds, `:::{dropdown} Hint 1 for compute_gae: where the mask goes`.",
    "margin": "A note in the margin, in place of a footnote.",
    "math": "A displayed equation, as `$$ … $$` is.",
    "quiz": "A question on the first line, then answers, `- [ ] answer: explanation`, of which one is right, `- [x]`.",
}
OPTIONS = {
    "class": "A style: `dropdown` folds an admonition.",
    "open": "A fold that begins open.",
    "label": "Of an equation: numbers it, for references to it.",
}
ROLES = {
    "cite:t": "A citation that is part of the sentence, by its key in `book/references.bib`: Schulman et al. (2017).",
    "cite:p": "The same in parentheses: (Schulman et al., 2017).",
    "eq": "The number of an equation of this chapter, by its label.",
}

_CODE_FENCE = re.compile(r"\s*(?:>\s*)*(?P<fence>`{3,}|~{3,})(?P<info>.*)")
_DIRECTIVE = re.compile(r"(?P<fence>:{3,})\{(?P<name>[^}]*)\}\s*(?P<argument>.*?)\s*")
_OPTION = re.compile(r":(?P<key>[\w-]+):\s*(?P<value>.*?)\s*")
_MATH = re.compile(r"(?P<indent>[ \t]*)\$\$(?P<body>.*?)\$\$[ \t]*(?:\((?P<label>[\w:-]+)\))?[ \t]*", re.DOTALL)
_CHOICE = re.compile(r"- \[(?P<mark>[ x])\] +(?P<text>\S.*)")
_INLINE = re.compile(
    r"\{(?P<role>[A-Za-z][\w:+-]*)\}`(?P<content>[^`]+)`"
    r"|(?P<ticks>`+)(?!`).+?(?<!`)(?P=ticks)(?!`)"
    r"|(?<![\\$])\$(?!\$)(?:\\.|[^$\\\n]|\n(?!\s*\n))+?\$"
    r"|\[(?P<text>[^\]]*)\]\((?:chapter:(?P<chapter>\d+)|appendix:(?P<appendix>[a-z-]+)|atlas:(?P<atlas>[\w./-]+))\)",
    re.DOTALL,
)
_REFUSED = [
    (re.compile(r"^\([\w:-]+\)=\s*$", re.MULTILINE), "targets `(label)=` are not used: notebooks cannot show them"),
    (re.compile(r"^%", re.MULTILINE), "MyST comments are not used: notebooks would print them"),
    (re.compile(r"(?<!\\)\$"), "this $ has no partner: maths is $x$ in one paragraph or $$ … $$ on lines of its own, money \\$5"),
    (re.compile(r"\[\^"), "footnotes are not used: notebooks cannot show them; write a :::{margin} note"),
    (re.compile(r"\(chapter:"), "a link to a chapter is written [text](chapter:43)"),
    (re.compile(r"\(appendix:"), "a link to an appendix is written [text](appendix:notation)"),
    (re.compile(r"\(atlas:"), "a link to a row of the atlas is written [library version](atlas:formula/library/rule)"),
    (re.compile(r"(BEGIN|END) (SOLUTION|HIDDEN TESTS|MARK SCHEME)"), "nbgrader would take this text for a marker of its own"),
]


class MarkdownError(ValueError):
    """Something that the dialects do not know, and the line (counted from 1) where it stands."""

    def __init__(self, line: int, message: str) -> None:
        super().__init__(message)
        self.line = line


@dataclass(frozen=True)
class Block:
    """A stretch of a text: `text`, `code` (a fenced block, verbatim), `math`, or a directive with its body in `text`."""

    kind: str
    text: str
    line: int
    body_line: int = 0
    fence: str = ""
    argument: str = ""
    options: Mapping[str, str] = field(default_factory=dict)
    indent: str = ""

    @property
    def label(self) -> str | None:
        """The label of a numbered equation."""
        return self.options.get("label")


@dataclass(frozen=True)
class Choice:
    """One answer that a quiz offers, and what is said to whoever chooses it."""

    text: str
    explanation: str
    right: bool

    @property
    def verdict(self) -> str:
        """The first word of the explanation, since colour alone would not reach everybody."""
        return "Right." if self.right else "Wrong."


class Dialect(ABC):
    """How one kind of page writes what is not plain Markdown. `cited` collects the keys that a text cites, in order."""

    def __init__(self, assignment: str, equations: Mapping[str, str], works: Bibliography, pages: Mapping[int, str]) -> None:
        self.assignment, self.equations, self.works, self.pages = assignment, equations, works, pages
        self.cited: dict[str, None] = {}

    def role(self, name: str, content: str, line: int) -> str:
        """One role, {name}`content`."""
        if name not in ROLES:
            raise MarkdownError(line, f"unknown role {{{name}}}; known: {', '.join(sorted(ROLES))}")
        if name == "eq":
            if content not in self.equations:
                raise MarkdownError(line, f"no equation of this chapter is labelled {content!r}")
            return self.equation(content)
        keys = [key.strip() for key in content.split(",")]
        try:
            text = self.works.cite(keys, parenthesised=name == "cite:p")
        except KeyError as error:
            raise MarkdownError(line, f"{error} is not in {self.works.path.name}") from error
        self.cited.update(dict.fromkeys(keys))
        return self.citation(name, keys, text)

    @abstractmethod
    def directive(self, block: Block, body: str, title: str) -> str:
        """One directive whose body and argument are rendered already."""

    @abstractmethod
    def quiz(self, block: Block, question: str, body: str, choices: list[Choice]) -> str:
        """A question with answers to choose from, all rendered already; `body` is what stands between them, or empty."""

    @abstractmethod
    def math(self, block: Block) -> str:
        """A displayed equation."""

    @abstractmethod
    def equation(self, label: str) -> str:
        """A reference to a numbered equation."""

    @abstractmethod
    def citation(self, role: str, keys: list[str], text: str) -> str:
        """A citation, `text` in plain words."""

    @abstractmethod
    def chapter(self, number: int, text: str) -> str:
        """A link to another chapter, or its text alone if that chapter is not written."""

    def appendix(self, name: str, text: str) -> str:
        """A link to an appendix of the book; its text alone where there is none, as in a notebook."""
        return text

    def atlas(self, row: str, text: str) -> str:
        """A link to a row of the atlas, formula/library/rule; its text alone where there is no atlas, as in a notebook."""
        return text

    @abstractmethod
    def bibliography(self) -> str:
        """The works in `cited`."""


class Book(Dialect):
    """MyST for Jupyter Book. Equations carry the chapter's numbers, BibTeX keys a prefix, as each page lists its own works."""

    def directive(self, block: Block, body: str, title: str) -> str:
        names = {"class": "class-container"} if block.kind == "dropdown" else {}  # sphinx-design's own name for it
        options = "".join(f":{names.get(key, key)}: {value}".rstrip() + "\n" for key, value in block.options.items())
        return f"{block.fence}{{{block.kind}}} {title}".rstrip() + f"\n{options}\n{body}\n{block.fence}"

    def quiz(self, block: Block, question: str, body: str, choices: list[Choice]) -> str:
        # Two lists of equal length, the second folded, which book/static/course.js makes a form of; without it they read as they are
        answers = "\n".join(f"1. {choice.text}" for choice in choices)
        mark = '<strong class="quiz-{}">{}</strong>'
        explanations = "\n".join(
            f"1. {mark.format('right' if choice.right else 'wrong', choice.verdict)} {choice.explanation}" for choice in choices
        )
        fold = f"```{{dropdown}} Answer\n{explanations}\n```"
        parts = [f"{block.fence}{{div}} quiz", question, body, answers, fold]
        return "\n\n".join(part for part in parts if part) + f"\n{block.fence}"

    def math(self, block: Block) -> str:
        if not block.label:
            return _display(block.text, block.indent)
        # Sphinx numbers by page and wraps lines in `split`, which takes no \tag: so a bare environment of our own
        lines = [
            f"({self._target(block.label)})=",
            "```{math}",
            ":nowrap:",
            "",
            r"\begin{equation}",
            block.text,
            rf"\tag{{{self.equations[block.label]}}}",
            r"\end{equation}",
            "```",
        ]
        return _indented("\n".join(lines), block.indent)

    def equation(self, label: str) -> str:
        return f"[({self.equations[label]})](#{self._target(label)})"

    def citation(self, role: str, keys: list[str], text: str) -> str:
        return f"{{{role}}}`" + ",".join(f"{self.assignment}-{key}" for key in keys) + "`"

    def chapter(self, number: int, text: str) -> str:
        return f"[{text}]({self.pages[number]}.ipynb)" if number in self.pages else text

    def appendix(self, name: str, text: str) -> str:
        return f"[{text}](../{name}.md)"

    def atlas(self, row: str, text: str) -> str:
        return f"[{text}](#{atlas_label(row.partition('/')[0])})"

    def bibliography(self) -> str:
        return f"```{{bibliography}}\n:filter: docname in docnames\n:keyprefix: {self.assignment}-\n```"

    def _target(self, label: str) -> str:
        return f"eq-{self.assignment}-{label.replace(':', '-')}"


class Plain(Dialect):
    """Markdown and HTML that JupyterLab, VS Code and Colab show alike."""

    def directive(self, block: Block, body: str, title: str) -> str:
        if block.kind == "dropdown" or "dropdown" in block.options.get("class", "").split():
            summary = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(title or "More", quote=False))
            opened = " open" if "open" in block.options else ""
            return f"<details{opened}>\n<summary>{summary}</summary>\n\n{body}\n\n</details>"
        if block.kind in ADMONITIONS:
            body, title = f"{title}\n\n{body}".strip(), ADMONITIONS[block.kind]
        heading = f"**{title}**\n\n" if title else ""
        return _quoted(heading + body)

    def quiz(self, block: Block, question: str, body: str, choices: list[Choice]) -> str:
        lettered = [(f"- **{letter}.**", choice) for letter, choice in zip(ascii_uppercase, choices, strict=False)]
        answers = "\n".join(f"{letter} {choice.text}" for letter, choice in lettered)
        explanations = "\n".join(f"{letter} **{choice.verdict}** {choice.explanation}" for letter, choice in lettered)
        fold = f"<details>\n<summary>Answer</summary>\n\n{explanations}\n\n</details>"
        return "\n\n".join(part for part in [f"**Question.** {question}", body, answers, fold] if part)

    def math(self, block: Block) -> str:
        tag = f"\n\\tag{{{self.equations[block.label]}}}" if block.label else ""
        return _display(block.text + tag, block.indent)

    def equation(self, label: str) -> str:
        return f"({self.equations[label]})"

    def citation(self, role: str, keys: list[str], text: str) -> str:
        return text

    def chapter(self, number: int, text: str) -> str:
        return f"[{text}](../ch{number}/ch{number}.ipynb)" if number in self.pages else text

    def bibliography(self) -> str:
        return self.works.listing(self.cited)


def render(text: str, dialect: Dialect, line: int = 1) -> str:
    """`text` in the words of `dialect`; `line` is the number of its first line, for errors."""
    return "\n".join(_rendered(block, dialect) for block in parse(text, line))


def atlas_label(formula: str) -> str:
    """The place of a formula's table in the appendix."""
    return f"atlas-{formula.replace('_', '-')}"


def labels(text: str, line: int = 1) -> Iterator[tuple[str, int]]:
    """The labels of the numbered equations in a text, in order, with their lines."""
    for block in parse(text, line):
        if block.label:
            yield block.label, block.line
        if block.kind in DIRECTIVES.keys() - {"math"}:
            yield from labels(block.text, block.body_line)


def _rendered(block: Block, dialect: Dialect) -> str:
    if block.kind == "code":
        return block.text
    if block.kind == "text":
        return _inline(block.text, dialect, block.line)
    if block.kind == "math":
        return dialect.math(block)
    if block.kind == "quiz":
        return _quiz(block, dialect)
    if block.kind == "dropdown" and any(
        match["role"] or match["chapter"] or match["appendix"] or match["atlas"] for match in _INLINE.finditer(block.argument)
    ):
        raise MarkdownError(block.line, "a fold's title holds no link, as it is a button itself: put the link into the fold")
    body = render(block.text, dialect, block.body_line)
    return dialect.directive(block, body.strip("\n"), _inline(block.argument, dialect, block.line))


def _quiz(block: Block, dialect: Dialect) -> str:
    """A quiz: its question in the argument, perhaps more of it in the body, then `- [ ] answer: explanation`, one of them `[x]`."""
    lines = block.text.rstrip().split("\n")
    begin = next((at for at, line in enumerate(lines) if line.startswith("- [")), len(lines))
    choices: list[tuple[int, bool, str]] = []
    for number, line in enumerate(lines[begin:], block.body_line + begin):
        if match := _CHOICE.fullmatch(line):
            choices.append((number, match["mark"] == "x", match["text"]))
        elif line.startswith("  ") and choices:
            choices[-1] = (*choices[-1][:2], f"{choices[-1][2]} {line.strip()}")
        elif line.strip():
            raise MarkdownError(number, "an answer of a quiz is `- [ ] answer: explanation`, or [x] for the right one")
    right = [number for number, is_right, _ in choices if is_right]
    if not block.argument:
        raise MarkdownError(block.line, "a quiz has its question on its first line, :::{quiz} Which …?")
    if len(choices) < 2:
        raise MarkdownError(block.line, "a quiz needs at least two answers, lines of `- [ ] answer: explanation`")
    if len(right) != 1:
        here = right[1] if right else block.line
        raise MarkdownError(here, f"exactly one answer of a quiz is the right one, marked [x]; this one has {len(right)}")
    body = render("\n".join(lines[:begin]), dialect, block.body_line).strip("\n")
    rendered = [_choice(*choice, dialect) for choice in choices]
    return dialect.quiz(block, _inline(block.argument, dialect, block.line), body, rendered)


def _choice(line: int, right: bool, text: str, dialect: Dialect) -> Choice:
    masked = _INLINE.sub(lambda match: "x" * len(match[0]), text)  # a colon in code or maths separates nothing
    at = masked.find(": ")
    if at < 0:
        raise MarkdownError(line, "every answer of a quiz explains itself: `- [ ] answer: explanation`")
    return Choice(_inline(text[:at], dialect, line), _inline(text[at + 2 :].strip(), dialect, line), right)


def _inline(text: str, dialect: Dialect, line: int) -> str:
    """Replace roles and links to chapters, appendices and the atlas; leave code spans and inline maths alone."""
    _refuse(_INLINE.sub(lambda match: re.sub(r"[^\n]", "x", match[0]), text), line)

    def replace(match: re.Match[str]) -> str:
        if match["role"]:
            return dialect.role(match["role"], match["content"].strip(), line + text.count("\n", 0, match.start()))
        if match["appendix"]:
            return dialect.appendix(match["appendix"], match["text"])
        if match["atlas"]:
            return dialect.atlas(match["atlas"], match["text"])
        return dialect.chapter(int(match["chapter"]), match["text"]) if match["chapter"] else match[0]

    return _INLINE.sub(replace, text)


def _refuse(text: str, line: int) -> None:
    for pattern, message in _REFUSED:
        if match := pattern.search(text):
            raise MarkdownError(line + text.count("\n", 0, match.start()), message)


def parse(text: str, line: int = 1) -> list[Block]:
    """Split a text into blocks; a directive's body is left for another call."""
    lines, at = text.split("\n"), 0
    blocks: list[Block] = []
    plain: list[str] = []

    def flush() -> None:
        if plain:
            blocks.append(Block("text", "\n".join(plain), line + at - len(plain)))
            plain.clear()

    while at < len(lines):
        block, length = _block(lines, at, line)
        if block is None:
            plain.append(lines[at])
        else:
            flush()
            blocks.append(block)
        at += length
    flush()
    return blocks


def _block(lines: list[str], at: int, first: int) -> tuple[Block | None, int]:
    """The fenced block, equation or directive that begins at lines[at], and how many lines it takes; (None, 1) for plain text."""
    line, here = lines[at], first + at
    if match := _CODE_FENCE.fullmatch(line):
        if match["info"].startswith("{"):
            raise MarkdownError(here, f"write directives with colons, :::{match['info'].split('}')[0]}}}")
        closing = re.compile(rf"\s*(?:>\s*)*{match['fence'][0]}{{{len(match['fence'])},}}\s*")
        end = _closing(lines, at, closing, here, "this code block is not closed")
        return Block("code", "\n".join(lines[at : end + 1]), here), end + 1 - at
    if match := _DIRECTIVE.fullmatch(line):
        return _directive(lines, at, first, match)
    if line.lstrip().startswith(":::"):
        raise MarkdownError(
            here, "this ::: opens or closes nothing: directives begin in the first column, outer ones with more colons"
        )
    if line.lstrip().startswith("$$"):
        return _equation(lines, at, here)
    return None, 1


def _directive(lines: list[str], at: int, first: int, match: re.Match[str]) -> tuple[Block, int]:
    here, name = first + at, match["name"]
    if name not in DIRECTIVES:
        raise MarkdownError(here, f"unknown directive {{{name}}}; known: {', '.join(sorted(DIRECTIVES))}")
    end = _closing(lines, at, re.compile(rf":{{{len(match['fence'])},}}\s*"), here, f"this {{{name}}} is not closed")
    body, options = at + 1, {}
    while body < end and (option := _OPTION.fullmatch(lines[body])):
        if option["key"] not in OPTIONS:
            raise MarkdownError(first + body, f"unknown option :{option['key']}:; known: {', '.join(sorted(OPTIONS))}")
        options[option["key"]] = option["value"]
        body += 1
    text = "\n".join(lines[body:end])
    if name == "math":
        return _math_block(text, here, options.get("label"), ""), end + 1 - at
    return Block(name, text, here, first + body, match["fence"], match["argument"], options), end + 1 - at


def _equation(lines: list[str], at: int, here: int) -> tuple[Block, int]:
    for end in range(at, len(lines)):
        if end > at and not lines[end].strip():
            break
        text = "\n".join(lines[at : end + 1])
        if match := _MATH.fullmatch(text):
            return _math_block(match["body"], here, match["label"], match["indent"]), end + 1 - at
    raise MarkdownError(here, "this $$ is not closed, on a line's end, before the paragraph ends")


def _math_block(text: str, line: int, label: str | None, indent: str) -> Block:
    if re.search(r"\\begin\{(align|equation|gather|multline|eqnarray)\*?\}", text):
        raise MarkdownError(line, r"write \begin{aligned}, or nothing: a displayed equation is an environment already")
    text = "\n".join(part.removeprefix(indent) for part in text.strip().split("\n"))
    return Block("math", text, line, options={"label": label} if label else {}, indent=indent)


def _closing(lines: list[str], at: int, pattern: re.Pattern[str], here: int, complaint: str) -> int:
    for end in range(at + 1, len(lines)):
        if pattern.fullmatch(lines[end]):
            return end
    raise MarkdownError(here, complaint)


def _display(text: str, indent: str) -> str:
    return _indented(f"$$\n{text}\n$$", indent)


def _indented(text: str, indent: str) -> str:
    return "\n".join(indent + line if line else line for line in text.split("\n"))


def _quoted(text: str) -> str:
    """A blockquote. Maths goes on one line: JupyterLab takes formulas out first, together with any `>` inside them."""
    text = re.sub(r"(\$\$?)(?:[^$\n]|\n(?!\s*\n))+\1", lambda match: match[0].replace("\n", " "), text)
    return "\n".join(f"> {line}".rstrip() for line in text.split("\n"))
