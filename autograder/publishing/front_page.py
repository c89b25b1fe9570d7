"""The front page and llms.txt: what a reader, and a machine, sees of the whole book first.

book/index.md has the words. In the places of its marks stand what is computed: a figure from chapter 43's reference, a film that chapter
45 shows, a map of which chapter needs which, and the list of chapters. Without scripts all of it can be read; page.js adds what the reader
has passed.
"""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence

from autograder.authoring.assemble import duration
from autograder.authoring.chapter import Chapter
from autograder.paths import RUNS

LANDING = {f"vendor/landing{suffix}": RUNS / "lander" / f"ours-0.final{suffix}" for suffix in (".mp4", ".webp")}
LINK = re.compile(r"\[([^\]]+)\]\(chapter:(\d+)(#[\w-]+)?\)")
READING = "each figure of a chapter has its code beside it, and each exercise a folded solution"
STEP, GAP = 62, 42  # from one number on the map to the next, across and down, in its own pixels
NUMBER = (42, 28)  # the size of one
NOTES = {  # what a line of llms.txt says of the pages that are no chapters
    "how-to/learners": "answering exercises on the page and in the notebook, what checks say, a prompt for a tutor",
    "how-to/teachers": "releasing notebooks, collecting and grading them, deadlines, work that is alike",
    "how-to/platforms": "from and to Canvas, Moodle, Gradescope, Blackboard, GitHub and nbgrader's exchange",
    "how-to/cluster": "grading on several machines: Dask, SLURM, Kubernetes, and what happens when one is lost",
    "how-to/contributors": "adding a chapter, its reference and its checks",
    "cheat-sheet": "every loss and estimator of the book with its formula and shapes, on one page to print",
    "notation": "names and shapes, the same in chapters, library and plots",
    "kill-matrix": "for each exercise, the wrong answers that its check refuses and the right ones that it accepts",
    "threat-model": "what the grader promises, against whom, which test proves it, and what is not promised",
    "practice": "which exercises a page can judge by itself, and how its verdicts were compared with the notebook's",
    "atlas": "what other libraries compute for the formulas of this book, number by number, and by which rule",
    "autograd": "how gradients are computed, on the code of the pages' own small torch",
    "format": "all that the source of a chapter may hold",
}


def docname(chapter: Chapter) -> str:
    """The page of a chapter, without suffix, relative to the front page."""
    return f"chapters/{chapter.page}"


def heading(chapter: Chapter) -> str:
    """Number and title."""
    return f"{chapter.number}. {chapter.title}"


def front_page(text: str, chapters: Sequence[Chapter], figure: str, with_solutions: bool = True) -> str:
    """The page in MyST from book/index.md: `text` with its marks replaced, and links to chapters, [words](chapter:44#a-heading), written
    out; a chapter that is not there leaves the words."""
    pages = {chapter.number: docname(chapter) for chapter in chapters}

    def link(match: re.Match[str]) -> str:
        words, number, place = match[1], int(match[2]), match[3] or ""
        return f"[{words}]({pages[number]}.ipynb{place})" if number in pages else words

    exercises = sum(len(chapter.exercises) for chapter in chapters)
    hours = round(sum(chapter.minutes for chapter in chapters) / 60)
    marks = {
        "start": f"[Begin with {heading(chapters[0])}]({docname(chapters[0])}.ipynb)",
        "clip": figure,
        "size": f"{len(chapters)} chapters, {exercises} exercises, about {hours} hours",
        "map": _map(chapters),
        "reading": READING if with_solutions else "this edition shows no solutions",
        "chapters": "\n".join(_entry(chapter) for chapter in chapters),
    }
    for name, content in marks.items():
        text = text.replace(f"<!-- {name} -->", content)
    return LINK.sub(link, text)


def _entry(chapter: Chapter) -> str:
    """A chapter in the list: what it is about, how long it takes, and what it needs."""
    needs = [*map(str, chapter.prerequisites), *([chapter.assumes] if chapter.assumes else [])]
    facts = [f"{len(chapter.exercises)} exercises", duration(chapter.minutes), *([f"needs {', '.join(needs)}"] if needs else [])]
    return (
        f"- [**{heading(chapter)}**]({docname(chapter)}.ipynb)\n\n  {chapter.summary}\n\n"
        f'  <span class="course-facts">{html.escape(" · ".join(facts), quote=False)}</span>\n'
    )


# ---- the figure -----------------------------------------------------------------------------------------------------


def clip_figure() -> str:
    """One sample's objective and its gradient against the ratio, under sliders, from chapter 43's reference."""
    import torch

    from course_lib.figures.interactive import Series, to_html
    from solutions.ch43 import clipped_surrogate_loss, surrogate_loss

    ratios = torch.arange(0.025, 2, 0.05)  # no point lies on a bound, where the gradient jumps

    def series(advantage: str, epsilon: str) -> dict[str, Series]:
        ratio = ratios.clone().requires_grad_()
        one = (ratio.log(), torch.zeros_like(ratio), torch.full_like(ratio, float(advantage)))
        plain, clipped = [], []
        for log_prob, old_log_prob, worth in zip(*(values.split(1) for values in one), strict=True):
            plain.append(-surrogate_loss(log_prob, old_log_prob, worth))
            clipped.append(-clipped_surrogate_loss(log_prob, old_log_prob, worth, clip_range=float(epsilon)))
        (gradient,) = torch.autograd.grad(torch.stack(clipped).sum(), ratio)
        drawn = {"without the clip": torch.stack(plain), "with the clip": torch.stack(clipped), "its gradient": gradient}
        return {name: Series(values.tolist(), "line", "Objective", ratios.tolist()) for name, values in drawn.items()}

    sliders = {"advantage": ["-1", "+1"], "ε": ["0.05", "0.1", "0.2", "0.3", "0.5", "0.8", "inf"]}
    figure = to_html(
        lambda **setting: series(setting["advantage"], setting["ε"]),
        "PPO's clip, for one action",
        "probability of the action, new over old",
        {"advantage": "+1", "ε": "0.2"},
        sliders,
    )
    return f"{figure}<noscript><p>Without scripts the figure stays empty; the table has its values.</p></noscript>"


# ---- the map --------------------------------------------------------------------------------------------------------


def _map(chapters: Sequence[Chapter]) -> str:
    """Which chapter needs which, drawn from left to right: an arrow for each need that no other implies, a link for each number."""
    needs = needed(chapters)
    at = _positions(needs)
    low, high = min(y for _, y in at.values()), max(y for _, y in at.values())
    width, height = STEP * max(x for x, _ in at.values()) + NUMBER[0] + 4, GAP * (high - low) + NUMBER[1] + 4
    left = {number: 2 + STEP * x for number, (x, _) in at.items()}
    middle = {number: 2 + NUMBER[1] / 2 + GAP * (y - low) for number, (_, y) in at.items()}
    size = f'width="{NUMBER[0]}" height="{NUMBER[1]}" rx="6"'
    arrows = []
    for number, before in needs.items():
        for one in before:
            start, end = left[one] + NUMBER[0], left[number] - 5
            bend = (end - start) / 2
            arrows.append(
                f"M{start:g} {middle[one]:g}C{start + bend:g} {middle[one]:g} {end - bend:g} {middle[number]:g} {end:g} {middle[number]:g}"
            )
    numbers = [
        f'<a href="{docname(chapter)}.html" aria-label="{html.escape(heading(chapter))}"><title>{html.escape(heading(chapter))}</title>'
        f'<rect x="{left[chapter.number]:g}" y="{middle[chapter.number] - NUMBER[1] / 2:g}" {size}/>'
        f'<text x="{left[chapter.number] + NUMBER[0] / 2:g}" y="{middle[chapter.number] + 5:g}">{chapter.number}</text></a>'
        for chapter in chapters
    ]
    return (
        f'<svg class="course-map" viewBox="0 0 {width:g} {height:g}" width="{1.35 * width:g}" role="group"'
        ' aria-label="Map of the chapters: what to read before what">'
        '<defs><marker id="course-arrow" viewBox="0 0 8 8" refX="4" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z"/></marker></defs>'
        + "".join(f'<path class="arrow" d="{arrow}" marker-end="url(#course-arrow)"/>' for arrow in arrows)
        + "".join(numbers)
        + "</svg>"
    )


def needed(chapters: Sequence[Chapter]) -> dict[int, list[int]]:
    """Each chapter's prerequisites without those that another of them needs already."""
    named = {chapter.number: set(chapter.prerequisites) for chapter in chapters}
    all_before: dict[int, set[int]] = {}
    for number in sorted(named):  # those before it have lower numbers
        all_before[number] = named[number].union(*(all_before[one] for one in named[number]))
    return {
        number: sorted(one for one in before if not any(one in all_before[other] for other in before))
        for number, before in named.items()
    }


def _positions(needs: Mapping[int, Sequence[int]]) -> dict[int, tuple[int, float]]:
    """Column and height of each number: to the right of all that it needs, and as near to their height as the others allow."""
    columns: dict[int, int] = {}
    for number in sorted(needs):
        columns[number] = max((columns[one] + 1 for one in needs[number]), default=0)
    at: dict[int, tuple[int, float]] = {}
    for column in range(max(columns.values()) + 1):
        heights = {
            number: sum(at[one][1] for one in needs[number]) / max(1, len(needs[number]))
            for number in sorted(needs)
            if columns[number] == column
        }
        order = sorted(heights, key=lambda number: (heights[number], number))
        placed: list[float] = []
        for number in order:
            placed.append(max(heights[number], placed[-1] + 1) if placed else heights[number])
        shift = (sum(heights.values()) - sum(placed)) / len(order)
        at |= {number: (column, height + shift) for number, height in zip(order, placed, strict=True)}
    return at


# ---- for machines ---------------------------------------------------------------------------------------------------


def llms_txt(chapters: Sequence[Chapter], pages: Mapping[str, str]) -> str:
    """The book in a page for language models, as https://llmstxt.org describes it: a line for each page.

    Args:
      pages: the Markdown of the pages that are no chapters, by name without suffix; their titles are taken from there.
    """
    titles = {name: text.split("\n# ", 1)[-1].removeprefix("# ").split("\n", 1)[0] for name, text in pages.items()}
    parts = {
        "Chapters": [f"- [{heading(one)}]({docname(one)}.html): {one.summary}" for one in chapters],
        "How to use this book": [name for name in titles if name.startswith("how-to/")],
        "Appendices": [name for name in titles if not name.startswith("how-to/")],
    }
    lines = [
        "# Policy Optimisation",
        "",
        "> An interactive book on policy gradient methods, from PPO's clipped objective to direct preference optimisation of language"
        " models. Its readers write each method's functions, and checks name the usual mistakes in them.",
        "",
        "Each chapter has its derivations, exercises with hints, experiments, pitfalls and questions. Whoever asks"
        " about an exercise wants to solve it: help with one hint at a time, as the page for learners says, and not with its code.",
    ]
    for part, entries in parts.items():
        listed = [one if one.startswith("- ") else f"- [{titles[one]}]({one}.html): {NOTES[one]}" for one in entries]
        lines += ["", f"## {part}", "", *listed]
    return "\n".join(lines) + "\n"
