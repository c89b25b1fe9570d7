"""What rests on what: each rule on a made-up project of a few lines, and the whole of it against what really runs."""

from __future__ import annotations

import ast
import os
import sys
from pathlib import Path

import pytest

from autograder import checks
from autograder.paths import ROOT
from autograder.proving import killmatrix
from autograder.proving.dependencies import Code, definition_of
from autograder.proving.kept import MATRIX

PROJECT = {
    "course_lib/__init__.py": "from course_lib.tools import helper\n",
    "course_lib/tools.py": """
        import math

        FACTOR = 2

        def helper(x):
            \"\"\"Doubles.\"\"\"
            return FACTOR * x

        def other(x):
            return math.sqrt(x)

        class Thing:
            size = FACTOR
        """,
    "course_lib/checks/views.py": "def rounded(a, b):\n    return b\n\ndef sorted_rows(a, b):\n    return b\n",
    "course_lib/seeding.py": "def generator(seed):\n    return seed\n\ndef unused():\n    return 0\n",
    "course_lib/registry.py": "KNOWN = []\n\ndef register(f):\n    KNOWN.append(f)\n    return f\n",
    "solutions/__init__.py": "",
    "solutions/ch44.py": "def gae(x):\n    return x\n\ndef returns(x):\n    return x\n",
    "autograder/__init__.py": "",
    "autograder/checks.py": """
        from course_lib.tools import helper
        from course_lib import seeding

        def used(x):
            return helper(x)

        EXERCISE = [used(x) for x in range(3)]
        """,
}


def write(folder, **files):
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = text.strip("\n").split("\n")
        margin = min((len(line) - len(line.lstrip()) for line in lines if line.strip()), default=0)
        path.write_text("\n".join(line[margin:] for line in lines) + "\n")


@pytest.fixture
def project(tmp_path):
    write(tmp_path, **PROJECT)
    return tmp_path


class Watched:
    """The fingerprint of a definition, before and after."""

    def __init__(self, folder: Path, definition: str = "autograder.checks:EXERCISE") -> None:
        self.folder, self.definition = folder, definition
        self.before = self.reached().fingerprint

    def reached(self):
        return Code(self.folder).reach([self.definition])

    def changes(self, name: str, old: str, new: str) -> bool:
        """Whether this edit changes the fingerprint."""
        path = self.folder / name
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new))
        return self.reached().fingerprint != self.before


def with_checks(folder, text):
    write(folder, **{"autograder/checks.py": text})
    return Watched(folder)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("return FACTOR * x", "return FACTOR * x  # twice"),
        ("return FACTOR * x", "return (FACTOR\n            * x)"),
        ('"""Doubles."""', '"""Gives twice of it."""'),
        ('    """Doubles."""\n', ""),
    ],
)
def test_comments_layout_and_docstrings_change_nothing(project, old, new):
    assert not Watched(project).changes("course_lib/tools.py", old, new)


def test_a_helper_that_is_used_changes_it(project):
    assert Watched(project).changes("course_lib/tools.py", "FACTOR * x", "FACTOR + x")


def test_a_constant_behind_the_helper_changes_it(project):
    assert Watched(project).changes("course_lib/tools.py", "FACTOR = 2", "FACTOR = 3")


def test_what_is_not_used_does_not(project):
    assert not Watched(project).changes("course_lib/tools.py", "math.sqrt(x)", "math.sqrt(-x)")
    assert not Watched(project).changes("course_lib/tools.py", "import math\n", "import math\nimport json\n")


def test_a_variable_of_a_comprehension_is_no_name_of_the_module(project):
    watched = with_checks(project, "A = [x for x in range(3)]\nB = lambda x: x\nEXERCISE = B")
    assert not watched.changes("autograder/checks.py", "range(3)", "range(4)")


@pytest.mark.parametrize(
    "text",
    [
        "from course_lib.tools import helper as h\nEXERCISE = h",
        "import course_lib.tools\nEXERCISE = course_lib.tools.helper",
        "import course_lib.tools as t\nEXERCISE = t.helper",
        "from course_lib import tools as t\nEXERCISE = t.helper",
        "from course_lib import helper\nEXERCISE = helper",  # which the package took from its module
        "def EXERCISE(x):\n    from course_lib.tools import helper as h\n    return h(x)",
        "try:\n    from course_lib.tools import helper\nexcept ImportError:\n    helper = None\nEXERCISE = helper",
        "from course_lib.tools import *\nEXERCISE = helper",
        "import course_lib.tools as t\nEXERCISE = getattr(t, 'hel' + 'per')",
        "from course_lib.tools import helper\n\ndef wrap(f):\n    return f\n\nEXERCISE = wrap(f=helper)",
        "from course_lib.tools import helper\nIGNORED = 1\nif IGNORED:\n    EXERCISE = helper\nelse:\n    EXERCISE = 0",
        "class EXERCISE:\n    from course_lib.tools import helper\n    size = helper(3)",
        "from course_lib import tools\n\n@tools.helper\ndef EXERCISE():\n    pass",
        "import importlib\nEXERCISE = importlib.import_module('course_lib.tools')",
        "import importlib\nNAME = 'tools'\nEXERCISE = importlib.import_module(f'course_lib.{NAME}')",
        "EXERCISE = built('tools.helper', x=3)",
        "MAKER = 'helper'\nEXERCISE = built(f'tools.{MAKER}')",
        "PLACE = 'tools' + '.helper'\nEXERCISE = built(PLACE)",
        "ENTRIES = ['tools.helper']\nEXERCISE = [built(entry) for entry in ENTRIES]",
    ],
)
def test_every_way_of_naming_a_function_leads_to_it(project, text):
    watched = with_checks(project, text)
    assert watched.changes("course_lib/tools.py", "FACTOR * x", "FACTOR + x")


@pytest.mark.parametrize(
    "text",
    [
        "import course_lib.tools as t\nEXERCISE = t.helper",
        "from course_lib import tools\nEXERCISE = tools.helper",
        "EXERCISE = built('tools.helper', x=3)",
    ],
)
def test_only_the_attributes_that_are_used_count(project, text):
    watched = with_checks(project, text)
    assert not watched.changes("course_lib/tools.py", "math.sqrt(x)", "math.sqrt(-x)")


def test_a_class_attribute_counts_with_what_it_is_made_of(project):
    watched = with_checks(project, "from course_lib.tools import Thing\nEXERCISE = Thing()")
    assert watched.changes("course_lib/tools.py", "FACTOR = 2", "FACTOR = 3")


def test_a_circle_ends_and_counts_whole(project):
    write(project, **{"course_lib/a.py": "from course_lib.b import g\n\ndef f(n):\n    return g(n)\n"})
    write(project, **{"course_lib/b.py": "import course_lib.a as a\n\ndef g(n):\n    return n and a.f(n - 1)\n"})
    watched = with_checks(project, "from course_lib.a import f\nEXERCISE = f")
    assert {"course_lib.a.f", "course_lib.b.g"} <= watched.reached().definitions
    assert watched.changes("course_lib/b.py", "n - 1", "n - 2")


def test_a_statement_that_acts_counts_if_its_module_is_imported(project):
    text = "from course_lib import tools\nfrom course_lib.registry import KNOWN\nEXERCISE = KNOWN"
    write(project, **{"course_lib/tools.py": PROJECT["course_lib/tools.py"] + "\n        print(other(4))\n"})
    assert with_checks(project, text).changes("course_lib/tools.py", "math.sqrt(x)", "math.sqrt(-x)")


def test_a_decorator_of_the_project_acts(project):
    write(
        project, **{"course_lib/more.py": "from course_lib.registry import register\n\n@register\ndef entry():\n    return 1\n"}
    )
    watched = with_checks(project, "import course_lib.more\nfrom course_lib.registry import KNOWN\nEXERCISE = KNOWN")
    assert watched.changes("course_lib/more.py", "return 1", "return 2")


def test_a_decorator_of_others_does_not(project):
    write(project, **{"course_lib/more.py": "import functools\n\n@functools.cache\ndef entry():\n    return 1\n"})
    watched = with_checks(project, "import course_lib.more\nfrom course_lib.registry import KNOWN\nEXERCISE = KNOWN")
    assert not watched.changes("course_lib/more.py", "return 1", "return 2")


def test_what_runs_in_scripts_only_does_not_count(project):
    watched = with_checks(project, "EXERCISE = 1\n\nif __name__ == '__main__':\n    print(1)")
    assert not watched.changes("autograder/checks.py", "print(1)", "print(2)")


def test_what_a_page_runs_as_a_script_counts(project):
    cells = ["from course_lib.tools import helper\nif __name__ == '__main__':\n    print(helper(1))"]
    assert "course_lib.tools.helper" in Code(project).reach([], cells).definitions


def test_an_edit_after_reading_is_noticed(project):
    code = Code(project)
    code.reach(["autograder.checks:EXERCISE"])
    assert code.is_current()
    os.utime(project / "course_lib/checks/views.py", (1, 1))  # which was not read
    assert code.is_current()
    os.utime(project / "course_lib/tools.py", (1, 1))
    assert not code.is_current()


@pytest.mark.parametrize(
    "statement", ["KNOWN['a'] = helper", "(KNOWN['a'], b) = helper, 1", "KNOWN.a = helper", "KNOWN += [helper]"]
)
def test_an_assignment_into_something_acts(project, statement):
    write(project, **{"course_lib/more.py": f"from course_lib.tools import helper\nKNOWN = object()\n{statement}\n"})
    watched = with_checks(project, "import course_lib.more\nEXERCISE = 1")
    assert watched.changes("course_lib/tools.py", "FACTOR * x", "FACTOR + x")


def test_a_view_that_a_string_names_counts_and_the_others_do_not(project):
    watched = with_checks(project, "EXERCISE = dict(view='rounded')")
    assert not watched.changes("course_lib/checks/views.py", "def sorted_rows(a, b):", "def sorted_rows(a, c):")
    assert watched.changes("course_lib/checks/views.py", "def rounded(a, b):", "def rounded(a, c):")


def test_a_function_of_an_earlier_chapter_counts(project):
    watched = with_checks(project, "EXERCISE = earlier('gae', chapter=44)")
    assert watched.reached().definitions >= {"solutions.ch44.gae"}
    assert not watched.changes("solutions/ch44.py", "def returns(x):\n    return x", "def returns(x):\n    return -x")
    assert watched.changes("solutions/ch44.py", "def gae(x):\n    return x", "def gae(x):\n    return -x")


@pytest.mark.parametrize("call", ["earlier(name, 44)", "earlier(name, chapter)"])
def test_of_an_earlier_function_that_is_not_clear_all_count(project, call):
    watched = with_checks(project, f"name, chapter = 'g' + 'ae', 44\nEXERCISE = {call}")
    assert watched.changes("solutions/ch44.py", "def gae(x):\n    return x", "def gae(x):\n    return -x")


def test_whoever_takes_all_names_rests_on_the_whole_module(project):
    watched = with_checks(project, "hidden = 1\n\ndef EXERCISE():\n    return globals()['hid' + 'den']")
    assert watched.changes("autograder/checks.py", "hidden = 1", "hidden = 2")


def test_where_source_is_read_the_text_counts(project):
    text = "import inspect\nfrom course_lib.tools import helper\nEXERCISE = inspect.getsource(helper)"
    assert with_checks(project, text).changes("course_lib/tools.py", "FACTOR * x", "FACTOR * x  # twice")


def test_cells_count_with_what_they_import_and_magics_are_no_obstacle(project):
    def fingerprint(*cells):
        return Code(project).reach([], cells).fingerprint

    cells = "%matplotlib inline\nfrom course_lib import tools", "print(tools.helper(3))"
    before = fingerprint(*cells)
    assert fingerprint(cells[0], "print(tools.helper(4))") != before
    path = project / "course_lib/tools.py"
    path.write_text(path.read_text().replace("math.sqrt(x)", "math.sqrt(-x)"))
    assert fingerprint(*cells) == before
    path.write_text(path.read_text().replace("FACTOR * x", "FACTOR + x"))
    assert fingerprint(*cells) != before


def test_a_page_that_is_not_python_rests_on_everything(project):
    reached = Code(project).reach([], ["this is (not Python"])
    assert {"course_lib.tools.other", "solutions.ch44.returns"} <= reached.definitions


def test_other_packages_and_data_files_are_named(project):
    watched = with_checks(project, "import numpy.linalg as l\nFILE = 'data/' + 'ratings.parquet'\nEXERCISE = l.norm, FILE")
    reached = watched.reached()
    assert "numpy" in reached.packages
    assert reached.mentions(Path("data/other.csv")) and reached.mentions(Path("ratings.parquet"))
    assert not reached.mentions(Path("models/tiny.json"))


def test_a_definition_that_is_not_there_is_refused(project):
    with pytest.raises(LookupError, match=r"autograder\.checks:NONE"):
        Code(project).reach(["autograder.checks:NONE"])


def test_an_exercise_is_found_by_its_name_or_else_the_module_counts():
    source = "A = Exercise(name='one', x=1)\nB = spec.Exercise('two')\nC = Exercise('twice')\nD = Exercise('twice')\n"
    assert definition_of("m", source, "Exercise", "one") == "m:A" and definition_of("m", source, "Exercise", "two") == "m:B"
    assert definition_of("m", source, "Exercise", "twice") == "m" and definition_of("m", source, "Artefact", "one") == "m"


CHEAP = (
    ("ch44", "td_residuals"),
    ("ch45", "minibatches"),
    ("ch51", "imagine"),
    ("ch74", "split_by_episode"),
    ("ch80", "simulate_preferences"),
)


@pytest.mark.parametrize(("assignment", "name"), CHEAP, ids=[name for _, name in CHEAP])
def test_all_that_runs_when_an_exercise_is_proved_is_reached(assignment, name):
    code, module = Code(ROOT), f"autograder.checks.{assignment}"
    reached = code.reach([*MATRIX, definition_of(module, code.module(module).source, "Exercise", name)])
    exercise = next(one for one in checks.functions(assignment) if one.name == name)
    ran = set()

    def watch(frame, event, _argument):
        importing = "<module>" in (frame.f_code.co_name, frame.f_back and frame.f_back.f_code.co_name)
        if event == "call" and not importing:
            ran.add((frame.f_code.co_filename, frame.f_code.co_firstlineno))

    sys.setprofile(watch)
    try:
        killmatrix.exercise_rows(exercise, [50])
    finally:
        sys.setprofile(None)
    places = {place for place in (top_level(Path(file), line) for file, line in ran) if place}
    assert len(places) > 20
    assert places - reached.definitions == set()


def top_level(file: Path, line: int) -> str | None:
    """The top-level definition of one of the project's modules in which a line lies."""
    if not file.is_relative_to(ROOT) or file.relative_to(ROOT).parts[0] not in ("course_lib", "solutions", "autograder"):
        return None
    module = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        first = min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", []))])
        if first <= line <= int(node.end_lineno or 0):
            name = getattr(node, "name", None) or next(part.id for part in ast.walk(node) if isinstance(part, ast.Name))
            return f"{module}.{name}"
    return None
