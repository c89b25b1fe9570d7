"""The runner, on a harmless package of its own: what it records, and one line for whatever goes wrong. No network."""

import json
import zipfile

import pytest

from experiments.atlas import given, keeping, runner

ROWS = """
from fakelib import loss
from sheet import given, row

print("what the library itself says is no row")
row("value_loss", loss(given.new_values, given.returns), "loss", "fakelib.py", "plain")
row("approx_kl", 0.123, "kl", "fakelib.py", note="Of its own.")
"""


def wheel(folder, version, code):
    name = f"fakelib-{version}"
    with zipfile.ZipFile(folder / f"{name}-py3-none-any.whl", "w") as file:
        file.writestr("fakelib.py", code)
        file.writestr(f"{name}.dist-info/METADATA", f"Metadata-Version: 2.1\nName: fakelib\nVersion: {version}\n")
        file.writestr(
            f"{name}.dist-info/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        file.writestr(f"{name}.dist-info/RECORD", "")


def header(pins, **own):
    lines = [
        f"dependencies = {json.dumps(pins)}",
        "[tool.atlas]",
        *(f"{name} = {json.dumps(value)}" for name, value in own.items()),
    ]
    return "\n".join(["# /// script", *(f"# {line}" for line in lines), "# ///", ""])


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """Two versions of a package, of which the newer one halves its loss, and a place for scripts, records and environments."""
    folder = tmp_path_factory.mktemp("atlas")
    for part in ("wheels", "scripts", "records", "environments"):
        (folder / part).mkdir()
    mean = "def loss(a, b):\n    return sum((x - y) ** 2 for x, y in zip(a, b)) / len(a)"
    wheel(folder / "wheels", "1.0", mean)
    wheel(folder / "wheels", "2.0", f"{mean} / 2")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PIP_NO_INDEX", "1")
        patch.setenv("PIP_FIND_LINKS", str(folder / "wheels"))
        patch.setenv("PIP_CONFIG_FILE", "/dev/null")
        yield folder


def run(workshop, script, name="fakelib", **settings):
    (workshop / "scripts" / f"{name}.py").write_text(script)
    return runner.run(
        name, environments=workshop / "environments", scripts=workshop / "scripts", records=workshop / "records", **settings
    )


def test_a_library_is_installed_run_compared_and_recorded(workshop):
    outcome = run(workshop, header(["fakelib==1.0"], libraries=["fakelib"], why="To be seen.") + ROWS)
    assert outcome.error == ""
    record = keeping.load("fakelib", workshop / "records")
    assert record == outcome.record and record["versions"] == {"fakelib": "1.0"} and record["why"] == "To be seen."
    assert record["installed"]["fakelib"] == "1.0" and record["pins"] == ["fakelib==1.0"]
    equal, other = record["rows"]
    assert (
        equal["equal"] and equal["numbers"] == pytest.approx(given.formulas()["value_loss"].ours) and equal["setting"] == "plain"
    )
    assert not other["equal"] and other["note"] == "Of its own." and outcome.unexplained == ["approx_kl"]
    assert runner.told(outcome) == ["fakelib 1.0: 1 of 2 rows equal the course's", "  by no known rule: approx_kl"]


def test_a_newer_version_is_told_and_not_recorded(workshop):
    before = keeping.path("fakelib", workshop / "records").read_bytes()
    outcome = run(workshop, header(["fakelib==1.0"], libraries=["fakelib"]) + ROWS, newer=True)
    assert outcome.changes == ["value_loss (plain): was equal, is half"]
    assert runner.told(outcome)[:2] == ["fakelib 1.0 → 2.0: 0 of 2 rows equal the course's", f"  {outcome.changes[0]}"]
    assert keeping.path("fakelib", workshop / "records").read_bytes() == before


def test_the_same_again_is_as_recorded(workshop):
    outcome = run(workshop, header(["fakelib==1.0"], libraries=["fakelib"]) + ROWS)
    assert outcome.changes == [] and runner.told(outcome)[0] == "fakelib 1.0: 1 of 2 rows equal the course's, as recorded"


PINNED = {"pins": ["fakelib==1.0"], "libraries": ["fakelib"]}
WRONG = {  # what is wrong with a script, the script, and what its line says
    "a version that there is not": (header(["fakelib==7.0"], libraries=["fakelib"]) + ROWS, "can't be installed"),
    "an error": (header(**PINNED) + "raise ValueError('of its own')", "the script fails: ValueError: of its own"),
    "too slow": (header(**PINNED, seconds=1) + "import time; time.sleep(600)", "took more than 1 seconds"),
    "no row": (header(**PINNED) + "import sheet; print('nothing')", "the script printed no row"),
    "words": (header(**PINNED) + "print('nothing')", "something else than rows"),
    "an unknown formula": (header(**PINNED) + "from sheet import row; row('gain', 1, 'f', 'f.py')", "gain"),
    "two rows on the same": (header(**PINNED) + ROWS + "row('approx_kl', 1, 'f', 'f.py')", "two rows are on the same: approx_kl"),
    "no header": (ROWS, "the script has no header"),
    "a header that is no TOML": ("# /// script\n# dependencies = [\n# ///\n", "header can't be read"),
    "a pin without a version": (header(["fakelib"], libraries=["fakelib"]), "not pinned: fakelib"),
    "no library": (header(["fakelib==1.0"]), "must say in libraries"),
    "another library": (header(["fakelib==1.0"], libraries=["other"]), "other is not among them"),
    "a misspelt setting": (header(**PINNED, second=1), "unknown in [tool.atlas]: second"),
}


@pytest.mark.parametrize("what", WRONG)
def test_whatever_is_wrong_gets_one_line_and_leaves_the_record_alone(workshop, what):
    script, said = WRONG[what]
    keeping.save("wrong", {"pins": [], "bare": [], "versions": {}, "installed": {}, "rows": []}, workshop / "records")
    before = keeping.path("wrong", workshop / "records").read_bytes()
    outcome = run(workshop, script, "wrong")
    [line] = runner.told(outcome)
    assert line.startswith("wrong: ") and said in line and "\n" not in line and outcome.record is None
    assert keeping.path("wrong", workshop / "records").read_bytes() == before


def test_an_install_that_fills_the_disk_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "INSTALL_BYTES", 10)
    (tmp_path / "large").write_bytes(bytes(1000))
    with pytest.raises(runner.AtlasError, match="of disk"):
        runner._install(["sleep", "600"], tmp_path)


def test_an_unknown_library_says_which_there_are(workshop):
    with pytest.raises(runner.AtlasError, match="there are: fakelib"):
        runner.script("nonsense", workshop / "scripts")


@pytest.mark.parametrize(
    ("pin", "name", "loose"),
    [
        ("stable-baselines3==2.9.2", "stable-baselines3", "stable-baselines3"),
        ("ray[rllib]==2.60.0", "ray", "ray[rllib]"),
        ("Rsl_RL.lib==5", "rsl-rl-lib", "Rsl_RL.lib"),
        ("torch==2.13.0", "torch", "torch==2.13.0"),
    ],
)
def test_pins_are_read_and_relaxed_but_that_of_torch(pin, name, loose):
    assert runner.package(pin) == name and runner.relaxed([pin]) == [loose]


def test_the_record_is_made_again_with_what_it_was_made_with(tmp_path):
    former = {"installed": {"torch": "2.13.0+cpu", "numpy": "2.4.6", "pip": "23.2"}}
    assert runner._constraints(former, tmp_path).read_text() == "torch==2.13.0\nnumpy==2.4.6\n"


def test_of_what_a_command_said_the_error_counts():
    assert runner.last_words("WARNING: a\nERROR: no such version\n[notice] a new pip\n") == "no such version"
    assert runner.last_words("Traceback\nValueError: x\n\n") == "ValueError: x"
    assert runner.last_words("") == "without a word"
