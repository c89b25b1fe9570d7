"""The page on a class says what the lecture needs and names nobody; the one for the teacher says who needs help."""

import random
import re
from collections import Counter
from html.parser import HTMLParser

import pytest
from gradebook_samples import HOSTILE, release
from hypothesis import given, settings
from hypothesis import strategies as st

from autograder import checks
from autograder.authoring import chapter
from autograder.grading import verdicts
from autograder.grading.verdicts import Item, Verdict
from autograder.reporting import exports
from autograder.reporting.class_figures import TENTHS, figures, outcome
from autograder.reporting.class_page import ROWS, class_pages, picture_of_outcomes
from autograder.reporting.gradebook import GradebookWriter
from tests.book import axe
from tests.book.visit import LOOKS, Visit

CHAPTERS = [one.assignment for one in chapter.all_chapters()]
EXERCISES = {one.name: one for name in CHAPTERS for one in checks.exercises(name)}
NAMES = ("Zebedee", "Quillon", "Xanthe", "Yorick", "Wilhelmina", "Uhtred", "Thaddeus", "Ottoline")
MASK = "termination-ignored"  # a mistake in td_residuals


def one(student, answers=None, assignment="ch44", status="graded", flags=(), message=""):
    """A verdict: all right, but for the exercises in `answers`: name → state, (state, mistake) or (state, mistake, share)."""
    items = []
    for exercise in checks.exercises(assignment):
        state, mistake, share = _whole((answers or {}).get(exercise.name, "correct"))
        score = exercise.points * (1.0 if state == "correct" else share)
        said = "" if state == "correct" else message
        items.append(Item(exercise.name, score, exercise.points, state, (mistake,) if mistake else (), said))
    most = sum(item.max_score for item in items)
    total = sum(item.score for item in items) if status in ("graded", "needs_review") else 0.0
    return Verdict.of(Verdict(student, assignment, status, total, most, items=tuple(items), flags=tuple(flags)))


def _whole(answer):
    given = answer if isinstance(answer, tuple) else (answer,)
    return (*given, *(None, 0.0)[len(given) - 1 :])


def made_up(students, assignments, text="", seed=0):
    """A class as they come; `text` stands wherever a learner can put some."""
    random_numbers, found = random.Random(seed), []
    for number in range(students):
        name = f"{NAMES[number % len(NAMES)]}{number}"
        for assignment in assignments:
            answers = {}
            for exercise in checks.exercises(assignment):
                state = random_numbers.choice(
                    ("correct", "correct", "correct", "wrong", "partial", "error", "timeout", "not_implemented")
                )
                named = [mistake.name for mistake in getattr(exercise, "misconceptions", ())][:3]
                mistake = random_numbers.choice(named) if named and state in ("wrong", "partial") else None
                answers[exercise.name] = (state, mistake, random_numbers.choice((0.25, 0.75)) if state == "partial" else 0.0)
            status = random_numbers.choice(("graded",) * 7 + ("needs_review", "student_error", "infra_error"))
            flags = [f"cell_2_stopped: line 3, {name}Error: {text}", f"found_as: {name} {text}", f"{name}: {text}"]
            found.append(one(name, answers, assignment, status, flags, f"{name} {text}"))
    return sorted(found, key=lambda verdict: (verdict.student, verdict.assignment))


class Page(HTMLParser):
    """The tags of a page, its attributes, its text, and the rows of its tables by their first cell."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.text, self.rows, self._row = Counter(), [], "", {}, None
        self.feed(text)
        self.text = " ".join(self.text.split())

    def handle_starttag(self, tag, attrs):
        self.tags[tag] += 1
        self.attributes += attrs
        if tag == "tr":
            self._row = []
        elif tag in ("td", "th") and self._row is not None:
            self._row.append("")

    def handle_endtag(self, tag):
        if tag == "tr" and self._row:
            cells = [" ".join(cell.split()) for cell in self._row]
            self.rows[cells[0]] = cells[1:]
            self._row = None

    def handle_data(self, data):
        self.text += data
        if self._row:
            self._row[-1] += data

    def row(self, part):
        """The row whose first cell holds `part`."""
        [found] = [cells for name, cells in self.rows.items() if part in name]
        return found


def public(found, **roster):
    return class_pages(found, **roster)["class.html"]


def private(found, **roster):
    return class_pages(found, **roster)["class-private.html"]


def twenty():
    """Twenty students: td_residuals is too hard, as most forget the mask, and three hang."""
    ways = ["correct"] * 6 + [("wrong", MASK)] * 7 + ["timeout"] * 3 + ["not_implemented"] * 3 + [("partial", None, 0.5)]
    return [one(f"s{number:02}", {"td_residuals": way}) for number, way in enumerate(ways)]


# --- what is said ------------------------------------------------------------------------------------------------------------


def test_an_exercise_has_its_outcomes_in_numbers_and_words():
    [of] = figures(twenty(), 20)
    first = of.exercises[0]
    assert first.stub.name == "td_residuals" and first.too_hard and not first.left_out
    assert first.counts == Counter(all=6, none=7, stopped=3, untried=3, most=1)
    assert first.solved == pytest.approx(6 / 17) and first.share == pytest.approx(6.5 / 20)
    assert [each.stub.number for each in of.exercises[1:]] == [
        *range(2, len(EXERCISES_OF_44) + 1)
    ]  # equal ones stay in the chapter's order
    exact = Page(private(twenty())).row("One residual per step")
    assert exact[1:] == ["6", "1", "0", "7", "3", "3", "32%"] and exact[0] == "6733"  # the picture's own numbers
    shown = Page(public(twenty())).row("One residual per step")
    assert shown[1:] == ["6", "< 5", "0", "7", "< 5", "< 5", "32%"] and shown[0] == "67"
    labels = [value for name, value in Page(public(twenty())).attributes if name == "aria-label"]
    expected = "all points 6, half or more fewer than 5, no points 7, stopped fewer than 5, not tried fewer than 5"
    assert expected in labels


def test_too_hard_is_said_with_the_rule_and_the_level_that_was_announced():
    text = Page(public(twenty())).text
    assert "fewer than half of those who tried it, and at least 5 did, have all its points" in text
    assert "Exercise 1: One residual per step (td_residuals): of those who tried it, 35% have all points" in text
    assert "announced as ●○○ (1 of 3)" in text
    half = [one(f"s{number}", {"td_residuals": "wrong" if number % 2 else "correct"}) for number in range(10)]
    assert "No exercise is too hard" in Page(public(half)).text


def test_what_few_tried_is_not_called_hard():
    stub = [one(f"s{number:02}", {"td_residuals": "wrong" if number < 4 else "not_implemented"}) for number in range(20)]
    [of] = figures(stub, 20)
    assert of.exercises[0].left_out and not of.exercises[0].too_hard
    assert "left out by most" in Page(public(stub)).text


def test_a_mistake_comes_with_what_learners_read_and_how_many_made_it():
    [message] = [wrong.message for wrong in EXERCISES["td_residuals"].misconceptions if wrong.name == MASK]
    text = Page(public(twenty())).text
    assert re.search(rf"7 {re.escape(message)} ch44, Exercise 1: One residual per step \(td_residuals\) · {MASK}", text)
    rare = [one(f"s{number}", {"td_residuals": ("wrong", MASK) if number < 4 else "correct"}) for number in range(20)]
    assert (
        message not in Page(public(rare)).text
        and "1 mistake with a name has been made by fewer than 5" in Page(public(rare)).text
    )
    assert f"4 {message}" in Page(private(rare)).text


def test_the_same_mistake_in_two_exercises_is_one_of_each_student():
    twice = dict.fromkeys(("surrogate_loss", "clipped_surrogate_loss"), ("wrong", "sign-missing"))
    [of] = figures([one(f"s{number}", twice, "ch43") for number in range(9)], 9)
    [mistake] = of.mistakes
    assert mistake.students == 9 and [stub.name for stub in mistake.stubs] == list(twice)


def test_commoner_mistakes_come_first():
    ways = [("wrong", MASK)] * 6 + [("wrong", "graph-kept")] * 8
    found = figures([one(f"s{number:02}", {"td_residuals": way}) for number, way in enumerate(ways)], 14)[0].mistakes
    assert [(each.name, each.students) for each in found] == [("graph-kept", 8), (MASK, 6)]


def test_points_fall_into_five_parts_and_full_marks_into_the_last():
    of_ten = [
        one(f"s{number}", dict.fromkeys(list(EXERCISES_OF_44)[number:], "wrong")) for number in range(len(EXERCISES_OF_44) + 1)
    ]
    totals = figures(of_ten, len(of_ten))[0].totals
    assert totals.total() == len(of_ten) and totals[TENTHS[0]] >= 1 and totals[TENTHS[-1]] >= 1
    perfect = figures([one("s")], 1)[0].totals
    assert perfect == Counter({TENTHS[-1]: 1})


EXERCISES_OF_44 = {exercise.name: exercise for exercise in checks.exercises("ch44")}


@pytest.mark.parametrize(
    "flag, said",
    [
        (
            "cell_3_stopped: line 2, ModuleNotFoundError: No module named 'seaborn'",
            "code cell 3 stopped with ModuleNotFoundError",
        ),
        ("cell_3_stopped: line 2, Zebedee: hello", "code cell 3 stopped with an error"),
        ("cell_12_did_not_finish", "code cell 12 did not finish in time"),
        ("missing_cell: gae_tradeoff", "an open question is missing"),
    ],
)
def test_what_stops_many_is_said_on_top(flag, said):
    shared = [one(f"s{number:02}", flags=[flag] if number < 6 else []) for number in range(20)]
    text = Page(public(shared)).text
    assert f"ch44, 6 of 20 notebooks: {said}." in text
    assert text.index(said) < text.index("Exercise 1")
    alone = [one(f"s{number:02}", flags=[flag] if number < 4 else []) for number in range(20)]
    assert said not in Page(public(alone)).text and said in Page(private(alone)).text


def test_other_names_of_files_are_no_broken_release():
    assert "So many" not in public([one(f"s{number}", flags=["found_as: ch44 (1).ipynb"]) for number in range(20)])


def test_an_exercise_that_stops_everybody_is_said_on_top():
    stopped = [one(f"s{number:02}", {"compute_gae": "error"}) for number in range(9)]
    assert "ch44, 9 of 9 notebooks: compute_gae stopped" in Page(public(stopped)).text


def test_only_graded_notebooks_count_as_outcomes():
    others = [
        one(f"t{number:02}", {"compute_gae": "wrong"}, status=status) for number, status in enumerate(verdicts.STATUSES[1:])
    ]
    [of] = figures([*twenty(), *others], 23)
    assert {each.notebooks for each in of.exercises} == {20} and of.handed_in == 23


@pytest.mark.parametrize(
    "state, score, expected",
    [
        ("correct", 2, "all"),
        ("partial", 1, "most"),
        ("partial", 0.5, "some"),
        ("wrong", 0, "none"),
        ("error", 0, "stopped"),
        ("timeout", 0, "stopped"),
        ("not_implemented", 0, "untried"),
    ],
)
def test_outcomes_are_states_and_shares(state, score, expected):
    assert outcome(Item("x", score, 2.0, state)) == expected


# --- what is not said --------------------------------------------------------------------------------------------------------


def test_no_student_is_on_the_page_for_the_lecture():
    found = made_up(40, CHAPTERS[:3])
    found.append(Verdict.of(Verdict("Zebedee0", "Zebedee", "student_error", 0.0, 0.0, flags=("unknown_assignment",))))
    strange = Item("Quillon", 0.0, 1.0, "wrong", ("Xanthe",), "Yorick")
    found.append(Verdict.of(Verdict("Uhtred", "ch44", "graded", 0.0, 1.0, items=(strange,))))
    pages = class_pages(found, {"Ottoline": "Ottoline, the Great", "Zebedee0": "Thaddeus"})
    for name in (*NAMES, *(verdict.student for verdict in found)):
        assert name.lower() not in pages["class.html"].lower(), name
    for name in ("Zebedee0", "Uhtred", "Ottoline, the Great", "Thaddeus"):
        assert name in pages["class-private.html"]


@settings(max_examples=30, deadline=None)
@given(st.text(st.characters(exclude_categories=()), max_size=200))
def test_nothing_that_learners_wrote_reaches_the_page_for_the_lecture(text):
    def written(text):
        strange = Item(text, 0.0, 1.0, "wrong", (text,), text)
        flags = (f"cell_1_stopped: line 1, no Error: {text}", f"repaired: {text}", f"handed_in: {text}")
        return [
            Verdict.of(Verdict(f"s{number}", "ch44", "graded", 0.0, 1.0, items=(strange,), flags=flags)) for number in range(20)
        ]

    assert public(written(text)) == public(written("x"))


def test_a_small_number_shows_in_no_length_either():
    assert picture_of_outcomes(Counter(all=20, none=1), 5) == picture_of_outcomes(Counter(all=20, none=4), 5)
    assert picture_of_outcomes(Counter(all=20, none=1), 1) != picture_of_outcomes(Counter(all=20, none=4), 1)


def test_four_students_are_too_few_for_a_picture():
    four = [one(f"s{number}", {"td_residuals": ("wrong", MASK)}) for number in range(4)]
    page = Page(public(four))
    assert "These are too few for a picture" in page.text and page.tags["svg"] == 0 and MASK not in page.text
    assert "What fewer than 5 students made" in page.text
    assert Page(private(four)).row("One residual per step")[4] == "4"


@pytest.mark.parametrize("page", ["class.html", "class-private.html"])
def test_hostile_texts_add_no_markup_and_no_request(page):
    hostile = [*made_up(20, ["ch44"], HOSTILE), one('"><script>x', status="needs_review", flags=[HOSTILE])]
    seen = Page(class_pages(hostile, {"s": HOSTILE})[page])
    ours = class_pages(made_up(20, ["ch44"])).values()
    assert set(seen.tags) <= {tag for text in ours for tag in Page(text).tags}
    names = {"lang", "charset", "http-equiv", "content", "name", "class", "scope", "id", "href", "role", "aria-label", "tabindex"}
    assert {name for name, _ in seen.attributes} <= names | {"viewbox", "x", "y", "width", "height", "aria-hidden"}
    assert all(value == "class.html" or value.startswith("#") for name, value in seen.attributes if name == "href")


# --- sizes, oddities, files --------------------------------------------------------------------------------------------------


def test_a_large_class_makes_small_pages():
    pages = class_pages(made_up(300, CHAPTERS, HOSTILE))
    assert len(pages["class.html"].encode()) < 500_000 and len(pages["class-private.html"].encode()) < 1_000_000


@pytest.mark.parametrize(
    "found, said",
    [
        ([], "There is no verdict on a chapter of the course yet."),
        ([Verdict("s", "homework", "student_error", 0.0, 0.0)], "There is no verdict on a chapter of the course yet."),
        ([one(f"s{n}", status="infra_error") for n in range(9)], "ch44, 9 of 9 notebooks: the grader failed: grade again."),
        ([one(f"s{n}", status="student_error") for n in range(9)], "ch44, 9 of 9 notebooks: there was no notebook to grade."),
        ([one("s")], "Too few notebooks have been graded"),
    ],
    ids=["nothing", "no chapter", "grader failed", "no notebook", "one student"],
)
def test_odd_classes_have_sensible_pages(found, said):
    text = Page(public(found)).text
    assert said in text and "nan" not in text.lower().split()
    assert "Not for the projector" in Page(private(found)).text


def test_a_list_of_students_ends_somewhere():
    waiting = [one(f"s{number:03}", status="needs_review") for number in range(ROWS + 2)]
    assert "… and 2 more." in private(waiting) and private(waiting).count("<bdi>s") == ROWS


def test_who_needs_help():
    found = [
        *twenty(),
        one("late", assignment="ch43"),
        one("lost", dict.fromkeys(EXERCISES_OF_44, "error"), status="student_error", message="There is no notebook ch44.ipynb."),
        one("odd", status="needs_review", flags=["missing_cell: gae_tradeoff", "handed_in: x sha256 0"]),
        one("unlucky", status="infra_error", flags=["grader_failed: OSError: full"]),
        one("weak", dict.fromkeys(EXERCISES_OF_44, "wrong")),
    ]
    page = private(sorted(found, key=lambda each: (each.student, each.assignment)), roster={"absent": "Ab Sent", "s00": "s00"})
    sections = dict(re.findall(r"<h3>([^<]+)</h3>(.*?)(?=<h3>|<h2)", page, re.DOTALL))
    listed = {title: re.findall(r'<th scope="row"><bdi>(.*?)</bdi>', text) for title, text in sections.items()}
    assert {title: names for title, names in listed.items() if names} == {
        "Grading failed": ["unlucky"],
        "To be reviewed": ["odd"],
        "No notebook to grade": ["lost"],
        "Nothing handed in": ["absent (Ab Sent)"],
        "Fallen behind": ["late"],
        "Few points": ["weak"],
    }
    assert "There is no notebook ch44.ipynb." in sections["No notebook to grade"]
    assert "missing_cell: gae_tradeoff" in sections["To be reviewed"] and "sha256" not in sections["To be reviewed"]
    assert "td_residuals, compute_gae, lambda_returns" in sections["Few points"] and " and 2 more" in sections["Few points"]


def test_both_pages_are_written_with_every_export_also_of_students_who_are_absent(tmp_path):
    with GradebookWriter(f"sqlite:///{tmp_path}/gradebook.db") as writer:
        writer.register("ch44", release())
        for verdict in reversed(twenty()):
            verdicts.write(tmp_path / "verdicts", verdict)
        exports.write_all(tmp_path, writer, [])
        written = {name: (tmp_path / name).read_bytes() for name in ("class.html", "class-private.html")}
        assert written == {name: text.encode() for name, text in class_pages(twenty()).items()}
        exports.write_all(tmp_path, writer, twenty()[:1])
        assert {name: (tmp_path / name).read_bytes() for name in written} == written


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("name", ["class.html", "class-private.html"])
def test_the_pages_are_accessible_in_each_look_and_ask_for_nothing(browser, tmp_path, look, name):
    for file, text in class_pages(made_up(60, CHAPTERS[:2])).items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    with Visit(browser, tmp_path / name, look) as visit:
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= LOOKS[look][1]
        assert len(visit.requests) == 1 and visit.complaints == []
        assert axe.violations(visit.page) == []
