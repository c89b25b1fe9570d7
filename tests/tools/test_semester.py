"""A semester of three students and two chapters, as tools/semester.py simulates three hundred and ten: every step but formgrader's browser,
by the real commands, in this process. It is stopped once, and goes on where it was."""

import importlib
import json

import pytest
from typer.testing import CliRunner

from autograder import checks, cli
from autograder.grading import judge
from tools import semester
from tools.semester import Semester

CHAPTERS = ["ch44", "ch74"]
SEED = 830  # an attack, a browser's name, and a notebook without its marks, which waits for a person; mistakes that lenient checks pay


class Here(Semester):
    """The commands in this process, where torch and nbgrader are loaded once."""

    def __init__(self, *given, stop=0):
        super().__init__(*given)
        self.stop, self.done = stop, []

    def course(self, *words, spoilt="", may=(0,)):
        modules = {name: importlib.import_module(f"autograder.checks.{name}") for name in checks.assignments()}
        before = {name: module.EXERCISES for name, module in modules.items()}
        judge._released.cache_clear()
        try:
            semester.spoil(spoilt)
            done = CliRunner().invoke(cli.app, [str(word) for word in words])
        finally:
            for name, module in modules.items():
                module.EXERCISES = before[name]
            judge._released.cache_clear()
        assert done.exit_code in may, done.output
        self.done.append(words[0])
        if len(self.done) == self.stop:
            raise KeyboardInterrupt
        return done.output


def test_a_small_semester_is_stopped_goes_on_and_every_score_is_as_drawn(tmp_path):
    given = (tmp_path / "semester", 3, CHAPTERS, 1, SEED)
    begun = Here(*given, stop=5)
    with pytest.raises(KeyboardInterrupt):
        begun.live_through(browser=False)
    assert begun.done == ["collect", "grade", "collect", "grade", "grade"]
    resumed = Here(*given)
    resumed.live_through(browser=False)
    assert resumed.done == ["grade", "accept", "return"]

    record = resumed.record()
    assert (record["students"], record["chapters"], record["submissions"], record["hostile"]) == (3, CHAPTERS, 6, 1)
    assert (record["broken"], record["accepted"]) == (2, 1) and record["by_hand"] > 0
    assert record["regraded"] == 3 and record["disk_mb"]["grades"] > 0
    kinds = {"hand in", "collect", "grade", "by hand", "regrade", "accept", "return and export"}
    assert set(record["steps"]) == kinds and record["steps"]["grade"]["peak_mb"] > 100
    assert begun.spoilt in {one.name for one in checks.functions("ch44")}
    with pytest.raises(SystemExit, match="begun with other students"):
        Here(tmp_path / "semester", 4, CHAPTERS, 1, SEED)
    for name in CHAPTERS:
        path = next((tmp_path / "semester" / "grades" / "verdicts").glob(f"*/{name}.json"))
        verdict = json.loads(path.read_text())
        path.write_text(json.dumps(verdict | {"score": verdict["score"] + 1}))
        with pytest.raises(AssertionError, match="1 are not as drawn"):
            resumed.as_drawn(name)


def test_the_teachers_page_says_what_the_record_says(tmp_path, monkeypatch):
    record = json.loads(semester.RECORD.read_text())
    assert semester.sentences(record) in semester.PAGE.read_text(encoding="utf-8")
    for name in ("RECORD", "PAGE"):
        copy = tmp_path / name
        copy.write_bytes(getattr(semester, name).read_bytes())
        monkeypatch.setattr(semester, name, copy)
    semester.publish(record | {"students": 7})
    assert "simulates a semester: 7 students and 10 chapters" in semester.PAGE.read_text(encoding="utf-8")
