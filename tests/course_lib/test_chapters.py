"""A chapter takes functions over from the learner's own earlier notebook, and only such as pass their check."""

import nbformat
import pytest
import torch
from nbformat.v4 import new_code_cell, new_notebook

from autograder import checks
from autograder.authoring import freeze
from course_lib import chapters, earlier
from course_lib.checks import client

RIGHT = "import torch\n\ndef importance_ratio(log_probs, old_log_probs):\n    {guard}return (log_probs - old_log_probs).exp()"
GUARD = "if log_probs.shape != old_log_probs.shape: raise ValueError('log_probs and old_log_probs differ')\n    "
ARGUMENTS = torch.zeros(3), torch.zeros(3)


@pytest.fixture(autouse=True)
def folders(tmp_path, monkeypatch):
    freeze.write([checks.exercises("ch43")[0]], tmp_path / "frozen")
    monkeypatch.setattr(client, "FROZEN", tmp_path / "frozen")
    monkeypatch.delenv(chapters.REFERENCES, raising=False)
    for name in ("ch43", "ch45"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "ch45")
    caches = chapters._function.cache_clear, client.visible_cases.cache_clear
    for clear in caches:
        clear()
    yield tmp_path
    for clear in caches:
        clear()


def write(folder, *sources):
    nbformat.write(new_notebook(cells=[new_code_cell(source) for source in sources]), folder / "ch43" / "ch43.ipynb")


def test_the_learners_own_function_is_found_and_checked(folders):
    write(folders, RIGHT.format(guard=GUARD))
    function = earlier("importance_ratio", chapter=43)
    assert function.__name__ == "importance_ratio" and function(*ARGUMENTS).tolist() == [1, 1, 1]


def test_a_missing_notebook_is_named_at_the_first_call_only(folders):
    function = earlier("importance_ratio", chapter=43)
    with pytest.raises(LookupError, match=r"put it where \.\./ch43/ch43\.ipynb leads"):
        function(*ARGUMENTS)


def test_a_function_that_does_not_pass_is_not_taken(folders):
    write(folders, RIGHT.format(guard=""))
    with pytest.raises(LookupError, match="does not pass its check yet"):
        earlier("importance_ratio", chapter=43)(*ARGUMENTS)


def test_a_notebook_without_the_function_says_what_stopped(folders):
    write(folders, "import no_such_module")
    with pytest.raises(LookupError, match=r"defines no function importance_ratio .*code cell 1 stops: ModuleNotFoundError"):
        earlier("importance_ratio", chapter=43)(*ARGUMENTS)


def test_the_books_pages_take_the_reference(monkeypatch):
    monkeypatch.setenv(chapters.REFERENCES, "solutions")
    assert earlier("importance_ratio", chapter=43)(*ARGUMENTS).tolist() == [1, 1, 1]
