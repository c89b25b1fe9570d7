"""Build the book: execute, stage, render, publish.

Contract of the four steps:
  execute   every chapter's code runs once, the chapters side by side (autograder.publishing.execution keeps the outputs);
  stage     all that Sphinx reads is computed in memory, as far as it is not kept from before, and written to book/_stage, where
            files that did not change keep their time, so that Sphinx renders changed pages only;
  render    Jupyter Book runs under _config.yml with warnings as errors, in book/_cache, never in the published tree;
  publish   the pages and what they refer to, nothing else, replace book/_build/html in one rename.
A book with and one without solutions are staged and rendered in folders of their own, so that neither can leak into the other.
"""

from __future__ import annotations

import fnmatch
import functools
import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import nbformat
import yaml

from autograder.authoring import assemble
from autograder.authoring.chapter import Chapter, all_chapters
from autograder.paths import BIBLIOGRAPHY, ROOT, RUNS
from autograder.proving.dependencies import PACKAGES
from autograder.proving.locks import one_at_a_time
from autograder.publishing import cheat_sheet, front_page, in_page
from autograder.publishing.execution import (
    BookError,
    cache_folder,
    cached,
    content_hash,
    executed_outputs,
    execution_key,
    keep_cached,
    run_all,
)
from autograder.publishing.format_page import format_page
from autograder.publishing.front_page import docname, heading
from autograder.publishing.located import relocated

if TYPE_CHECKING:
    from autograder.proving.kept import Keys

BOOK = ROOT / "book"
STAGE = BOOK / "_stage"
ATLAS = ROOT / "experiments" / "atlas"
PUBLISHED = ("*.html", "llms.txt", "searchindex.js", "_static/*", "_images/*", "_downloads/*")
JUPYTER_BOOK = """
import json, sys
sys.modules["rfc3987_syntax"] = None  # as in autograder.cli
import jupyter_book.sphinx, myst_nb.sphinx_ext, sphinx_book_theme, sphinxcontrib.bibtex
from jupyter_book.cli.main import main
main(json.loads(sys.stdin.read()))
"""
HOW_TO = ("how-to/learners", "how-to/teachers", "how-to/platforms", "how-to/cluster", "how-to/contributors")
APPENDICES = ("cheat-sheet", "notation", "kill-matrix", "threat-model", "practice", "atlas", "autograd", "format")
MATHJAX = ("tex-chtml-full.js", "output/chtml/fonts/**/*", "a11y/*", "sre/**/*")

__all__ = ["BookError", "build", "docname", "executed_outputs"]


def build(with_solutions: bool = True, out: Path | None = None) -> Path:
    """Build the book and return the published folder (book/_build/html unless `out` names another).

    Nothing is done, and a line says so, where every input and the published files are as the last build left them.

    Raises: BookError if a cell fails, or Sphinx warns.
    """
    out = Path(out or BOOK / "_build" / "html").resolve()
    with one_at_a_time(cache_folder() / "build.lock"):
        chapters = all_chapters()
        key = _build_key(chapters, with_solutions)
        if _is_current(out, key):
            print(f"{out}: nothing has changed since it was built, so nothing was done")
            return out
        variant = "solved" if with_solutions else "unsolved"
        stage, work = STAGE / variant, cache_folder() / f"sphinx-{variant}"
        with Renderer() as renderer:
            run_all(chapters, first=lambda: _verify_all(chapters))
            files = staged_files(chapters, with_solutions)
            if sync(files, stage) | _is_framed_anew(files, work):
                shutil.rmtree(work, ignore_errors=True)  # Sphinx never deletes the page of a source that has gone
            renderer.render(stage, work, chapters)
        shutil.copyfile(stage / "llms.txt", work / "_build" / "html" / "llms.txt")
        publish(work / "_build" / "html", out)
        _seal_path(out).write_text(json.dumps({"key": key, "files": _listing(out)}), encoding="utf-8")
    return out


def _verify_all(chapters: list[Chapter]) -> None:
    """Find a slip in the prose before minutes of running code; where nothing is run, staging finds it."""
    for chapter in chapters:
        assemble.verify(chapter)


# ---- stage ----------------------------------------------------------------------------------------------------------


def staged_files(chapters: list[Chapter], with_solutions: bool) -> dict[str, bytes]:
    """Everything that Sphinx reads, by path relative to the staging folder."""
    pages = [*BOOK.glob("*.md"), *BOOK.glob("how-to/*.md"), *BOOK.glob("*.bib")]
    files = {path.relative_to(BOOK).as_posix(): path.read_bytes() for path in pages}
    files["notation.md"] = notation_page(yaml.safe_load((BOOK / "notation.yml").read_text(encoding="utf-8"))).encode()
    files["format.md"] = format_page().encode()
    files |= {f"torch/{path.name}": path.read_bytes() for path in (BOOK / "practice" / "torch").glob("*.py")}
    files["_toc.yml"] = yaml.safe_dump(table_of_contents(chapters), sort_keys=False, allow_unicode=True).encode()
    keys = _stage_keys(chapters, with_solutions)
    [figure] = _kept("staged-clip", keys["clip"], _staged_clip).values()
    files["index.md"] = front_page.front_page(files["index.md"].decode(), chapters, figure.decode(), with_solutions).encode()
    files |= {name: path.read_bytes() for name, path in front_page.LANDING.items()}
    for chapter in chapters:
        name = f"staged-{chapter.assignment}-{'solved' if with_solutions else 'unsolved'}"
        files |= _kept(name, keys[chapter.assignment], functools.partial(_staged, chapter, with_solutions))
    files["cheat-sheet.md"] = cheat_sheet.page(chapters, files).encode()
    files |= _kept("staged-kill-matrix", keys["kill-matrix"], functools.partial(_staged_kill_matrix, chapters))
    files |= _kept("staged-practice", keys["practice"], functools.partial(_staged_practice, chapters))
    files |= _kept("staged-atlas", keys["atlas"], _staged_atlas)
    others = {name: files[f"{name}.md"].decode() for name in (*HOW_TO, *APPENDICES)}
    files["llms.txt"] = front_page.llms_txt(chapters, others).encode()  # which Sphinx does not look at
    return files | assets() | practice_files(chapters, files, with_solutions, keys)


def _staged_clip() -> tuple[dict[str, bytes], bool]:
    return {"clip.html": front_page.clip_figure().encode()}, True


def _staged(chapter: Chapter, with_solutions: bool) -> tuple[dict[str, bytes], bool]:
    return staged_chapter(chapter, executed_outputs(chapter), with_solutions), True


def _staged_kill_matrix(chapters: list[Chapter]) -> tuple[dict[str, bytes], bool]:
    """From the records, as nothing is drawn here. Not to be kept where one is missing, for each build must say so."""
    from autograder.proving import kept  # loads torch, as the checks themselves do

    keys = kept.Keys()
    matrix = {heading(chapter): kill_rows(chapter, keys) for chapter in chapters}
    proved = not any("unproved" in row for rows in matrix.values() for row in rows)
    return {"kill-matrix.md": kill_matrix_page(matrix).encode()}, proved


def _staged_practice(chapters: list[Chapter]) -> tuple[dict[str, bytes], bool]:
    """Likewise, what pages can judge by themselves."""
    from autograder.proving import practice
    from autograder.publishing.practice_page import practice_page, practice_rows

    keys = practice.Keys()
    judged = {heading(chapter): practice_rows(chapter, keys) for chapter in chapters}
    proved = not any("unproved" in row for rows in judged.values() for row in rows)
    return {"practice.md": practice_page(judged).encode()}, proved


def _staged_atlas() -> tuple[dict[str, bytes], bool]:
    """What other libraries compute, from the records of experiments/atlas."""
    from autograder.publishing import atlas_page  # loads torch, for the book's own numbers

    return atlas_page.staged(), True


def _kept(name: str, key: str, make: Callable[[], tuple[dict[str, bytes], bool]]) -> dict[str, bytes]:
    """The texts, by path, that `make` returns, and keeps if it says so: made now, or by a build with the same key."""
    path = cache_folder() / f"{name}-{key}.json"
    if path.exists():
        os.utime(path)
        return {file: text.encode() for file, text in json.loads(path.read_text(encoding="utf-8")).items()}
    made, keep = make()
    if keep:
        keep_cached(path, json.dumps({file: content.decode() for file, content in made.items()}))
    return made


def _stage_keys(chapters: list[Chapter], with_solutions: bool) -> dict[str, str]:
    """Of each chapter, of the kill matrix, of what pages can judge, of what they are handed for it, and of the front page's figure, a
    hash of all that its part of the stage rests on: for a chapter its own text and outputs, the names of pages and exercises in all
    others, and all code and the atlas, as references and checks may take anything from them."""
    code = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    common = content_hash((), [*code, BIBLIOGRAPHY, ROOT / "requirements.txt", ROOT / "constraints.txt", *atlas_records()])
    names = [f"{chapter.page} {[cell.exercise for cell in chapter.exercises]}" for chapter in chapters]
    keys = {
        chapter.assignment: content_hash([common, str(with_solutions), *names], [chapter.path, cached(chapter)])
        for chapter in chapters
    }
    titles = [heading(chapter) for chapter in chapters]
    records = [BOOK / "kill-matrix.md", *kept_records(), *RUNS.glob("*/*.parquet")]
    cells = [cell.source for chapter in chapters for cell in chapter.cells if cell.kind == "code"]
    judging = content_hash([common, *cells], [*sorted((BOOK / "practice").rglob("*.py")), *kept_records()])
    handed = {f"handed-{one.assignment}": content_hash([judging, str(with_solutions)], [cached(one)]) for one in chapters}
    return keys | {
        "kill-matrix": content_hash([common, *titles], records),
        "practice": content_hash([judging, *titles], [BOOK / "practice.md"]),
        "atlas": content_hash([common], [BOOK / "atlas.md", *atlas_records()]),
        "clip": content_hash([common], sorted((ROOT / "course_lib" / "static").glob("explorer.*"))),
        **handed,
    }


def _is_framed_anew(files: dict[str, bytes], work: Path) -> bool:
    """Whether anything has changed that is on every page: the configuration, the theme, our style and scripts, the table of contents.
    Sphinx would render again the pages whose own text has changed."""
    shown = [files["_toc.yml"], *(content for name, content in sorted(files.items()) if name.startswith("vendor/"))]
    pins = [ROOT / "_config.yml", ROOT / "requirements.txt", ROOT / "constraints.txt"]
    frame = content_hash([JUPYTER_BOOK, *(hashlib.sha256(content).hexdigest() for content in shown)], pins)
    seal = work.with_name(f"{work.name}-frame")
    anew = not seal.exists() or seal.read_text(encoding="utf-8") != frame
    seal.write_text(frame, encoding="utf-8")
    return anew


def staged_chapter(chapter: Chapter, outputs: assemble.Outputs, with_solutions: bool) -> dict[str, bytes]:
    """A chapter as Sphinx reads it, and the learners' notebook that its page offers."""
    page = assemble.for_book(chapter, outputs, with_solutions=with_solutions)
    student = assemble.for_learners(chapter, outputs)
    name = f"{chapter.assignment}.ipynb"
    page.cells[0].source += f"\n- **Notebook:** {{download}}`{name} <downloads/{name}>`"
    files = {f"{docname(chapter)}.ipynb": page, f"chapters/downloads/{name}": student}
    return {path: nbformat.writes(notebook).encode() for path, notebook in files.items()}


def practice_files(
    chapters: list[Chapter], files: dict[str, bytes], with_solutions: bool, keys: dict[str, str] | None = None
) -> dict[str, bytes]:
    """What practice in the pages of these chapters needs, of which `files` has the notebooks. With `keys` (`_stage_keys`), what chapters
    hand to their pages is kept from one build to the next."""
    if in_page.fetched() is None:
        return in_page.staged([], {})
    pages = []
    for chapter in chapters:
        make = functools.partial(_staged_page, chapter, with_solutions)
        if keys:
            name = f"handed-to-{chapter.assignment}-{'solved' if with_solutions else 'unsolved'}"
            [content] = _kept(name, keys[f"handed-{chapter.assignment}"], make).values()
        else:
            [content] = make()[0].values()
        pages.append((chapter, json.loads(content)))
    notebooks = {chapter.assignment: files[f"chapters/downloads/{chapter.assignment}.ipynb"] for chapter in chapters}
    return in_page.staged(pages, notebooks)


def _staged_page(chapter: Chapter, with_solutions: bool) -> tuple[dict[str, bytes], bool]:
    handed = in_page.handed_to(chapter, executed_outputs(chapter), with_solutions)
    return {chapter.assignment: json.dumps(handed).encode()}, True


def table_of_contents(chapters: list[Chapter]) -> dict:
    """sphinx-external-toc's table, from the chapters' front matter."""
    entries = [{"file": docname(chapter), "title": heading(chapter)} for chapter in chapters]
    appendices = [{"file": page} for page in APPENDICES]
    how_to = {"caption": "How to use this book", "chapters": [{"file": page} for page in HOW_TO]}
    parts = [how_to, {"caption": "Chapters", "chapters": entries}, {"caption": "Appendices", "chapters": appendices}]
    return {"format": "jb-book", "root": "index", "parts": parts}


def notation_page(notation: dict) -> str:
    """The notation appendix from book/notation.yml: text, tables of (name, shape, meaning), facts."""
    lines = ["# Notation and conventions", "", notation["introduction"], ""]
    for table in notation["tables"]:
        lines += [f"## {table['title']}", "", "| Name | Shape | Meaning |", "|---|---|---|"]
        lines += [f"| {_names(row['names'])} | {_cell(row['shape'])} | {_cell(row['meaning'])} |" for row in table["rows"]]
        lines.append("")
    lines += [f"## {notation['facts']['title']}", ""] + [f"- {fact}" for fact in notation["facts"]["items"]]
    return "\n".join(lines) + "\n"


def _names(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _cell(markdown: str) -> str:
    """Markdown as a cell of a table."""
    return " ".join(markdown.split()).replace("|", "\\|")


def _plain(text: str) -> str:
    """Plain text as a cell of a Markdown table."""
    return " ".join(re.sub(r"([\\`*_{}\[\]<>#|~$])", r"\\\1", text).split())


def kill_matrix_page(matrix: dict[str, list[dict]]) -> str:
    """The appendix on how the checks were tested, from each chapter's heading and rows (`kill_rows`)."""
    lines = [(BOOK / "kill-matrix.md").read_text(encoding="utf-8").rstrip(), ""]
    for title, rows in matrix.items():
        lines += [f"## {title}", ""]
        for row in rows:
            if "unproved" in row:
                lines += [f"### `{row['exercise']}`", "", row["unproved"], ""]
                continue
            if "agents" in row:
                lines += _agents(row)
                continue
            wrong = [
                f"| `{w['name']}` | {_plain(w['message'])} | {w['rejected']} | {w['named']} |" for w in row["misconceptions"]
            ]
            right = [f"| {_plain(r['name'])} | {r['accepted']} |" for r in row["variants"]]
            lines += [f"### `{row['exercise']}`", ""]
            lines += [f"Of {row['seeds']} draws of all cases:", ""]
            lines += ["| Wrong answer | What the learner reads | Rejected | Named |", "|---|---|---|---|", *wrong, ""]
            lines += ["| Correct answer in another style | Accepted |", "|---|---|", *right, ""]
    return "\n".join(lines) + "\n"


def _agents(row: dict) -> list[str]:
    """The part of the appendix on an exercise that is judged by a file, or by training."""
    low, high = row["thresholds"]
    table = [
        f"| {_plain(group['mistake']) or 'trained rightly'} | {_must_fail(group, row)} | {group['agents']} |"
        f" {group['least']:.0f} | {group['middle']:.0f} | {group['most']:.0f} | {group['full']} | {group['half']} | {group['chance']:.1%} |"
        for group in row["agents"]
    ]
    about = (
        f"Mean returns of {row['episodes']} trainings, as many as the grader makes, in sets that differ in their seeds; how many earn all"
        " points, and how many half or more."
        if row.get("of") == "trainings"
        else f"Mean returns of {row['episodes']} recorded episodes, of"
        " agents that differ in the seed of their training; how many earn all points, and how many half or more. Some mistakes let an"
        " agent land all the same: what a file does in flight cannot show them, and the checks of the functions do."
    )
    return [
        f"### `{row['exercise']}`",
        "",
        f"Points grow from none at a mean return of {low:g} to all at {high:g}. {about} The last column"
        " estimates the chance that a further agent goes wrong: that a right one earns less than all points, and that one with a"
        " mistake earns half or more.",
        "",
        "| Agents | Must fail | Runs | Least | Middle | Most | All | Half | Chance |",
        "|---|---|---|---|---|---|---|---|---|",
        *table,
        "",
    ]


def _must_fail(group: dict, row: dict) -> str:
    return "" if not group["mistake"] else "yes" if group["variant"] in row["wrong"] else "no"


def kill_rows(chapter: Chapter, keys: Keys | None = None) -> list[dict]:
    """The chapter's part of the kill matrix, a dict for each exercise, from its kept record; where that does not fit, one that says so."""
    from autograder import checks  # loads torch, as does all that judges
    from autograder.proving import kept

    known, reasons = kept.load(chapter.assignment), kept.unproved(chapter.assignment, keys)
    rows = []
    for exercise in checks.exercises(chapter.assignment):
        if exercise.name in reasons:
            missing = f"{reasons[exercise.name]}; `{kept.remedy(chapter.assignment)}`"
            print(f"{chapter.assignment}: {exercise.name}: {missing}", file=sys.stderr, flush=True)
            rows.append({"exercise": exercise.name, "unproved": f"{missing[0].upper()}{missing[1:]}."})
        else:
            rows.append({"exercise": exercise.name} | known[exercise.name].rows)
    return rows


def assets() -> dict[str, bytes]:
    """Our style sheet and scripts, and MathJax from its package, under a name other than _static, which Jupyter Book treats specially."""
    files = {f"vendor/{path.name}": path.read_bytes() for path in (BOOK / "static").iterdir() if path.suffix in (".css", ".js")}
    package = importlib.util.find_spec("sphinx-mathjax-offline")  # a name that no import statement can spell
    if package is None or not package.submodule_search_locations:
        raise BookError("sphinx-mathjax-offline is not installed: run `make install`")
    mathjax = Path(package.submodule_search_locations[0]) / "static" / "mathjax"
    for pattern in MATHJAX:
        for path in mathjax.glob(pattern):
            if path.is_file():
                files[f"vendor/mathjax/{path.relative_to(mathjax).as_posix()}"] = path.read_bytes()
    return files


def sync(files: dict[str, bytes], folder: Path) -> bool:
    """Make `folder` hold exactly `files`, leaving equal files untouched; True if any file had to be removed."""
    for name, content in files.items():
        path = folder / name
        if not path.is_file() or path.read_bytes() != content:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    surplus = [path for path in folder.rglob("*") if path.is_file() and path.relative_to(folder).as_posix() not in files]
    for path in surplus:
        path.unlink()
    return bool(surplus)


# ---- render and publish ---------------------------------------------------------------------------------------------


class Renderer:
    """Jupyter Book in a process of its own, as Sphinx would keep global state in ours. It loads at once, and then waits for a stage."""

    def __init__(self) -> None:
        command = [sys.executable, "-c", JUPYTER_BOOK]
        self._process = subprocess.Popen(
            command,
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"NO_COLOR": "1"},
        )

    def render(self, stage: Path, work: Path, chapters: list[Chapter]) -> None:
        """Build `stage` into `work`. Raises: BookError with every warning, told of the sources of these chapters."""
        options = ["--config", str(ROOT / "_config.yml"), "--path-output", str(work), "-W", "-n", "--keep-going", "-q"]
        _rewrite_pages_of_other_assets(stage / "vendor", work / "_build" / "html")
        _, complaints = self._process.communicate(json.dumps(["build", str(stage), *options]))
        if self._process.returncode != 0:
            shutil.rmtree(work, ignore_errors=True)  # Sphinx would not repeat a warning about a page that it has read already
            reasons = complaints.partition("Traceback (most recent call last)")[0].strip() or complaints
            told = relocated(reasons, stage, {docname(chapter): chapter for chapter in chapters})
            raise BookError(f"Jupyter Book warned or failed; nothing was published.\n{told}")

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *error: object) -> None:
        if self._process.returncode is None:
            self._process.kill()
            self._process.communicate()


def _rewrite_pages_of_other_assets(assets: Path, html: Path) -> None:
    """Make Sphinx write all pages if an asset is newer than one of them: it copies assets only where it writes, and pages name their
    checksums."""
    pages = list(html.rglob("*.html"))
    newest = max((path.stat().st_mtime for path in assets.rglob("*")), default=0)
    if any(page.stat().st_mtime < newest for page in pages):
        for page in pages:
            os.utime(page, (0, 0))


def publish(html: Path, out: Path) -> None:
    """Copy what is meant to be read beside `out`, then swap the folders."""
    fresh, former = out.with_name(out.name + ".new"), out.with_name(out.name + ".old")
    shutil.rmtree(fresh, ignore_errors=True)
    shutil.rmtree(former, ignore_errors=True)
    pages = "".join(path.read_text(encoding="utf-8") for path in html.rglob("*.html"))
    images = set(re.findall(r"_images/([^\"'&?#]+)", pages))  # earlier builds leave figures behind that no page shows
    for path in sorted(html.rglob("*")):
        name = path.relative_to(html).as_posix()
        wanted = any(fnmatch.fnmatch(name, pattern) for pattern in PUBLISHED)
        if path.is_file() and wanted and (not name.startswith("_images/") or path.name in images):
            (fresh / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, fresh / name)
    for page in fresh.rglob("*.html"):  # docutils gives the entries of a list a role that is deprecated, and no list item
        page.write_text(page.read_text(encoding="utf-8").replace(' role="doc-biblioentry"', ' role="listitem"'), encoding="utf-8")
    if out.exists():
        out.rename(former)
    fresh.rename(out)
    shutil.rmtree(former, ignore_errors=True)


# ---- nothing to do? -------------------------------------------------------------------------------------------------


def _build_key(chapters: list[Chapter], with_solutions: bool) -> str:
    """A hash of all inputs of a build: texts, outputs, code, kept records, this builder, the pins, the configuration. The pages show
    more of the code than their outputs rest on, and rendering them again is quick."""
    own = [path for path in BOOK.rglob("*") if path.is_file() and not path.relative_to(BOOK).parts[0].startswith("_")]
    code = [path for folder in ("autograder", "course_lib", "solutions") for path in (ROOT / folder).rglob("*.py")]
    code += ATLAS.glob("*.py")
    kept = [
        *kept_records(),
        *atlas_records(),
        *front_page.LANDING.values(),
        ROOT / "requirements.txt",
        ROOT / "constraints.txt",
    ]
    chapters_own = [chapter.path for chapter in chapters]
    outputs = [execution_key(chapter) for chapter in chapters]
    return content_hash(
        [str(with_solutions), in_page.fingerprint(), *outputs], [*own, *code, *kept, ROOT / "_config.yml", *chapters_own]
    )


def kept_records() -> list[Path]:
    """The files of autograder.proving.kept and .practice, which this module does not import, as they load torch."""
    return sorted((ROOT / "autograder" / "proving" / "records").rglob("*.json"))


def atlas_records() -> list[Path]:
    """What `course atlas` has written, and the list of what it cannot run."""
    return [*sorted((ATLAS / "records").glob("*.json")), ATLAS / "not_run.yml"]


def _is_current(out: Path, key: str) -> bool:
    seal = _seal_path(out)
    return seal.exists() and out.is_dir() and json.loads(seal.read_text(encoding="utf-8")) == {"key": key, "files": _listing(out)}


def _seal_path(out: Path) -> Path:
    return out.with_name(out.name + ".json")


def _listing(folder: Path) -> dict[str, list[int]]:
    """Size and time of every file, to notice a published page that was edited or lost."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): [path.stat().st_size, path.stat().st_mtime_ns] for path in files}
