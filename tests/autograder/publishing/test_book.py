"""The book builder: what makes it run code again, what it stages, and what it must never publish."""

from __future__ import annotations

import dataclasses
import os
import re
import types

import nbformat
import pytest
import yaml

from autograder.authoring import assemble
from autograder.authoring.chapter import parse
from autograder.authoring.contract import references
from autograder.paths import ROOT
from autograder.publishing import book, execution, in_page, practice_page

HOW_TO_PAGES = sorted((ROOT / "book" / "how-to").glob("*.md"))


MACHINERY = {
    "autograder/authoring/freeze.py": "def write():\n    pass\n",
    "autograder/authoring/artefacts.py": "def hand_in():\n    pass\n",
    "autograder/publishing/execution.py": "def _environment():\n    pass\n",
}


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A course_lib, solutions and checks of our own, to change without touching the real ones."""
    files = MACHINERY | {
        "course_lib/__init__.py": "from course_lib.checks.client import check\n",
        "course_lib/checks/client.py": "def check():\n    return 1\n",
        "course_lib/one.py": "def one():\n    return open('numbers.csv')\n\ndef two():\n    return 2\n",
        "course_lib/data/numbers.csv": "1\n",
        "course_lib/data/others.csv": "1\n",
        "course_lib/frozen/case.npz": "",
        "solutions/ch99.py": "from course_lib.one import one\n\ndef double(x):\n    return one()\n\ndef quadruple(x):\n    return 4 * x\n",
        "solutions/ch46.py": "def unrelated():\n    return 1\n",
        "autograder/checks/ch99.py": "from solutions.ch99 import double\n\nEXERCISES = (double,)\n",
        "requirements.txt": "",
        "constraints.txt": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
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


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("course_lib/one.py", "'numbers.csv'", "'numbers.csv', 'rb'"),
        ("course_lib/data/numbers.csv", "1", "2"),
        ("course_lib/checks/client.py", "return 1", "return 2"),
        ("solutions/ch99.py", "4 * x", "x * 4"),
        ("autograder/checks/ch99.py", "(double,)", "(double, double)"),
        ("autograder/authoring/freeze.py", "pass", "return 1"),
        ("constraints.txt", "", "torch==3"),
    ],
)
def test_code_runs_again_after_a_change_of(name, old, new, tiny, elsewhere):
    key = execution.execution_key(tiny.chapter)
    (elsewhere / name).write_text((elsewhere / name).read_text().replace(old, new))
    assert execution.execution_key(tiny.chapter) != key


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("course_lib/one.py", "return 2", "return 3"),
        ("course_lib/one.py", "def one", "# a comment\ndef one"),
        ("course_lib/data/others.csv", "1", "2"),
        ("course_lib/frozen/case.npz", "", "generated"),
        ("solutions/ch46.py", "return 1", "return 2"),
        ("solutions/ch99.py", "4 * x", "4 * x  # a comment"),
    ],
)
def test_code_does_not_run_again_after_a_change_of(name, old, new, tiny, elsewhere):
    key = execution.execution_key(tiny.chapter)
    (elsewhere / name).write_text((elsewhere / name).read_text().replace(old, new))
    assert execution.execution_key(tiny.chapter) == key


def test_a_new_record_of_a_chapters_experiment_runs_it_again(tiny, elsewhere, tmp_path, monkeypatch):
    monkeypatch.setattr(execution, "RUNS", tmp_path)
    page = dataclasses.replace(tiny.chapter, experiments=("toy",))
    key = execution.execution_key(page)
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "a-0.parquet").write_bytes(b"a record")
    assert execution.execution_key(page) != key


def chapter_with(tmp_path, monkeypatch, code, tags=""):
    """A chapter of one cell, and the builder's folders in tmp_path."""
    monkeypatch.setattr(execution, "ROOT", tmp_path)
    monkeypatch.setattr(execution, "COURSE_LIB", tmp_path / "course_lib")
    monkeypatch.setattr("autograder.checks.exercises", lambda assignment: ())
    files = MACHINERY | dict.fromkeys(["requirements.txt", "constraints.txt", "autograder/checks/ch97.py"], "")
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
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


def test_a_picture_without_words_ends_the_run_at_its_cell(tmp_path, monkeypatch):
    code = "from IPython.display import SVG\nSVG('<svg xmlns=\"http://www.w3.org/2000/svg\"/>')"
    with pytest.raises(execution.BookError, match=r"ch97_one\.md:\d+: .*: this cell shows a picture: say with the option `alt"):
        execution.executed_outputs(chapter_with(tmp_path, monkeypatch, code))


def test_outputs_are_those_of_each_code_cell_and_come_from_the_cache_the_second_time(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    chapter = chapter_with(tmp_path, monkeypatch, "import os\nprint(os.environ['COURSE_BOOK'], os.environ['OMP_NUM_THREADS'])")
    [[output]] = execution.executed_outputs(chapter)
    assert output.text == "1 1\n"
    monkeypatch.setattr(execution, "_execute", None)
    assert execution.executed_outputs(chapter) == [[output]]


def test_the_last_three_states_are_kept_so_that_an_undo_runs_nothing(tmp_path, monkeypatch):
    def outputs(number):
        chapter = chapter_with(tmp_path, monkeypatch, f"print({number})")
        return [output.text for output in execution.executed_outputs(chapter)[0]]

    for number in range(4):
        assert outputs(number) == [f"{number}\n"]
    monkeypatch.setattr(execution, "_execute", None)
    assert [outputs(number) for number in (1, 2, 3)] == [["1\n"], ["2\n"], ["3\n"]]
    assert len(list(execution.cache_folder().glob("ch97-*.ipynb"))) == 3
    with pytest.raises(TypeError):  # it would run: the oldest has made room
        outputs(0)


def test_a_state_that_is_used_is_not_the_one_that_makes_room(tmp_path):
    for number in (1, 2, 3):
        execution.keep_cached(tmp_path / f"ch97-{number}.ipynb", "")
        os.utime(tmp_path / f"ch97-{number}.ipynb", (number, number))
    os.utime(tmp_path / "ch97-1.ipynb", (9, 9))
    execution.keep_cached(tmp_path / "ch97-4.ipynb", "")
    assert {path.stem for path in tmp_path.iterdir()} == {"ch97-1", "ch97-3", "ch97-4"}


def test_all_chapters_run_and_every_error_is_told(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(execution, "ROOT", tmp_path)
    monkeypatch.setattr(execution, "execution_key", lambda chapter: "key")
    ran = []

    def execute(chapter):
        ran.append(chapter.number)
        if chapter.number != 98:
            raise execution.BookError(f"{chapter.number} fails")
        return nbformat.v4.new_notebook(metadata={"cpu_seconds": 3.0})

    monkeypatch.setattr(execution, "_execute", execute)
    chapters = [dataclasses.replace(tiny.before, number=number) for number in (97, 98, 99)]
    for _ in range(2):
        with pytest.raises(execution.BookError, match=r"^97 fails\n99 fails$"):
            execution.run_all(chapters, jobs=1)
    assert ran == [97, 98, 99, 97, 99]  # 98 is kept


def test_what_must_come_first_does_and_only_if_anything_runs(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(execution, "ROOT", tmp_path)
    monkeypatch.setattr(execution, "execution_key", lambda chapter: "key")
    called: list[str] = []
    monkeypatch.setattr(execution, "_execute", lambda chapter: called.append("run") or nbformat.v4.new_notebook())
    for _ in range(2):
        execution.run_all([tiny.before], jobs=1, first=lambda: called.append("first"))
    assert called == ["first", "run"]


def test_those_that_took_longest_begin_first(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(execution, "ROOT", tmp_path)
    monkeypatch.setattr(execution, "execution_key", lambda chapter: "new")
    monkeypatch.setattr(execution, "_execute", lambda chapter: ran.append(chapter.number) or nbformat.v4.new_notebook())
    ran: list[int] = []
    for number, seconds in ((96, 3.0), (97, 20.0), (98, 1.0)):
        notebook = nbformat.v4.new_notebook(metadata={"cpu_seconds": seconds})
        execution.keep_cached(execution.cache_folder() / f"ch{number}-old.ipynb", nbformat.writes(notebook))
    execution.run_all([dataclasses.replace(tiny.before, number=number) for number in (96, 97, 98, 99)], jobs=1)
    assert ran == [99, 97, 96, 98]  # nobody knows how long a new one takes


def test_a_page_above_its_budget_says_where_its_longest_cells_are(tiny):
    cells = [cell for cell in tiny.chapter.cells if cell.kind == "code"]
    seconds = [1.0] * (len(cells) - 2) + [execution.PAGE_BUDGET, 2.0]
    told = execution._cost(tiny.chapter, seconds)
    assert told.startswith(f"{sum(seconds):.0f} s of processor time: above a page's budget of {execution.PAGE_BUDGET}")
    where = [int(place) for place in re.findall(r" s at \S+:(\d+)", told)]
    assert where[:2] == [cells[-2].line, cells[-1].line]
    within = [0.0] * (len(cells) - 1) + [float(execution.PAGE_BUDGET)]
    assert execution._cost(tiny.chapter, within) == f"{execution.PAGE_BUDGET} s of processor time"


def test_a_page_is_charged_for_its_own_kernel_and_what_that_has_started():
    times = types.SimpleNamespace(user=1.0, system=2.0, children_user=4.0, children_system=8.0, iowait=16.0)
    assert execution._processor_seconds(types.SimpleNamespace(cpu_times=lambda: times)) == 15.0


def test_table_of_contents_comes_from_the_front_matter(tiny):
    toc = book.table_of_contents([tiny.before, tiny.chapter])
    [how_to, chapters, appendices] = toc["parts"]
    assert sorted(f"{entry['file']}.md" for entry in how_to["chapters"]) == [f"how-to/{path.name}" for path in HOW_TO_PAGES]
    assert [entry["file"] for entry in chapters["chapters"]] == ["chapters/ch98_before", "chapters/ch99_tiny"]
    assert chapters["chapters"][1]["title"] == f"99. {tiny.chapter.title}"
    assert [entry["file"] for entry in appendices["chapters"]] == [
        "cheat-sheet",
        "notation",
        "kill-matrix",
        "threat-model",
        "practice",
        "atlas",
        "autograd",
        "format",
    ]


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


def test_staging_touches_changed_files_only_and_removes_what_has_gone(tmp_path):
    assert not book.sync({"a/one": b"1", "two": b"2"}, tmp_path)
    before = (tmp_path / "a/one").stat().st_mtime_ns
    assert book.sync({"a/one": b"1", "three": b"3"}, tmp_path)
    assert (tmp_path / "a/one").stat().st_mtime_ns == before
    assert not (tmp_path / "two").exists()


@pytest.fixture
def stage_keys(tiny, elsewhere, monkeypatch):
    """The keys of the tiny course's stage: stage_keys(old, new) with an edit in the text of chapter 99."""
    monkeypatch.setattr(book, "ROOT", elsewhere)
    monkeypatch.setattr(book, "cached", lambda chapter: elsewhere / f"{chapter.assignment}.ipynb")
    for name in ("ch98", "ch99"):
        (elsewhere / f"{name}.ipynb").write_text("outputs")

    def keys(old="", new="", with_solutions=True):
        return book._stage_keys([tiny.before, edited(tiny.chapter, old, new, elsewhere)], with_solutions)

    return keys


def test_prose_makes_its_own_chapter_anew_and_no_other(stage_keys):
    before, after = stage_keys(), stage_keys("- In a list:", "- In one list:")
    assert {name for name, key in after.items() if key != before[name]} == {"ch99"}


def test_a_title_is_in_the_kill_matrix_too_and_an_exercise_concerns_all_chapters(stage_keys):
    before = stage_keys()
    titled, named = stage_keys("A tiny chapter", "A small chapter"), stage_keys("exercise: double", "exercise: twofold")
    assert {name for name, key in titled.items() if key != before[name]} == {"ch99", "kill-matrix", "practice"}
    assert {name for name, key in named.items() if key != before[name]} == {"ch98", "ch99"}


@pytest.mark.parametrize("file", ["course_lib/one.py", "solutions/ch46.py", "autograder/checks/ch99.py", "constraints.txt"])
def test_code_and_pins_make_the_whole_stage_anew(stage_keys, elsewhere, file):
    before = stage_keys()
    (elsewhere / file).write_text((elsewhere / file).read_text() + "# changed")
    assert not before.items() & stage_keys().items()


def test_outputs_and_the_edition_make_a_chapter_anew_and_a_record_the_kill_matrix(stage_keys, elsewhere):
    before = stage_keys()
    assert {name for name, key in stage_keys(with_solutions=False).items() if key != before[name]} == {
        *("ch98", "ch99", "handed-ch98", "handed-ch99")
    }
    (elsewhere / "ch98.ipynb").write_text("other outputs")
    (elsewhere / "autograder/proving/records").mkdir(parents=True)
    (elsewhere / "autograder/proving/records/ch99.json").write_text("{}")
    assert {name for name, key in stage_keys().items() if key != before[name]} == {
        *("ch98", "kill-matrix", "practice", "handed-ch98", "handed-ch99")
    }


def test_a_record_of_another_library_makes_the_atlas_anew_and_what_checks_say_of_libraries(stage_keys, tmp_path, monkeypatch):
    monkeypatch.setattr(book, "ATLAS", tmp_path / "atlas")
    (tmp_path / "atlas" / "records").mkdir(parents=True)
    (tmp_path / "atlas" / "not_run.yml").write_text("[]")
    before = stage_keys()
    (tmp_path / "atlas" / "records" / "trl.json").write_text("{}")
    assert {"atlas", "practice", "ch99"} <= {name for name, key in stage_keys().items() if key != before[name]}


def test_a_part_of_the_stage_is_made_once_unless_it_must_not_be_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(book, "cache_folder", lambda: tmp_path)
    made = []

    def make(keep):
        made.append(keep)
        return {"a.md": "größer".encode()}, keep

    for key, keep in (("1", True), ("1", True), ("2", True), ("3", False), ("3", False)):
        assert book._kept("part", key, lambda keep=keep: make(keep)) == {"a.md": "größer".encode()}
    assert made == [True, True, False, False]


def test_an_unproved_exercise_is_told_by_each_build(tiny, monkeypatch):
    monkeypatch.setattr(book, "kill_rows", lambda chapter, keys: [{"exercise": "double", "unproved": "Never proved."}])
    files, keep = book._staged_kill_matrix([tiny.chapter])
    assert b"Never proved." in files["kill-matrix.md"] and not keep
    monkeypatch.setattr(book, "kill_rows", lambda chapter, keys: [])
    assert book._staged_kill_matrix([tiny.chapter])[1]


def test_what_is_on_every_page_renders_every_page_again(tmp_path, monkeypatch):
    monkeypatch.setattr(book, "ROOT", tmp_path)
    names = ("_config.yml", "requirements.txt", "constraints.txt")
    for name in names:
        (tmp_path / name).write_text("")
    files = {"_toc.yml": b"", "vendor/course.css": b"", "vendor/course.js": b"", "index.md": b"", "chapters/ch99_tiny.ipynb": b""}

    def anew():
        return book._is_framed_anew(files, tmp_path / "sphinx")

    assert anew() and not anew()
    for name in names:
        (tmp_path / name).write_text("# changed")
        assert anew() and not anew(), name
    for name in files:
        files[name] = b"changed"
        assert anew() == (name not in ("index.md", "chapters/ch99_tiny.ipynb")), name


@pytest.fixture(scope="module")
def bare(tiny, tmp_path_factory):
    """The tiny course's book without solutions, built in a folder of its own."""
    folder = tmp_path_factory.mktemp("bare")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(book, "all_chapters", lambda: [tiny.before, tiny.chapter])
        patch.setattr(book, "executed_outputs", lambda chapter: tiny.outputs if chapter.number == 99 else [])
        patch.setattr(book, "run_all", lambda chapters, first: None)
        patch.setattr(book, "kill_rows", lambda chapter, keys: [])
        patch.setattr(practice_page, "practice_rows", lambda chapter, keys: [])
        patch.setattr(in_page, "fetched", lambda: None)
        patch.setattr(book, "_build_key", lambda chapters, with_solutions: "tiny")
        patch.setattr(
            book,
            "_stage_keys",
            lambda chapters, with_solutions: dict.fromkeys(("ch98", "ch99", "kill-matrix", "practice", "atlas", "clip"), "tiny"),
        )
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
        "cheat-sheet.html",
        "notation.html",
        "kill-matrix.html",
        "threat-model.html",
        "practice.html",
        "atlas.html",
        "autograd.html",
        "format.html",
        "search.html",
        "searchindex.js",
        "llms.txt",
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
