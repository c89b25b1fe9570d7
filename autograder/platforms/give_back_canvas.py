"""Canvas: gradebook files by assignment and by question, or the gradebook that Canvas has exported, filled in.

Canvas's import (`lib/gradebook_importer.rb`) takes a blank cell for a grade to clear, finds students by ID, then by login, and
assignments by the name of their column. So no file here has a blank; who has no points in a column is not in that column's file.
"""

from __future__ import annotations

import re
from pathlib import Path

from autograder.grading.verdicts import write_atomically
from autograder.platforms import give_back_sheets
from autograder.platforms.give_back import GiveBackError, Given, Result, by_assignment, matched, the_assignment
from autograder.reporting.report import points
from autograder.reporting.tables import BY_HAND, Column, canvas_columns, canvas_finds, canvas_table, without_blanks


def write(results: list[Result], into: Path, given: Given, worksheet: Path | None = None) -> None:
    """Write `into/canvas/*.csv`, or the worksheet filled in."""
    if worksheet is not None:
        return _fill(the_assignment(results, worksheet), into, given, worksheet)
    found = []
    for result in results:
        if canvas_finds(result.person):
            found.append(result)
        else:
            given.leave_out(
                result,
                f"Canvas cannot find the login {result.person.login!r} in a file, and its ID is unknown: "
                "collect from Canvas's download, or give --worksheet",
            )
    people = {result.student: result.person for result in found}
    columns = canvas_columns([_row(result) for result in found])
    files = {"canvas.csv": {name: columns[name] for name in without_blanks(columns)}}
    files |= {f"{name}.csv": {name: column} for name, column in columns.items()}
    for assignment, group in by_assignment(found).items():
        for ending, by_hand in ((" questions", False), (" questions" + BY_HAND, True)):
            if questions := _questions(group, by_hand):
                files[f"{assignment}{ending}.csv"] = questions
    for name, table in files.items():
        if table:
            given.files.append(write_atomically(into / "canvas" / name, canvas_table(table, people)))
    if files["canvas.csv"]:
        given.notes.append(
            f"canvas.csv has {', '.join(files['canvas.csv'])}; whoever is missing there is in the file of a single column."
        )
        given.notes.append("Import an assignment as a whole or by its questions, not both: Canvas would count it twice.")


def _row(result: Result) -> dict[str, object]:
    by_hand = [one for one in result.questions if one.by_hand]
    return {
        "student_id": result.student,
        "assignment": result.assignment,
        "submitted": True,
        "late_submission_penalty": result.penalty,
        "automatic": result.automatic,
        "automatic_max": result.automatic_max,
        "by_hand": None if result.waits else sum(one.score or 0.0 for one in by_hand),
        "by_hand_max": sum(one.max_score for one in by_hand),
    }


def _questions(results: list[Result], by_hand: bool) -> dict[str, Column]:
    """A column for each exercise, or for each open question, with the students who have points in all of them."""
    complete = [result for result in results if not (by_hand and result.waits)]
    columns: dict[str, Column] = {}
    for result in complete:
        for one in result.questions:
            if one.by_hand == by_hand:
                name = f"{result.assignment} {one.name}"
                columns.setdefault(name, (one.max_score, {}))[1][result.student] = one.score or 0.0
    if columns and not by_hand and any(result.penalty for result in complete):
        columns[f"{results[0].assignment} late"] = (0.0, {result.student: -result.penalty for result in complete})
    return columns


# --- the gradebook that Canvas has exported ----------------------------------------------------------------------------------


def _fill(results: list[Result], into: Path, given: Given, worksheet: Path) -> None:
    """Fill the assignment's columns, and nothing else: a student without a final grade keeps the cell that Canvas exported."""
    sheet = give_back_sheets.read(worksheet)
    identity, login = sheet.needed("ID"), sheet.column("SIS Login ID")
    sheet.needed("Section")
    possible = next((row for row in sheet.rows[1:] if "Points Possible" in row[0]), None)
    if possible is None:
        raise GiveBackError(f"{worksheet}: no row 'Points Possible'; give the gradebook as Canvas exports it")
    if not results:
        return
    assignment = results[0].assignment
    place, hand = _column(sheet, assignment), _column(sheet, assignment + BY_HAND)
    if place is None:
        raise GiveBackError(
            f"{worksheet}: row 1: no column {assignment!r}. Call the assignment so in Canvas, or import the file "
            f"that `course return --to canvas` writes without --worksheet, which makes it."
        )
    most = _possible(possible[place], worksheet, assignment)
    automatic, whole = results[0].automatic_max, results[0].maximum
    if hand is None and most not in (automatic, whole):
        raise GiveBackError(
            f"{worksheet}: {assignment} has {points(most)} points in Canvas; expected {points(automatic)}, the automatic ones, "
            f"or {points(whole)}, with those by hand. Change its points in Canvas and export again."
        )
    keys = {
        number: {row[identity].strip(), *([row[login]] if login is not None else [])}
        for number, row in enumerate(sheet.rows)
        if number and row is not possible and row[identity].strip()
    }
    only = hand is None and most == automatic
    for number, result in matched(
        results, keys, lambda one: filter(None, (one.person.identity, one.person.login, one.student)), given,
        "is this one's: collect from Canvas's download, or call the folder by Canvas's login",
    ).items():  # fmt: skip
        row, columns = sheet.rows[number], canvas_columns([_row(result)])
        if hand is not None or only:
            row[place] = _number(columns[assignment][1][result.student])
            if hand is not None and assignment + BY_HAND in columns:
                row[hand] = _number(columns[assignment + BY_HAND][1][result.student])
        elif result.waits:
            given.leave_out(result, "waits for points by hand (formgrader), which this column includes")
        else:
            row[place] = _number(result.total()[0])
    given.files.append(write_atomically(sheet.target(into / "canvas"), sheet.to_bytes()))


def _column(sheet: give_back_sheets.Sheet, name: str) -> int | None:
    """Canvas adds its number to a name, `ch44 (12345)`."""
    names = [cell for cell in sheet.rows[0] if re.sub(r"\s\(\d+\)\Z", "", cell.strip()) == name]
    return sheet.column(*(cell.strip() for cell in names)) if names else None


def _possible(text: str, worksheet: Path, assignment: str) -> float:
    try:
        return float(text.strip().replace(",", "."))
    except ValueError:
        raise GiveBackError(f"{worksheet}: {assignment} has {text!r} points possible; let Canvas grade it in points") from None


def _number(value: float) -> str:
    return f"{round(value, 2):.2f}"
