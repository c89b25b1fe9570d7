"""What chapters say of libraries in boxes *In the wild, November 2026*: each sentence rests on rows of the atlas, on a work, or on a script
of findings/, and all rows are of that month."""

from __future__ import annotations

import re
from datetime import date

import pytest
import yaml

from autograder.authoring import chapter, markdown
from autograder.paths import ROOT
from experiments.atlas import comparing, given, keeping

TITLE = "In the wild, "
RECORDS = keeping.load_all()
FORMULAS = given.formulas()
NOT_RUN = yaml.safe_load((keeping.FOLDER / "not_run.yml").read_text(encoding="utf-8"))
LINK = re.compile(r"\[(?P<text>[^\]]*)\]\(atlas:(?P<row>[^)]*)\)")
SCRIPT = re.compile(r"`(?P<path>findings/[\w-]+\.sh)`")
NUMBER = re.compile(r"(?<![\w.])[-−]?\d+(?:,\d{3})*(?:\.\d+)?(?![\w])")


def boxes():
    """The month and the text of each box, by chapter."""
    found = []
    for own in chapter.all_chapters():
        for cell in own.cells:
            for block in markdown.parse(cell.source) if cell.kind == "markdown" else ():
                if block.kind == "admonition" and block.argument.startswith(TITLE):
                    found.append(pytest.param(block.argument.removeprefix(TITLE), block.text.strip(), id=own.assignment))
    return found


def sentences(text):
    return re.split(r"(?<=[.!?])\s+(?=[A-Z\[`*])", text)


def plain(name):
    return re.sub(r"[^a-z0-9]", "", name.lower())


def linked(link):
    """The rows that a link names, behind their record. Raises AssertionError if there is none, or it is of another version."""
    formula, library, *rule = link["row"].split("/")
    name, _, version = link["text"].rpartition(" ")
    if formula == "not_run":
        assert any(plain(one["library"]) == plain(library) == plain(name) and one["version"] == version for one in NOT_RUN), link[
            0
        ]
        return []
    record = RECORDS[library]
    assert version in record["versions"].values() and plain(name) in map(plain, [library, *record["versions"]]), link[0]
    rows = [row for row in record["rows"] if row["formula"] == formula and [row["rule"] or "equal"] == rule]
    assert rows, f"{link[0]}: there is no such row"
    return [(record, row) for row in rows]


def numbers_of_its_words(row):
    """The numbers in a row's setting, note and rule."""
    rules = {rule.name: rule.sentence for rule in FORMULAS[row["formula"]].rules}
    return [float(one) for one in re.findall(r"\d+(?:\.\d+)?", f"{row['setting']} {row['note']} {rules.get(row['rule'], '')}")]


def traced(sentence, month):
    """Check that a sentence of the box of a month says what rows, works or scripts say."""
    rows = [found for link in LINK.finditer(sentence) for found in linked(link)]
    scripts = [(ROOT / match["path"]).read_text(encoding="utf-8") for match in SCRIPT.finditer(sentence)]
    assert LINK.search(sentence) or scripts or "{cite" in sentence, f"rests on nothing: {sentence}"
    for record, _ in rows:
        assert f"{date.fromisoformat(record['date']):%B %Y}" == month, f"of another month: {sentence}"
    known = [number for _, row in rows for number in [*comparing.flat([row["numbers"], row["ours"]]), *numbers_of_its_words(row)]]
    prose = re.sub(r"\{[^}]*\}`[^`]*`|`[^`]*`|\$[a-z]_\d\$", " ", LINK.sub(" ", sentence))
    for found in NUMBER.findall(prose):
        digits = len(found.partition(".")[2])
        number = float(found.replace("−", "-").replace(",", ""))
        of_rows = any(round(one, digits) == number for one in known)
        assert of_rows or any(found.replace("−", "-") in NUMBER.findall(script) for script in scripts), f"{found}: {sentence}"


@pytest.mark.parametrize("month, text", boxes())
def test_every_sentence_of_a_box_is_traced_to_rows_works_or_scripts(month, text):
    for sentence in sentences(text):
        traced(sentence, month)
    assert 50 <= len(LINK.sub(r"\g<text>", text).split()) <= 130


GOOD = "By default [skrl 2.1.1](atlas:gae/skrl/truncation_ignored) did."


@pytest.mark.parametrize(
    "sentence",
    [
        GOOD.replace("2.1.1", "2.1.0"),
        GOOD.replace("[skrl", "[rl-games"),
        GOOD.replace("truncation_ignored", "truncation_as_end"),
        GOOD.replace("truncation_ignored", "equal"),
        GOOD.replace("did", "gave 9.99"),
        "All libraries did.",
        "So did [PufferLib 15cb9da](atlas:not_run/pufferlib) did.",
    ],
)
def test_a_sentence_that_no_row_supports_is_found(sentence):
    traced(GOOD, "November 2026")
    traced(GOOD.replace("did", "gave 2.6"), "November 2026")
    with pytest.raises(AssertionError):
        traced(sentence, "November 2026")


def test_a_box_of_another_month_than_its_rows_is_found():
    with pytest.raises(AssertionError, match="of another month"):
        traced(GOOD, "October 2026")


def test_links_of_chapters_to_the_atlas_are_of_its_rows():
    for own in chapter.all_chapters():
        for cell in own.cells:
            for link in LINK.finditer(cell.source):
                linked(link)
