"""The book builder: what makes it run code again, what it stages, and what it must never publish."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys

import nbformat
import pytest
import yaml

from autograder.authoring import assemble
from autograder.authoring.chapter import parse
from autograder.authoring.contract import references
from autograder.paths import ROOT
from autograder.publishing import book, execution

HOW_TO_PAGES = sorted((ROOT / "book" / "how-to").glob("*.md"))


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A course_lib, solutions and checks of our own, to change without touching the real ones."""
    files = [
        "course_lib/one.py",
        "course_lib/frozen/case.npz",
        "solutions/ch99.py",
        "autograder/authoring/spec.py",
        "autograder/authoring/freeze.py",
    ]
    for name in [*files, "autograder/checks/ch99.py", "requirements.txt", "constraints.txt"]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("first\n")
    monkeypatch.setattr(execution, "ROOT", tmp_path)
    monkeypatch.setattr(execution, "COURSE_LIB", tmp_path / "course_lib")
    return tmp_path


def edited(chapter, old, new, tmp_path):
    text = chapter.path.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / chapter.path.name
    path.write_text(text.replace(old, new), encoding="utf-8")
    return parse(path)


def first_code_line(chapter):
    return next(cell.source.splitlines()[0] for cell in chapter.cells if cell.kind == "code" and not cell.exercise)


def test_prose_does_not_run_code_again(tiny, elsewhere):
    key = execution.execution_key(tiny.chapter)
    reworded = dataclasses.replace(tiny.chapter, cells=tuple(reword(cell) for cell in tiny.chapter.cells), title="Another title")
    assert execution.execution_key(reworded) == key


def reword(cell):
    return dataclasses.replace(cell, source="Other words.") if cell.kind == "markdown" else cell


def test_code_runs_again_after_a_change_of_code(tiny, elsewhere):
    line = first_code_line(tiny.chapter)
    changed = edited(tiny.chapter, line, f"{line}  # changed", elsewhere)
    assert execution.execution_key(changed) != execution.execution_key(tiny.chapter)


@pytest.mark.parametrize("name", ["course_lib/one.py", "solutions/ch99.py", "autograder/checks/ch99.py", "constraints.txt"])
def test_code_runs_again_after_a_change_of(name, tiny, elsewhere):
    key = execution.execution_key(tiny.chapter)
    (elsewhere / name).write_text("second\n")
    assert execution.execution_key(tiny.chapter) != key


def test_a_new_record_of_a_chapters_experiment_runs_it_again(tiny, elsewhere, tmp_path, monkeypatch):
    monkeypatch.setattr(execution, "RUNS", tmp_path)
    page = dataclasses.replace(tiny.chapter, experiments=("toy",))
    key = execution.execution_key(page)
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "a-0.parquet").write_bytes(b"a record")
    assert execution.execution_key(page) != key


def test_generated_checks_do_not_count_as_a_change(tiny, elsewhere):
    key = execution.execution_key(tiny.chapter)
    (elsewhere / "course_lib/frozen/case.npz").write_text("second\n")
    assert execution.execution_key(tiny.chapter) == key


def chapter_with(tmp_path, monkeypatch, code, tags=""):
    """A chapter of one cell, and the builder's folders in tmp_path."""
    monkeypatch.setattr(execution, "ROOT", tmp_path)
    monkeypatch.setattr(execution, "COURSE_LIB", tmp_path / "course_lib")
    monkeypatch.setattr("autograder.checks.exercises", lambda assignment: ())
    for name in (
        "requirements.txt",
        "constraints.txt",
        "autograder/authoring/spec.py",
        "autograder/authoring/freeze.py",
        "autograder/checks/ch97.py",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    options = "chapter: 97\ntitle: T\nminutes: 1\nprerequisites: []\nbuilds: b\nsummary: s\n"
    path = tmp_path / "ch97_one.md"
    path.write_text(f"---\n{options}---\n\n# Words\n\n```{{code-cell}} ipython3\n---\ntags: [live{tags}]\n---\n{code}\n```\n")
    return parse(path)


def test_a_failing_cell_is_named_by_file_and_line_and_leaves_a_report(tmp_path, monkeypatch):
    chapter = chapter_with(tmp_path, monkeypatch, "import math\nmath.sqrt(-1)")
    with pytest.raises(execution.BookError, match=r"ch97_one\.md:\d+: cell `import math`: ValueError") as caught:
        execution.executed_outputs(chapter)
    report = tmp_path / re.search(r"report: (.*)\)", str(caught.value))[1]
    assert "math.sqrt(-1)" in report.read_text()
    assert list(execution.cache_folder().glob("*.ipynb")) == []


def test_a_warning_on_a_page_is_an_error(tmp_path, monkeypatch):
    chapter = chapter_with(tmp_path, monkeypatch, "import warnings\nwarnings.warn('look out')")
    with pytest.raises(execution.BookError, match="stderr"):
        execution.executed_outputs(chapter)


def test_outputs_are_those_of_each_code_cell_and_come_from_the_cache_the_second_time(tmp_path, monkeypatch):
    chapter = chapter_with(tmp_path, monkeypatch, "import os\nprint(os.environ['COURSE_BOOK'], os.environ['OMP_NUM_THREADS'])")
    [[output]] = execution.executed_outputs(chapter)
    assert output.text == "1 1\n"
    monkeypatch.setattr(execution, "_execute", None)
    assert execution.executed_outputs(chapter) == [[output]]


def test_table_of_contents_comes_from_the_front_matter(tiny):
    toc = book.table_of_contents([tiny.before, tiny.chapter])
    [how_to, chapters, appendices] = toc["parts"]
    assert sorted(f"{entry['file']}.md" for entry in how_to["chapters"]) == [f"how-to/{path.name}" for path in HOW_TO_PAGES]
    assert [entry["file"] for entry in chapters["chapters"]] == ["chapters/ch98_before", "chapters/ch99_tiny"]
    assert chapters["chapters"][1]["title"] == f"99. {tiny.chapter.title}"
    assert [entry["file"] for entry in appendices["chapters"]] == ["notation", "kill-matrix"]


def test_notation_page_has_every_name_and_keeps_bars_inside_their_cells():
    notation = yaml.safe_load((ROOT / "book" / "notation.yml").read_text(encoding="utf-8"))
    page = book.notation_page(notation)
    for table in notation["tables"]:
        for row in table["rows"]:
            assert all(f"`{name}`" in page for name in row["names"])
    rows = [line for line in page.splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} == {4}


def test_kill_matrix_shows_messages_as_they_are_written():
    wrong = {"name": "flipped", "message": "a|b and *c* and x_t < 1", "rejected": 3, "named": 2}
    rows = [{"exercise": "double", "seeds": 3, "misconceptions": [wrong], "variants": [{"name": "loop", "accepted": 3}]}]
    page = book.kill_matrix_page({"99. Tiny": rows})
    assert r"| `flipped` | a\|b and \*c\* and x\_t \< 1 | 3 | 2 |" in page
    assert "| loop | 3 |" in page


def test_kill_matrix_shows_the_agents_behind_the_thresholds_of_a_file():
    row = {"variant": "x", "agents": 20, "least": 201.4, "middle": 250.0, "most": 271.8, "full": 20, "half": 20, "chance": 0.004}
    agents = [row | {"mistake": ""}, row | {"mistake": "It descends | the hill.", "full": 0, "half": 1}]
    flown = {"exercise": "train", "thresholds": (0.0, 200.0), "episodes": 100, "agents": agents, "wrong": ["x"]}
    page = book.kill_matrix_page({"99. Tiny": [flown]})
    assert "Points grow from none at a mean return of 0 to all at 200." in page and "100 recorded episodes" in page
    assert "| trained rightly |  | 20 | 201 | 250 | 272 | 20 | 20 | 0.4% |" in page
    assert r"| It descends \| the hill. | yes | 20 | 201 | 250 | 272 | 0 | 1 | 0.4% |" in page


def test_kill_matrix_is_keyed_on_all_modules_that_decide_it():
    imports = "import sys, autograder.killmatrix, autograder.checks as checks; checks.all_exercises()"
    loaded = f"{imports}; print(*(name for name in sys.modules if name.startswith('course_lib.')))"
    output = subprocess.run([sys.executable, "-c", loaded], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    used = {name.removeprefix("course_lib.") for name in output.split()} & set(book.WITHOUT_A_SAY)
    assert used <= {"artefact", "chapters", "checking", "flight", "notebook"}  # loaded by the package, or by what freezes


def test_staging_touches_changed_files_only_and_removes_what_has_gone(tmp_path):
    assert not book.sync({"a/one": b"1", "two": b"2"}, tmp_path)
    before = (tmp_path / "a/one").stat().st_mtime_ns
    assert book.sync({"a/one": b"1", "three": b"3"}, tmp_path)
    assert (tmp_path / "a/one").stat().st_mtime_ns == before
    assert not (tmp_path / "two").exists()


@pytest.fixture(scope="module")
def bare(tiny, tmp_path_factory):
    """The tiny course's book without solutions, built in a folder of its own."""
    folder = tmp_path_factory.mktemp("bare")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(book, "all_chapters", lambda: [tiny.before, tiny.chapter])
        patch.setattr(book, "executed_outputs", lambda chapter: tiny.outputs if chapter.number == 99 else [])
        patch.setattr(book, "kill_rows", lambda chapter: [])
        patch.setattr(book, "_build_key", lambda chapters, with_solutions: "tiny")
        patch.setattr(book, "cache_folder", lambda: folder)
        patch.setattr(book, "STAGE", folder / "stage")
        patch.setattr(assemble, "real_sources", tiny.sources)
        yield book.build(with_solutions=False, out=folder / "html")


def test_a_book_without_solutions_has_none_in_any_file(bare, tiny):
    bodies = [line.strip() for line in secrets(tiny)]
    assert bodies
    for path in bare.rglob("*"):
        if path.is_file():
            content = re.sub(rb"<[^>]+>", b"", path.read_bytes()).decode("utf-8", "replace")
            assert [line for line in bodies if line in content] == [], path


def secrets(tiny):
    """The lines of the references' bodies that say something."""
    sources = tiny.sources(tiny.chapter)
    return [
        line for found in references(tiny.chapter, sources).values() for line in found.body.splitlines() if len(line.strip()) > 8
    ]


def test_only_pages_and_what_they_show_is_published(bare):
    tops = {path.relative_to(bare).parts[0] for path in bare.rglob("*") if path.is_file()}
    assert tops == {
        "index.html",
        "notation.html",
        "kill-matrix.html",
        "search.html",
        "searchindex.js",
        "how-to",
        "chapters",
        "_static",
        "_images",
        "_downloads",
    }
    assert {path.suffix for path in (bare / "chapters").iterdir()} == {".html"}


def test_download_is_the_students_notebook(bare):
    [path] = (bare / "_downloads").rglob("ch99.ipynb")
    assert "NotImplementedError" in nbformat.writes(nbformat.read(path, as_version=4))
