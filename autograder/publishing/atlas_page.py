"""The appendix on what other libraries compute, and its table as CSV, from the records of experiments/atlas."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import yaml

from autograder.authoring.markdown import atlas_label
from autograder.paths import ROOT
from experiments.atlas import comparing, keeping
from experiments.atlas.given import TOLERANCE, Formula, formulas

INTRODUCTION = ROOT / "book" / "atlas.md"
NOT_RUN = keeping.FOLDER / "not_run.yml"
CSV = "downloads/atlas.csv"
COLUMNS = ("formula", "title", "chapter", "library", "version", "date", "setting", "numbers", "course", "equal", "tolerance", "rule",
           "sentence", "call", "source", "note")  # fmt: skip
NO_BREAK = "\N{NON-BREAKING HYPHEN}"
FEW = 6
"""As many numbers as one row shows; of more, it says how many are the same and which is farthest off."""

TO_KNOW = {  # the marker in the introduction -> the formulas that it is about
    "truncation": ("gae",),
    "value loss": ("value_loss", "value_loss_clipped", "token_value_loss", "token_value_loss_clipped"),
    "whitening": ("policy_loss_normalised", "normalised", "normalised_rollout", "whitened", "whitened_token_gae"),
    "diagnostics": ("approx_kl", "clip_fraction", "token_approx_kl", "token_clip_fraction"),
}
Records = Mapping[str, Mapping[str, Any]]


def staged(records: Records | None = None) -> dict[str, bytes]:
    """The page and the CSV, as Sphinx reads them."""
    known = keeping.load_all() if records is None else records
    described = formulas()
    return {"atlas.md": page(known, described).encode(), CSV: table(known, described).encode()}


def page(records: Records, described: Mapping[str, Formula]) -> str:
    """The appendix, in MyST."""
    text = INTRODUCTION.read_text(encoding="utf-8").rstrip()
    text = text.replace("<!-- counts -->", _counts(records))
    for marker, names in TO_KNOW.items():
        text = text.replace(f"<!-- {marker} -->", "\n\n".join(_who(records, described[name]) for name in names))
    parts = [text]
    chapters = sorted({one.chapter for one in described.values() if one.chapter is not None})
    for chapter in [*chapters, None]:
        parts.append(f"## Formulas of chapter {chapter}" if chapter else "## Formulas that the book does not have")
        if chapter is None:
            parts.append('What stands here as "the book\'s" is the usual formula, written out for the comparison.')
        parts += [_section(records, one) for one in described.values() if one.chapter == chapter and _rows(records, one.name)]
    parts += ["## The libraries", _libraries(records), f"({atlas_label('not_run')})=\n## Read, not run", _not_run()]
    parts.append('```{raw} html\n<script defer src="_static/atlas.js"></script>\n```')
    return "\n\n".join(parts) + "\n"


def _rows(records: Records, formula: str) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """All rows on a formula, each behind its record."""
    return [(record, row) for record in records.values() for row in record["rows"] if row["formula"] == formula]


def _counts(records: Records) -> str:
    rows = [row for record in records.values() for row in record["rows"]]
    libraries = {one for record in records.values() for one in record["versions"]}
    equal = sum(row["equal"] for row in rows)
    dates = sorted(record["date"] for record in records.values())
    when = dates[0] if dates[0] == dates[-1] else f"{dates[0]} to {dates[-1]}"
    return (
        f"{len(libraries)} libraries gave {len(rows)} rows: {equal} equal the book's numbers to a millionth, or to what the row says, and"
        f" {len(rows) - equal} do not. All were computed on {when}. {{download}}`The whole table as CSV <{CSV}>` has every digit."
    )


def _who(records: Records, formula: Formula) -> str:
    """Which libraries follow the book on a formula, and which another rule: a line for each rule."""
    found: dict[str, list[str]] = {}
    often = Counter(one for record in records.values() for one in record["versions"])
    for record, row in _rows(records, formula.name):
        name = " ".join(f"{one} {version}" if often[one] > 1 else one for one, version in record["versions"].items())
        found.setdefault("" if row["equal"] else row["rule"], []).append(f"{name}{_in_brackets(row['setting'])}")
    sentences = {rule.name: rule.sentence for rule in formula.rules}
    order = [name for name in ["", *sentences] if name in found]
    lines = []
    for name in order:
        count = len({text.split(" (")[0] for text in found[name]})
        sentence = "As the book has it" if not name else _plain(sentences[name].rstrip("."))
        lines.append(f"- {sentence} ({count}): {'; '.join(found[name])}.")
    return f"**{formula.title}**\n\n" + "\n".join(lines)


def _in_brackets(setting: str) -> str:
    return f" ({_plain(setting)})" if setting else ""


def _section(records: Records, formula: Formula) -> str:
    lines = [
        f"({atlas_label(formula.name)})=",
        f"### {formula.title}",
        "",
        f"{'The book' if formula.chapter else 'The usual form'}: {_shown(formula.ours)}",
        "",
        ":::{div} atlas-rows",
        "",
        "| Library | Computes | By the rule | Called |",
        "|---|---|---|---|",
    ]
    return "\n".join([*lines, *(_line(record, row, formula) for record, row in _rows(records, formula.name)), "", ":::"])


def _sentences(formula: Formula) -> dict[str, str]:
    """What each rule of a formula says, by its name."""
    return {"": "By no known rule."} | {rule.name: rule.sentence for rule in formula.rules}


def _line(record: Mapping[str, Any], row: Mapping[str, Any], formula: Formula) -> str:
    library = f"{' '.join(record['versions'])} {' '.join(record['versions'].values())}"
    near = "" if row["tolerance"] == TOLERANCE else f" to {row['tolerance']:g}"
    rule = f"equal{near}" if row["equal"] else _sentences(formula)[row["rule"]]
    rule += f". {row['note']}" if row["equal"] and row["note"] else f" {row['note']}"
    cells = [f"{library}{_in_brackets(row['setting'])}", _difference(row), _plain(rule)]
    return f"| {' | '.join(cells)} | `{row['call']}` in `{row['source']}`, {record['date'].replace('-', NO_BREAK)} |"


def _difference(row: Mapping[str, Any]) -> str:
    """A row's numbers, or of many the one that is farthest from the book's."""
    left, right = comparing.flat(row["numbers"]), comparing.flat(row["ours"])
    if len(left) <= FEW:
        return _shown(left)
    if row["equal"]:
        return f"all {len(left)} the same"
    alike = sum(comparing.same(a, b, row["tolerance"]) for a, b in zip(left, right, strict=True))
    at = max(range(len(left)), key=lambda place: abs(left[place] - right[place]))
    return f"{alike} of {len(left)} the same; farthest off {_number(left[at])} for {_number(right[at])}"


def _shown(numbers: Any) -> str:
    """All numbers, nested lists one after the other."""
    if isinstance(numbers, Sequence) and numbers and isinstance(numbers[0], Sequence):
        return "; ".join(_shown(part) for part in numbers)
    return " ".join(map(_number, comparing.flat(numbers)))


def _number(number: float) -> str:
    return f"{number:.5g}".replace("-", "−")


def _plain(text: str) -> str:
    """Plain text as a cell of a Markdown table, or in a line."""
    return " ".join(re.sub(r"([\\`*_{}\[\]<>#|~$])", r"\\\1", text).split())


def _libraries(records: Records) -> str:
    lines = ["| Library | Version | Date | Rows | Equal | How |", "|---|---|---|---|---|---|"]
    for record in records.values():
        rows = record["rows"]
        cells = [" ".join(record["versions"]), " ".join(record["versions"].values()), record["date"], str(len(rows))]
        cells += [str(sum(row["equal"] for row in rows)), record["why"] or "Its functions and methods are called."]
        lines.append(f"| {' | '.join(map(_plain, cells))} |")
    return "\n".join(lines)


def _not_run() -> str:
    lines = ["| Library | Version | Why not run | What its source says |", "|---|---|---|---|"]
    for one in yaml.safe_load(NOT_RUN.read_text(encoding="utf-8")):
        lines.append(f"| {' | '.join(_plain(one[key]) for key in ('library', 'version', 'reason', 'reads'))} |")
    return "\n".join(lines)


def table(records: Records, described: Mapping[str, Formula]) -> str:
    """Every row with every digit, as CSV."""
    out = io.StringIO()
    writer = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(_entries(records, described))
    return out.getvalue()


def _entries(records: Records, described: Mapping[str, Formula]) -> Iterator[dict[str, Any]]:
    for formula in described.values():
        for record, row in _rows(records, formula.name):
            entry = {name: row[name] for name in ("formula", "setting", "tolerance", "rule", "call", "source", "note")}
            entry["sentence"] = "" if row["equal"] else _sentences(formula)[row["rule"]]
            entry |= {"title": formula.title, "chapter": formula.chapter or "", "equal": "yes" if row["equal"] else "no"}
            entry |= {
                "library": " ".join(record["versions"]),
                "version": " ".join(record["versions"].values()),
                "date": record["date"],
            }
            yield entry | {"numbers": json.dumps(row["numbers"]), "course": json.dumps(row["ours"])}
