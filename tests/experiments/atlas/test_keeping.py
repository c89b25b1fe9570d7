"""The committed records of the atlas: of scripts that exist, with the pins that these have, and judged as the code judges now."""

import pytest

from experiments.atlas import comparing, given, keeping, runner

RECORDS = keeping.load_all()


def test_a_record_is_read_as_it_was_written_a_line_for_each_row(tmp_path):
    record = {"library": "a", "pins": ["a==1"], "rows": [{"formula": "x", "sentence": "größer"}, {"formula": "y"}]}
    path = keeping.save("a", record, tmp_path)
    assert keeping.load("a", tmp_path) == record and keeping.load_all(tmp_path) == {"a": record}
    assert len(path.read_text(encoding="utf-8").splitlines()) == 2 + 3 + 3
    assert keeping.load("b", tmp_path) is None and [one.name for one in tmp_path.iterdir()] == ["a.json"]


def test_there_are_enough_libraries_and_rows():
    assert len({one for record in RECORDS.values() for one in record["versions"]}) >= 25
    assert sum(len(record["rows"]) for record in RECORDS.values()) >= 120
    assert sum(path.stat().st_size for path in keeping.RECORDS.iterdir()) < 1e6


def test_every_script_has_a_record_and_every_record_a_script():
    assert sorted(RECORDS) == sorted(runner.names())


@pytest.mark.parametrize("name", sorted(RECORDS))
def test_a_record_has_its_scripts_pins_and_the_versions_that_they_name(name):
    record, script = RECORDS[name], runner.script(name)
    assert (record["pins"], record["bare"], record["why"]) == ([*script.dependencies], [*script.bare], script.why)
    for pin in record["pins"] + record["bare"]:
        assert record["installed"][runner.package(pin)].partition("+")[0] == pin.partition("==")[2], pin
    assert record["versions"] == {one: record["installed"][runner.package(one)] for one in script.libraries}


@pytest.mark.parametrize("name", sorted(RECORDS))
def test_a_record_is_judged_as_it_would_be_now_and_no_row_is_without_a_rule(name):
    formulas = given.formulas()
    rows = RECORDS[name]["rows"]
    assert rows and comparing.unexplained(rows) == []
    for row in rows:
        now = comparing.judged(row, formulas)
        assert comparing.same(row["ours"], now["ours"]), row["formula"]
        assert now | {"ours": row["ours"]} == row
        assert row["call"] and row["source"]
        made = [formulas[row["formula"]].ours, *(rule.numbers for rule in formulas[row["formula"]].rules)]
        assert sum(comparing.same(row["numbers"], numbers, row["tolerance"]) for numbers in made) == 1
