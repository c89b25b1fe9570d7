"""Due dates: what is late, by how much and at what cost, whatever clocks do; and slips that are told in one line."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import pytest

from autograder.grading import deadlines
from autograder.grading.deadlines import DeadlineError, Deadlines

RULES = """\
zone: {zone}
grace_minutes: 10
penalty: {{per_day: 0.1, at_most: 0.35, nothing_after_days: 7}}
assignments:
  ch44:
    due: {due}
    extensions: {{jane: 2026-12-01 00:00, "Zoë": 2026-12-02T00:00:00+01:00}}
  ch45:
    due: {due}
    grace_minutes: 0
    penalty: {{}}
"""


@pytest.fixture
def rules(tmp_path):
    def made(due="2026-11-20 12:00", zone="Europe/London", text=RULES, known=()):
        path = tmp_path / "due.yml"
        path.write_text(text.format(due=due, zone=zone))
        return deadlines.load(path, known)

    return made


def utc(text):
    return datetime.fromisoformat(text).replace(tzinfo=UTC)


@pytest.mark.parametrize(
    ("at", "seconds", "share"),
    [
        ("2026-11-20 11:59:59", 0, 0.0),
        ("2026-11-20 12:00:00", 0, 0.0),
        ("2026-11-20 12:00:01", 1, 0.0),
        ("2026-11-20 12:10:00", 600, 0.0),
        ("2026-11-20 12:10:01", 601, 0.1),
        ("2026-11-21 12:00:00", 86_400, 0.1),
        ("2026-11-21 12:00:01", 86_401, 0.2),
        ("2026-11-24 09:00:00", 334_800, 0.35),
        ("2026-11-27 12:00:00", 604_800, 0.35),
        ("2026-11-27 12:00:01", 604_801, 1.0),
    ],
)
def test_late_work(rules, at, seconds, share):
    rule = rules().rules["ch44"]
    assert rule.late("bob", utc(at)) == (seconds, share)
    assert rule.late("jane", utc(at)) == (0, 0.0)
    assert rules().rules["ch45"].late("bob", utc(at))[1] == 0.0


def test_extensions_have_zones_of_their_own(rules):
    rule = rules().rules["ch44"]
    assert rule.extension("jane") == timedelta(days=10, hours=12) and rule.extension("bob") is None
    assert rule.late("Zoë", utc("2026-12-01 23:00:00")) == (0, 0.0) and rule.late("Zoë", utc("2026-12-01 23:00:01"))[0] == 1


@pytest.mark.parametrize(
    ("due", "zone", "day_later", "second_day_later"),
    [
        ("2026-10-24 18:00", "Europe/London", "2026-10-25 18:00", "2026-10-26 18:00"),  # 25 hours: clocks go back
        ("2026-03-28 18:00", "Europe/London", "2026-03-29 17:00", "2026-03-30 17:00"),  # 23 hours
        ("2026-03-07 23:59", "America/New_York", "2026-03-09 03:59", "2026-03-10 03:59"),
        ("2026-04-04 23:59", "Australia/Lord_Howe", "2026-04-05 13:29", "2026-04-06 13:29"),  # 24.5 hours
        ("2026-11-20 23:59", "UTC", "2026-11-21 23:59", "2026-11-22 23:59"),
    ],
)
def test_the_night_in_which_clocks_change_is_one_day(rules, due, zone, day_later, second_day_later):
    rule = rules(due, zone).rules["ch44"]
    second = timedelta(seconds=1)
    assert rule.late("bob", utc(day_later))[1] == 0.1 and rule.late("bob", utc(day_later) + second)[1] == 0.2
    assert rule.late("bob", utc(second_day_later))[1] == 0.2


def test_the_zone_of_the_due_date_is_that_of_the_file_or_its_own(rules):
    assert rules("2026-07-01 12:00").rules["ch44"].late("bob", utc("2026-07-01 11:00:01"))[0] == 1  # summer time
    assert rules("2026-07-01 12:00:00-04:00").rules["ch44"].late("bob", utc("2026-07-01 16:00:01"))[0] == 1
    tokyo = datetime(2026, 11, 20, 21, 30, tzinfo=timezone(timedelta(hours=9)))
    assert rules().rules["ch44"].late("bob", tokyo)[0] == 1800


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("zone: Europe/Londres", "zone: Europe/Londres is no time zone; take a name as in Europe/London"),
        ("zone: ../etc/passwd", "zone: ../etc/passwd is no time zone"),
        ("due: 2026-11-20 12:00", "due: is no key here; take one of assignments, grace_minutes, penalty, zone"),
        ("assignments: {ch44: {due: 2026-11-20 12:00}}", "assignments.ch44.due: has no time zone; add `zone: Europe/London`"),
        ("zone: UTC\nassignments: {ch44: {due: 2026-11-20}}", "assignments.ch44.due: has no time of day; write it as in"),
        ("zone: UTC\nassignments: {ch44: {due: 20.11.2026 12:00}}", "assignments.ch44.due: '20.11.2026 12:00' is no time"),
        ("zone: UTC\nassignments: {ch44: {due: 2026-02-30 12:00}}", "is no time (day is out of range for month)"),
        ("zone: UTC\nassignments: {ch44: {due: 2026-11-20 24:00}}", "is no time (hour must be in 0..23"),
        ("zone: Europe/London\nassignments: {ch44: {due: 2026-03-29 01:30}}", "does not exist in Europe/London"),
        ("zone: Europe/London\nassignments: {ch44: {due: 2026-10-25 01:30}}", "comes twice in Europe/London"),
        ("zone: UTC\nassignments: {ch44: {}}", "assignments.ch44: has no due date; add `due: 2026-11-20 23:59`"),
        ("zone: UTC\nassignments: {ch44: 2026-11-20 12:00}", "assignments.ch44: is no table"),
        (
            "zone: UTC\nassignments: {ch4: {due: 2026-11-20 12:00}}",
            "assignments.ch4: is no assignment of the course; take one of ch44",
        ),
        ("zone: UTC\nassignments: {ch44: {due: 2026-11-20 12:00, extension: {}}}", "assignments.ch44.extension: is no key here"),
        (
            "zone: UTC\nassignments: {ch44: {due: 2026-11-20 12:00, extensions: {jane: 2026-11-19 12:00}}}",
            "assignments.ch44.extensions.jane: is before the due date",
        ),
        ("penalty: {per_day: 10}", "penalty.per_day: '10' is no number from 0 to 1"),
        ("penalty: {per_day: nan}", "penalty.per_day: 'nan' is no number"),
        ("penalty: {perday: 0.1}", "penalty.perday: is no key here; take one of at_most, nothing_after_days, per_day"),
        ("penalty: {nothing_after_days: 1.5}", "penalty.nothing_after_days: is no whole number of days"),
        ("penalty: 0.1", "penalty: is no table"),
        ("grace_minutes: [1]", "grace_minutes: ['1'] is no number"),
        ("zone: UTC\nzone: UTC", "due.yml, line 2: the key zone is given twice"),
        ("zone: [UTC", "due.yml, line 1: "),
        ("- zone", "the file: is no table"),
        ("", "the file: is no table"),
    ],
)
def test_slips_are_one_line_with_file_key_and_cure(rules, text, said):
    with pytest.raises(DeadlineError) as error:
        rules(text=text.replace("{", "{{").replace("}", "}}"), known=("ch44",))
    message = str(error.value)
    assert said in message and "due.yml" in message and ";" in message and "\n" not in message


def test_a_file_that_is_no_text_or_is_not_there(tmp_path):
    (tmp_path / "due.yml").write_bytes(b"\xff\xfe")
    for name, said in (("due.yml", "UTF-8"), ("other.yml", "No such file"), ("", "Is a directory")):
        with pytest.raises(DeadlineError, match=said):
            deadlines.load(tmp_path / name)


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("2026-11-20 23:59:59.000000 UTC", "2026-11-20 23:59:59"),
        ("2026-11-20 23:59:59\n", "2026-11-20 23:59:59"),
        ("2026-11-20 23:59:59.5 +0100", "2026-11-20 22:59:59.500000"),
        ("2026-11-20T23:59:59.123456789Z", "2026-11-20 23:59:59.123456"),
        ("2015-02-02 15:58:23.948203 America/Los_Angeles", "2015-02-02 23:58:23.948203"),
    ],
)
def test_what_nbgrader_writes_into_timestamp_txt(tmp_path, text, moment):
    (tmp_path / "timestamp.txt").write_text(text)
    assert deadlines.handed_in(tmp_path, "bob", "ch44", Deadlines()).at == utc(moment)


@pytest.mark.parametrize("text", ["", "tomorrow", "2026-11-20 23:59:59 Nowhere/Land", "2026-13-20 23:59:59", "x" * 2000])
def test_a_timestamp_that_says_no_time_is_an_error(tmp_path, text):
    (tmp_path / "timestamp.txt").write_text(text)
    with pytest.raises(ValueError, match=r"timestamp\.txt"):
        deadlines.handed_in(tmp_path, "bob", "ch44", Deadlines())


def test_a_timestamp_that_is_a_link_is_not_read(tmp_path):
    (tmp_path / "elsewhere").write_text("2026-11-20 23:59:59")
    (tmp_path / "timestamp.txt").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="is a link"):
        deadlines.handed_in(tmp_path, "bob", "ch44", Deadlines())
