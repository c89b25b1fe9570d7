"""The appendix on other libraries: counts, rules and numbers come from the records, and nothing in them can break a table."""

import csv
import io
import json

import pytest

from autograder.publishing import atlas_page
from experiments.atlas import comparing, keeping
from experiments.atlas.given import Formula, Rule, formulas

LOSS = Formula("value_loss", "Value loss", 45, 4.0, (Rule("half", "Half of it.", 2.0),))
GAE = Formula(
    "gae", "Advantages", 44, [[float(n) for n in range(8)]] * 2, (Rule("end", "It counts as an end.", [[0.0] * 8] * 2),)
)
DESCRIBED = {**formulas(), "value_loss": LOSS, "gae": GAE}


def record(name, *rows, version="1.0", library=None):
    judged = [comparing.judged({"call": "f", "source": "f.py"} | row, DESCRIBED) for row in rows]
    return {
        "library": name, "versions": {library or name: version}, "date": "2026-11-30", "python": "3.11.7", "pins": [], "bare": [],
        "why": "", "installed": {}, "rows": judged,
    }  # fmt: skip


RECORDS = {
    "a": record("a", {"formula": "value_loss", "numbers": 4.0, "setting": "x|y=`1`"}, {"formula": "gae", "numbers": GAE.ours}),
    "b": record("b", {"formula": "value_loss", "numbers": 2.0, "note": "Of its own."}),
    "b-old": record("b-old", {"formula": "value_loss", "numbers": 4.004, "tolerance": 0.01}, version="0.9", library="b"),
    "c": record("c", {"formula": "gae", "numbers": [[0.0] * 8] * 2}),
}


@pytest.fixture(scope="module")
def text():
    return atlas_page.page(RECORDS, DESCRIBED)


def test_counts_come_from_the_records(text):
    assert "3 libraries gave 5 rows: 3 equal" in text and "and 2 do not. All were computed on 2026-11-30." in text


def test_who_follows_which_rule_is_told_first(text):
    first = text.partition("## Formulas of chapter")[0]
    assert "- As the book has it (2): a (x\\|y=\\`1\\`); b 0.9." in first and "- Half of it (1): b 1.0." in first
    assert "- It counts as an end (1): c." in first and "<!--" not in text


def test_a_row_says_number_rule_and_source(text):
    assert "| b 1.0 | 2 | Half of it. Of its own. | `f` in `f.py`, 2026‑11‑30 |" in text
    assert "| b 0.9 | 4.004 | equal to 0.01 | `f` in `f.py`, 2026‑11‑30 |" in text


def test_of_many_numbers_the_farthest_is_shown(text):
    assert "| a 1.0 | all 16 the same |" in text
    assert "| c 1.0 | 2 of 16 the same; farthest off 0 for 7 |" in text
    assert "The book: 0 1 2 3 4 5 6 7; 0 1 2 3 4 5 6 7" in text


def test_every_line_of_a_table_has_its_cells(text):
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) > 20
    for line in lines:
        assert line.replace("\\|", "").count("|") in (5, 7), line


def test_a_formula_without_rows_has_no_section_and_the_others_can_be_linked(text):
    assert "(atlas-value-loss)=\n### Value loss\n" in text and "### Explained variance" not in text


def test_the_csv_has_every_row_with_every_digit():
    rows = list(csv.DictReader(io.StringIO(atlas_page.table(RECORDS, DESCRIBED))))
    assert len(rows) == 5 and tuple(rows[0]) == atlas_page.COLUMNS
    half = next(row for row in rows if row["equal"] == "no" and row["formula"] == "value_loss")
    assert (half["library"], half["version"], half["rule"], half["sentence"]) == ("b", "1.0", "half", "Half of it.")
    assert json.loads(next(row for row in rows if row["formula"] == "gae")["numbers"]) == GAE.ours


def test_the_committed_records_make_a_page_under_a_megabyte_with_each_of_their_rows():
    files = atlas_page.staged()
    assert set(files) == {"atlas.md", "downloads/atlas.csv"} and sum(map(len, files.values())) < 1e6
    rows = sum(len(one["rows"]) for one in keeping.load_all().values())
    assert len(list(csv.DictReader(io.StringIO(files["downloads/atlas.csv"].decode())))) == rows
    assert "By no known rule" not in files["atlas.md"].decode()
