"""Cells run without a kernel: failures are kept, live and check cells are left alone."""

import json

import pytest

from course_lib.checks.notebook import NotebookError, code_cells, new_namespace, run_cell, run_cells


def cell(source, **metadata):
    return {"source": source, "metadata": metadata}


@pytest.fixture(autouse=True)
def _main_module(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])


def test_cells_share_a_namespace_and_a_failure_stops_only_its_cell():
    namespace = new_namespace()
    failures = run_cells([cell("a = 1"), cell("b = 1 / 0"), cell("c = a + 1"), cell("d = (")], namespace)
    assert namespace["c"] == 2 and "b" not in namespace
    assert {position: type(error).__name__ for position, error in failures.items()} == {1: "ZeroDivisionError", 3: "SyntaxError"}


def test_live_and_check_cells_do_not_run():
    namespace = new_namespace()
    check_cell = cell("ran = 'check'", nbgrader={"grade": True, "solution": False})
    assert run_cells([cell("ran = 'live'", tags=["live"]), check_cell], namespace) == {}
    assert "ran" not in namespace


def test_a_percent_sign_in_code_is_no_magic():
    namespace = new_namespace()
    run_cell('text = """\n%d\n"""\na = 7 \\\n% 4', namespace)
    assert namespace["a"] == 3 and "%d" in namespace["text"]


def test_display_and_get_ipython_exist():
    run_cell("display(1)\nget_ipython()", new_namespace())


def test_classes_and_pickles_find_their_main_module():
    namespace = new_namespace()
    run_cell("import dataclasses\n@dataclasses.dataclass\nclass A:\n    x: int = 1\nvalue = A().x", namespace)
    assert namespace["value"] == 1


@pytest.mark.parametrize(
    "content", ["", "{}", "[1]", '{"cells": [1]}', '{"cells": 3}', "[" * 100_000, '{"cells": [{"cell_type": "code"}]}']
)
def test_what_is_no_notebook_is_refused(tmp_path, content):
    path = tmp_path / "x.ipynb"
    path.write_text(content)
    with pytest.raises(NotebookError, match="not a Jupyter notebook"):
        code_cells(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(NotebookError, match="No such file"):
        code_cells(tmp_path / "none.ipynb")


def test_sources_may_be_lists_and_files_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "x.ipynb"
    path.write_text(
        "\ufeff" + json.dumps({"cells": [{"cell_type": "code", "source": ["a = 1\n", "b = 2"], "metadata": {}}]}),
        encoding="utf-8",
    )
    assert code_cells(path)[0]["source"] == "a = 1\nb = 2"
