"""A small assignment and verdicts on it, for the tests of verdicts, gradebook and exports."""

from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from autograder.grading.verdicts import Verdict

POINTS = {"compute_gae": 3.0, "td_residuals": 2.0}
QUESTIONS = {"tradeoff": 2.0}
QUESTION_TEXT = "Why not λ = 1?\n\n*Write your answer here.*"
HOSTILE = (
    '<script>alert(1)</script> & "quotes" ]]> =1+1 \x00\x1b[31m\r \ud800 \ufffe \u202e | `x` [l](javascript:alert(1)) {{ 7*7 }}'
)


def _marked(cell, name, **nbgrader):
    defaults = {"grade": False, "solution": False, "locked": False, "task": False, "schema_version": 3}
    cell.metadata["nbgrader"] = {**defaults, "grade_id": name, **nbgrader}
    return cell


def release(points=POINTS, questions=QUESTIONS):
    """The notebook handed out: a stub and a locked test for each exercise, then the open questions."""
    cells = [new_markdown_cell("# Chapter\n\n<details><summary>Hint</summary>[link](https://example.org)</details>")]
    for name, worth in points.items():
        cells.append(_marked(new_code_cell(f"def {name}():\n    raise NotImplementedError"), name, solution=True))
        cells.append(_marked(new_code_cell(f"check({name})"), f"test_{name}", grade=True, locked=True, points=worth))
    for name, worth in questions.items():
        cells.append(_marked(new_markdown_cell(QUESTION_TEXT), name, grade=True, solution=True, points=worth))
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return new_notebook(cells=cells, metadata={"kernelspec": kernel, "language_info": {"name": "python"}})


def submission(answer="Bias.", **keywords):
    """The release with the open questions answered."""
    notebook = release(**keywords)
    for cell in notebook.cells:
        if cell.source == QUESTION_TEXT:
            cell.source = answer
    return notebook


def verdict(student="s001", scores=None, status="graded", points=POINTS, message="", **changes):
    """The mapping of a verdict: all right unless `scores` says otherwise."""
    items = []
    for name, worth in points.items():
        score = worth if scores is None else scores.get(name, worth)
        state = "correct" if score == worth else "partial" if score else "wrong"
        items.append(
            {"exercise": name, "score": score, "max_score": worth, "state": state, "misconceptions": [], "message": message}
        )
    total = sum(item["score"] for item in items)
    items += [
        {"exercise": name, "score": 0.0, "max_score": worth, "state": "manual", "misconceptions": [], "message": ""}
        for name, worth in QUESTIONS.items()
    ]
    common = {
        "schema": 1,
        "student": student,
        "assignment": "ch44",
        "status": status,
        "score": total,
        "max_score": sum(points.values()),
    }
    rest = {
        "manual_score": None,
        "manual_max_score": 2.0,
        "items": items,
        "flags": [],
        "seconds": 0.41,
        "environment": "e3b0c442",
    }
    return common | rest | changes


def judged(*args, **changes):
    """The verdict itself, as the judge gives it."""
    return Verdict.of(verdict(*args, **changes))
