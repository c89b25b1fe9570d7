"""A copy is listed whatever names and order it has; right answers that look alike because they must are not."""

from __future__ import annotations

import copy
import csv
import inspect
import re
from pathlib import Path

import nbformat
import pytest
from typer.testing import CliRunner

from autograder import cli, paths
from autograder.authoring import assemble, chapter
from autograder.checks import ch44
from autograder.platforms import similar
from solutions import ch44 as reference

VARIANTS = {  # accepted answers of autograder/checks/ch44.py, written one by one
    "td_residuals": [ch44._td_by_steps, ch44._td_numpy, ch44._td_masked_fill],
    "compute_gae": [ch44._one_environment_at_a_time, ch44._in_numpy, ch44._by_doubling],
    "lambda_returns": [ch44._returns_numpy, ch44._returns_buffer, ch44._returns_rows],
    "explained_variance": [ch44._explained_numpy, ch44._explained_sums, ch44._explained_deviations],
}
OWN = '''
def compute_gae(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    """My own way."""
    horizon = rewards.shape[0]
    going_on = 1 - terminated.to(rewards.dtype)
    errors = [rewards[k] + gamma * going_on[k] * next_values[k] - values[k] for k in range(horizon)]
    table = []
    memory = 0.0
    for k in sorted(range(horizon), key=lambda index: -index):
        blocked = torch.logical_or(terminated[k], truncated[k])
        memory = errors[k] + torch.where(blocked, torch.zeros_like(errors[k]), gamma * gae_lambda * memory)
        table.insert(0, memory)  # front
    return torch.stack(table).reshape(rewards.shape)
'''
HELPER = """
def rolling_summary(series, width):
    out = {}
    for start in range(0, len(series) - width, max(width // 2, 1)):
        window = series[start : start + width]
        out[start] = (min(window), max(window), sum(window) / width, window.count(window[0]))
    return {key: value for key, value in out.items() if value[2] > value[0]}
"""


@pytest.fixture(scope="module")
def task():
    return similar.Task("ch44")


@pytest.fixture(scope="module")
def release():
    return assemble.for_learners(chapter.load("ch44"))


def answered(release, answers, last=""):
    notebook = copy.deepcopy(release)
    for cell in notebook.cells:
        name = cell.metadata.get("nbgrader", {}).get("grade_id")
        if name in answers:
            cell.source = answers[name]
    if last:
        notebook.cells.append(nbformat.v4.new_code_cell(last))
    return notebook


def named(name, function):
    source = re.sub(r"def \w+", f"def {name}", inspect.getsource(function), count=1)
    return re.sub(r'    """[\s\S]*?"""\n', "", source)


def renamed(source, suffix):
    own = set(re.findall(r"^ +(\w+)(?:\[\w+\])? [-+*/]?= ", source, re.M)) | set(re.findall(r"\bfor (\w+) in", source))
    own -= {"rewards", "values", "returns", "advantages"}  # arguments, here and there put into another type
    for name in own:
        source = re.sub(rf"(?<![.\w]){name}\b", f"{name[0]}_{suffix}", source)
    return source


def pairs(task, notebooks, **options):
    papers = [task.paper(student, notebook) for student, notebook in notebooks.items()]
    return {pair.students: pair for pair in similar.compare("ch44", papers, task.known, **options)}


def test_a_copy_with_other_names_comments_and_layout_is_found(task, release):
    disguised = (
        renamed(OWN, "x")
        .replace("# front", "# prepend it")
        .replace('"""My own way."""\n', "")
        .replace(", key=", ",\n        key=")
    )
    assert disguised != OWN
    found = pairs(task, {"ada": answered(release, {"compute_gae": OWN}), "bob": answered(release, {"compute_gae": disguised})})
    pair = found["ada", "bob"]
    assert pair.similarity > 0.8 and pair.exercises == ("compute_gae",)
    assert "gamma" in pair.longest.text and pair.longest.first[1] < pair.longest.first[2]


def test_a_copy_in_another_order_is_found_and_its_helpers_cell_is_named(task, release):
    first = answered(release, {"compute_gae": OWN}, HELPER)
    second = answered(release, {"compute_gae": HELPER + renamed(OWN, "y")})
    pair = pairs(task, {"ada": first, "bob": second})["ada", "bob"]
    assert pair.similarity > 0.8 and set(pair.exercises) == {"compute_gae", "other cells"}


def test_the_references_form_is_nobodys(task, release):
    own = {name: named(name, getattr(reference, name)) for name in VARIANTS}
    notebooks = {
        f"s{number}": answered(release, {name: renamed(text, number) for name, text in own.items()}) for number in range(4)
    }
    assert not pairs(task, notebooks, at_least=0.0)


def test_known_right_answers_in_other_styles_are_nobodys_either(task, release):
    notebooks = {
        f"s{number}": answered(release, {name: renamed(named(name, one[number % 3]), number) for name, one in VARIANTS.items()})
        for number in range(6)
    }
    assert not pairs(task, notebooks, at_least=0.0)


def test_independent_answers_that_nobody_knew_of_are_not_listed(task, release):
    """The same answers, but as if the checks did not hold them: only the release and the references explain anything."""
    sources = [cell.source for cell in release.cells if cell.cell_type == "code"]
    sources.append((paths.ROOT / "solutions" / "ch44.py").read_text())
    known = {run for source in sources for run in similar._runs([one.text for one in task.tokens(source)], similar.KNOWN_RUN)}
    papers = [
        task.paper(
            f"s{number}", answered(release, {name: renamed(named(name, one[number]), number) for name, one in VARIANTS.items()})
        )
        for number in range(3)
    ]
    again = answered(release, {name: renamed(named(name, one[0]), "z") for name, one in VARIANTS.items()})
    found = similar.compare("ch44", [*papers, task.paper("copy", again)], known)
    assert [pair.students for pair in found] == [("s0", "copy")] and found[0].similarity == 1.0


def test_a_small_own_touch_to_the_references_form_is_not_enough(task, release):
    source = (
        named("explained_variance", reference.explained_variance)
        + "\n\nprint(explained_variance(torch.ones(3), torch.ones(3)))\n"
    )
    notebooks = {student: answered(release, {"explained_variance": source}) for student in ("ada", "bob")}
    assert not pairs(task, notebooks)


def test_what_much_of_the_class_has_is_a_form_that_the_course_suggests(task, release):
    notebooks = {
        f"s{number}": answered(release, {"compute_gae": renamed(OWN, number)}) for number in range(similar.COMMON_AT_LEAST)
    }
    assert len(pairs(task, notebooks)) == 15
    assert not pairs(task, notebooks | {"one more": answered(release, {"compute_gae": OWN})})


def test_released_and_broken_cells_are_no_ones_answers(task, release):
    broken = "def compute_gae(rewards:\n    '''never closed\n  %magic\n" + HELPER
    found = pairs(task, {"ada": answered(release, {"compute_gae": broken}), "bob": answered(release, {"compute_gae": broken})})
    assert found["ada", "bob"].similarity == 1.0
    assert not pairs(task, {"ada": release, "bob": release}, at_least=0.0)


def test_endless_repetition_ends(task, release):
    notebooks = {student: answered(release, {}, "zz = yy[3]\n" * 20_000) for student in ("ada", "bob")}
    assert ("ada", "bob") in pairs(task, notebooks)


@pytest.fixture
def submitted(tmp_path, release):
    for student, answer in (("ada", OWN), ("=bob", renamed(OWN, "x")), ("cyd", "def compute_gae():\n    return 0\n")):
        path = tmp_path / "submitted" / student / "ch44" / "ch44.ipynb"
        path.parent.mkdir(parents=True)
        nbformat.write(answered(release, {"compute_gae": answer}), path)
    return tmp_path / "submitted"


def run(*arguments):
    return CliRunner().invoke(cli.app, ["similar", *map(str, arguments)], env={"COLUMNS": "120"})


def test_the_command_lists_pairs_says_that_it_is_no_verdict_and_writes_a_table(submitted, tmp_path):
    done = run(submitted, "--out", tmp_path / "similar.csv")
    assert done.exit_code == 0, done.output
    assert "A list to look at, not a verdict" in done.output and "=bob and ada" in done.output and "compute_gae" in done.output
    with open(tmp_path / "similar.csv", newline="") as file:
        [row] = csv.DictReader(file)
    assert row["first"] == "'=bob" and row["second"] == "ada" and float(row["similarity"]) > 0.8
    assert row["lines_of_first"].startswith("cell ") and "gamma" in row["passage"]
    assert "No pair" in run(submitted, "--assignment", "ch43").output or run(submitted, "--assignment", "ch43").exit_code == 2


def test_what_cannot_be_compared_is_named(submitted, tmp_path):
    (submitted / "cyd" / "ch44" / "ch44.ipynb").write_text("no notebook")
    (submitted / "dan" / "ch44").mkdir(parents=True)
    done = run(submitted)
    assert "dan/ch44: not compared: there is no notebook ch44.ipynb" in done.output
    assert done.exit_code == 4 and "cyd/ch44: not compared" in done.output and "=bob and ada" in done.output
    for arguments, said in (
        ([tmp_path / "nowhere"], "no such folder"),
        ([tmp_path], "no submissions in it"),
        ([submitted, "--assignment", "ch4"], "take one of"),
        ([submitted, "--out", Path("/dev/null/x.csv")], "--out"),
    ):
        wrong = run(*arguments)
        assert wrong.exit_code == 2 and said in wrong.output and len(wrong.output.splitlines()) == 1, wrong.output
