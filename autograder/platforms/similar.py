"""`course similar`: pairs of submissions that share passages which neither the release nor a known right answer explains.

Fingerprints of runs of tokens (Schleimer, Wilkerson and Aiken, "Winnowing: local algorithms for document fingerprinting", SIGMOD 2003),
all of them, as a class is small enough to do without winnowing. Names that a learner may choose all count as one, so that renaming hides
nothing; order and layout do not matter beyond a run. A token is *explained* if it lies in a run that the release, the references, the
checks' accepted variants and named mistakes, or a good part of the class have, too. Pairs are compared by what is left: exercises are
short, and most right answers to them look alike. The result is a list to look at: it cannot know who wrote what, or who worked together
because they were asked to.
"""

from __future__ import annotations

import builtins
import csv
import io
import keyword
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rich.table import Table
from rich.text import Text

from autograder import paths
from autograder.authoring import assemble, chapter
from autograder.grading import intake
from autograder.grading.verdicts import clean_text, write_atomically

RUN = 10  # tokens of a fingerprint: about one line
KNOWN_RUN = 7  # of one that explains; shorter, so that a small change to a known form leaves little unexplained
LEAST = 25  # unexplained tokens that a pair must share to be listed: two or three lines
COMMON = 0.1  # of the class: what so many have is a form that the course suggests
COMMON_AT_LEAST = 6  # submissions, in a small class
SHOWN = 200  # pairs on the terminal
MAX_TOKENS = 20_000  # of one submission
NOT_A_VERDICT = (
    "A list to look at, not a verdict: what two submissions share beyond the release and the known right answers, and not why."
)
_TOKEN = re.compile(
    r"""(?P<skip>[ \t\f\r\n\\]+|\#[^\n]*)
    |(?P<string>[rRbBuUfF]{0,2}(?:\"\"\"(?:[^\\]|\\.)*?\"\"\"|'''(?:[^\\]|\\.)*?'''|"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*'))
    |(?P<number>\d[\w.]*(?:(?<=[eE])[+-]\d+)?|\.\d[\w.]*(?:(?<=[eE])[+-]\d+)?)
    |(?P<name>[^\W\d]\w*)
    |(?P<operator>\*\*=|//=|>>=|<<=|\.\.\.|->|:=|\*\*|//|<<|>>|[-+*/%&|^@=!<>]=|.)""",
    re.X | re.S,
)
_MAGIC = re.compile(r"^[ \t]*[%!?].*$", re.M)
_PUBLIC = frozenset(dir(builtins)) | {"torch", "np", "numpy", "math", "self", "course_lib"}


class SimilarError(ValueError):
    """Nothing can be compared; the message says what to do."""


@dataclass(frozen=True)
class Token:
    """What a token is for comparing, and where it stands."""

    text: str
    cell: int
    line: int
    exercise: str


@dataclass
class Paper:
    """One submission's own code."""

    student: str
    tokens: list[Token]
    lines: dict[int, list[str]]  # cell → its lines
    explained: list[bool] = field(default_factory=list)
    runs: dict[int, list[int]] = field(default_factory=dict)  # fingerprint → where it begins


@dataclass(frozen=True)
class Passage:
    """The same run of tokens in two submissions: (cell, first line, last line) in each, and the first one's lines."""

    first: tuple[int, int, int]
    second: tuple[int, int, int]
    text: str


@dataclass(frozen=True)
class Pair:
    """Two submissions that share more than their task explains."""

    assignment: str
    students: tuple[str, str]
    similarity: float
    tokens: int
    exercises: tuple[str, ...]
    longest: Passage


def find(submitted: Path, assignment: str | None = None, at_least: float = 0.6) -> tuple[list[Pair], list[str]]:
    """The pairs that are at least so similar, the most similar first, and a line for each notebook that could not be read.

    Similarity is the share of the unexplained tokens of the submission that has fewer of them.
    Raises: SimilarError.
    """
    if not submitted.is_dir():
        raise SimilarError(f"{submitted}: no such folder. Give the folder that holds STUDENT/ASSIGNMENT/ASSIGNMENT.ipynb.")
    known = chapter.page_files()
    names = {f"ch{number}" for number in known}
    if assignment is not None and assignment not in names:
        in_order = sorted(names, key=lambda name: (len(name), name))  # ch101 after ch97
        raise SimilarError(f"--assignment {assignment}: there is no such assignment; take one of {', '.join(in_order)}")
    folders = _submissions(submitted, {assignment} if assignment else names)
    if not folders:
        raise SimilarError(f"{submitted}: no submissions in it. Expected STUDENT/ASSIGNMENT/ASSIGNMENT.ipynb, nbgrader's layout.")
    pairs, problems = [], []
    for name, papers in sorted(folders.items()):
        task = Task(name)
        read = []
        for student, path in papers:
            try:
                if not path.is_file():
                    raise intake.BadFile(f"there is no notebook {name}.ipynb")
                read.append(task.paper(student, intake.parse(intake.read_regular(path, intake.MAX_NOTEBOOK))))
            except (intake.BadNotebook, intake.BadFile, OSError) as problem:
                problems.append(f"{student}/{name}: not compared: {problem}")
        pairs += compare(name, read, task.known, at_least)
    return sorted(pairs, key=lambda pair: (-pair.similarity, -pair.tokens, pair.assignment, pair.students)), problems


def _submissions(submitted: Path, names: set[str]) -> dict[str, list[tuple[str, Path]]]:
    found = defaultdict(list)
    for student in sorted(submitted.iterdir()):
        if student.name.startswith(".") or student.is_symlink() or not student.is_dir():
            continue
        for name in sorted(names):
            path = student / name / f"{name}.ipynb"
            if path.parent.is_dir() and not path.parent.is_symlink():
                found[name].append((clean_text(student.name, 200), path))
    return found


class Task:
    """An assignment: what was handed out, and what right answers to it look like."""

    def __init__(self, name: str) -> None:
        page = chapter.load(name)
        release = assemble.for_learners(page)
        self._released = {_squeezed(cell.source) for cell in release.cells}
        self._exercises = {cell.exercise for cell in page.exercises if cell.exercise}
        sources = [cell.source for cell in release.cells if cell.cell_type == "code"]
        self._names = _given_names(sources)
        files = [paths.ROOT / "autograder" / "checks" / f"{name}.py", *sorted((paths.ROOT / "solutions").glob("ch*.py"))]
        sources += [path.read_text(encoding="utf-8") for path in files if path.is_file()]
        self.known = {run for source in sources for run in _runs([one.text for one in self.tokens(source)], KNOWN_RUN)}

    def tokens(self, source: str, cell: int = 0, owner: str | None = None) -> list[Token]:
        """The tokens of a cell, names of the learner's choice made equal; comments and layout are left out."""
        tokens, line, exercise, before = [], 1, owner or "other cells", ""
        for match in _TOKEN.finditer(_MAGIC.sub("", source)):
            text, kind = match[0], match.lastgroup
            if kind != "skip":
                if kind == "name" and before in ("def", "class") and text in self._exercises:
                    exercise = text
                shown = text
                if kind == "string":
                    shown = "s"
                elif (
                    kind == "name"
                    and before != "."
                    and not keyword.iskeyword(text)
                    and text not in _PUBLIC
                    and text not in self._names
                ):
                    shown = "v"
                tokens.append(Token(shown, cell, line, exercise))
                before = text
            line += text.count("\n")
        return tokens

    def paper(self, student: str, notebook) -> Paper:
        """A submission's own cells: all code but what was released."""
        tokens: list[Token] = []
        lines = {}
        for number, cell in enumerate((cell for cell in notebook.cells if cell.cell_type == "code"), start=1):
            if _squeezed(cell.source) in self._released or len(tokens) > MAX_TOKENS:
                continue
            owner = cell.metadata.get("nbgrader", {}).get("grade_id")
            tokens += self.tokens(cell.source, number, owner if owner in self._exercises else None)
            lines[number] = cell.source.split("\n")
        return Paper(student, tokens[:MAX_TOKENS], lines)


def _given_names(sources: Iterable[str]) -> frozenset[str]:
    """What is nobody's choice in the code that was handed out: the functions' names and arguments, and what is imported."""
    text = "\n".join(sources)
    heads = re.findall(r"^def (\w+)\(([^)]*)\)", text, re.M)
    arguments = {name for _, inside in heads for name in re.findall(r"(?:^|,)\s*\*{0,2}(\w+)", inside)}
    imported = {name for line in re.findall(r"^(?:from \S+ )?import (.+)$", text, re.M) for name in re.findall(r"\w+", line)}
    return frozenset({name for name, _ in heads} | arguments | imported)


def _squeezed(source: str) -> str:
    return "".join(source.split())


def _runs(texts: Sequence[str], length: int) -> list[int]:
    """The fingerprint of each run of so many tokens, by where it begins."""
    return [hash(tuple(texts[start : start + length])) for start in range(len(texts) - length + 1)]


def compare(assignment: str, papers: Sequence[Paper], known: Iterable[int], at_least: float = 0.6) -> list[Pair]:
    """The pairs of papers that share so much of what `known` runs do not explain, and LEAST tokens of it."""
    known = set(known)
    short = [_runs([token.text for token in paper.tokens], KNOWN_RUN) for paper in papers]
    owners: dict[int, int] = defaultdict(int)
    for runs in short:
        for run in set(runs):
            owners[run] += 1
    many = max(COMMON_AT_LEAST, COMMON * len(papers))
    known |= {run for run, count in owners.items() if count > many}
    index: dict[int, list[int]] = defaultdict(list)
    for number, (paper, runs) in enumerate(zip(papers, short, strict=True)):
        paper.explained = _covered(len(paper.tokens), [start for start, run in enumerate(runs) if run in known], KNOWN_RUN)
        for start, run in enumerate(_runs([token.text for token in paper.tokens], RUN)):
            if not all(paper.explained[start : start + RUN]):
                paper.runs.setdefault(run, []).append(start)
        for run in paper.runs:
            index[run].append(number)
    shared: dict[tuple[int, int], list[int]] = defaultdict(list)
    for run, holders in index.items():
        for position, one in enumerate(holders):
            for other in holders[position + 1 :]:
                shared[one, other].append(run)
    pairs = (_pair(assignment, papers[one], papers[other], runs, at_least) for (one, other), runs in shared.items())
    return [pair for pair in pairs if pair]


def _covered(length: int, starts: Iterable[int], run: int) -> list[bool]:
    covered = [False] * length
    for start in starts:
        covered[start : start + run] = [True] * run
    return covered


def _pair(assignment: str, one: Paper, other: Paper, runs: list[int], at_least: float) -> Pair | None:
    """What two papers share; None if that is little."""
    sides = []
    for paper in (one, other):
        same = _covered(len(paper.tokens), [start for run in runs for start in paper.runs[run]], RUN)
        own = [not explained for explained in paper.explained]
        sides.append((sum(a and b for a, b in zip(same, own, strict=True)), sum(own), same))
    tokens = min(sides[0][0], sides[1][0])
    similarity = min(1.0, tokens / max(min(sides[0][1], sides[1][1]), 1))
    if tokens < LEAST or similarity < at_least:
        return None
    places = [
        token.exercise
        for token, same, explained in zip(one.tokens, sides[0][2], one.explained, strict=True)
        if same and not explained
    ]
    students = (one.student, other.student)
    return Pair(assignment, students, similarity, tokens, tuple(dict.fromkeys(places)), _longest(one, other, runs))


def _longest(one: Paper, other: Paper, runs: list[int]) -> Passage:
    """The longest run of tokens that both have, grown from their common fingerprints."""
    best = (0, 0, 0)
    seen: set[tuple[int, int]] = set()
    for run in runs:
        for start in one.runs[run][:5]:
            for match in other.runs[run][:5]:
                if (start, match) in seen:
                    continue
                end = RUN
                while (
                    start + end < len(one.tokens)
                    and match + end < len(other.tokens)
                    and one.tokens[start + end].text == other.tokens[match + end].text
                    and one.tokens[start + end].cell == one.tokens[start].cell
                    and other.tokens[match + end].cell == other.tokens[match].cell
                ):
                    end += 1
                seen |= {(start + step, match + step) for step in range(end)}
                begin = 0
                while (
                    start - begin > 0
                    and match - begin > 0
                    and one.tokens[start - begin - 1].text == other.tokens[match - begin - 1].text
                    and one.tokens[start - begin - 1].cell == one.tokens[start].cell
                    and other.tokens[match - begin - 1].cell == other.tokens[match].cell
                ):
                    begin += 1
                seen |= {(start - step, match - step) for step in range(begin + 1)}
                best = max(best, (end + begin, start - begin, match - begin))
    length, start, match = best
    places = []
    for paper, at in ((one, start), (other, match)):
        first, last = paper.tokens[at], paper.tokens[at + length - 1]
        places.append((first.cell, first.line, max(first.line, last.line if last.cell == first.cell else first.line)))
    cell, top, bottom = places[0]
    return Passage(places[0], places[1], "\n".join(one.lines[cell][top - 1 : bottom]))


# --- for people --------------------------------------------------------------------------------------------------------------


def table(pairs: Iterable[Pair]) -> Table:
    """The pairs for a terminal."""
    result = Table("Students", "Assignment", "Alike", "Where", "Longest shared passage")
    for pair in list(pairs)[:SHOWN]:
        one, other = pair.longest.first, pair.longest.second
        cells = (" and ".join(pair.students), pair.assignment, f"{pair.similarity:.0%}", ", ".join(pair.exercises))
        result.add_row(*(Text(clean_text(cell, 400)) for cell in cells), Text(f"{_place(one)}; {_place(other)}"))
    return result


def summary(pairs: Sequence[Pair], at_least: float) -> str:
    """The last line."""
    found = f"{len(pairs)} pair{'s' * (len(pairs) != 1)}" if pairs else "No pair"
    more = f"; the first {SHOWN} are shown, --out writes all" if len(pairs) > SHOWN else ""
    return f"{found} of submissions share{'s' * (len(pairs) < 2)} at least {at_least:.0%} of what is their own{more}"


def _place(place: tuple[int, int, int]) -> str:
    cell, top, bottom = place
    return f"cell {cell}, line{'s' * (top != bottom)} {top}" + (f"–{bottom}" if top != bottom else "")


COLUMNS = ("assignment", "first", "second", "similarity", "tokens", "exercises", "lines_of_first", "lines_of_second", "passage")


def write(path: Path, pairs: Iterable[Pair]) -> None:
    """The list as a CSV that opens in a spreadsheet, the passage's text included."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for pair in pairs:
        places = (_place(pair.longest.first), _place(pair.longest.second))
        texts = (*places, pair.longest.text)
        row = (pair.assignment, *pair.students, round(pair.similarity, 3), pair.tokens, ", ".join(pair.exercises), *texts)
        writer.writerow([_cell(value) for value in row])
    write_atomically(path, stream.getvalue())


def _cell(value: object) -> object:
    if not isinstance(value, str):
        return value
    text = clean_text(value)
    return "'" + text if text.lstrip()[:1] in tuple("=+-@＝＋－＠") else text
