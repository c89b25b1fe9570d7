"""What a library's script uses: rows as lines of JSON, and code of a file that is run without importing it."""

import json
import subprocess
import sys

import pytest

from experiments.atlas import keeping

LIBRARY = """
import nothing_that_is_installed

LIMIT = 2

def double(x: Unknown) -> Unknown:
    return x * LIMIT

class Trainer:
    @nothing_that_is_installed.decorate
    def step(self, x):
        return x + self.rate

def loop():
    while True:
        loss = x * 3
        other = 1 / 0
"""


@pytest.fixture
def run(tmp_path):
    """What a script prints that has the helper and a library's file beside it."""
    (tmp_path / "sheet.py").write_bytes((keeping.FOLDER / "sheet.py").read_bytes())
    (tmp_path / "library.py").write_text(LIBRARY)

    def run(script):
        (tmp_path / "script.py").write_text(script)
        environment = {"ATLAS_GIVEN": '{"rewards": [1, 2]}'}
        return subprocess.run([sys.executable, "script.py"], cwd=tmp_path, env=environment, capture_output=True, text=True)

    return run


def test_rows_alone_are_on_standard_output(run):
    done = run(
        "import os\nfrom sheet import given, row\nprint('hello')\nos.system('echo from elsewhere')\n"
        "row('f', given.rewards, 'call', 'a.py', tolerance=0.1)\n"
    )
    entry = {"formula": "f", "setting": "", "numbers": [1.0, 2.0], "call": "call", "source": "a.py", "note": "", "tolerance": 0.1}
    assert [json.loads(line) for line in done.stdout.splitlines()] == [entry]
    assert done.stderr.split() == ["hello", "from", "elsewhere"]


def test_arrays_become_lists(run):
    done = run(
        "import array\nfrom sheet import row\nclass Tensor:\n    def detach(self):\n        return array.array('d', [1, 2])\n"
        "row('f', [Tensor(), (3, True)], 'call', 'a.py')\n"
    )
    assert json.loads(done.stdout)["numbers"] == [[1.0, 2.0], [3.0, 1.0]]


def test_a_function_or_method_is_built_without_its_module_and_decorators(run):
    done = run(
        "from types import SimpleNamespace\nfrom sheet import function, row\n"
        "row('f', function('library.py', 'double', {'LIMIT': 2})(4), 'double', 'library.py')\n"
        "row('g', function('library.py', 'step', {})(SimpleNamespace(rate=0.5), 1), 'step', 'library.py')\n"
    )
    assert [json.loads(line)["numbers"] for line in done.stdout.splitlines()] == [8.0, 1.5]


def test_statements_run_on_given_values_and_no_others_do(run):
    done = run(
        "from sheet import row, statements\n"
        "names = statements('library.py', lambda text: text.startswith('loss = '), {'x': 5})\n"
        "row('f', names['loss'], 'loop', 'library.py')\n"
    )
    assert json.loads(done.stdout)["numbers"] == 15.0


@pytest.mark.parametrize("call", ["function('library.py', 'gone', {})", "statements('library.py', lambda text: False, {})"])
def test_what_a_library_no_longer_has_is_named(run, call):
    done = run(f"from sheet import function, statements\n{call}\n")
    assert done.returncode and "LookupError: library.py has no" in done.stderr.splitlines()[-1]


def test_what_is_not_installed_is_named(run):
    done = run("from sheet import function\nfunction('a/site-packages/lib/gone.py', 'f', {})\n")
    assert done.stderr.splitlines()[-1] == "LookupError: lib/gone.py: this version has no such file"
    done = run("from sheet import installed\ninstalled('no_such_package', 'a.py')\n")
    assert done.stderr.splitlines()[-1] == "LookupError: no_such_package is not installed"
