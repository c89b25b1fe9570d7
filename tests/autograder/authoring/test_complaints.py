"""A slip in an exercise's checks is one sentence with the exercise, the case and the cure, before anything of the exercise is called."""

import sys
from dataclasses import replace

import pytest
import torch

from autograder import checks, paths
from autograder.authoring import assemble, chapter, complaints, contract, freeze
from autograder.authoring.chapter import ChapterError
from autograder.authoring.spec import Case, Exercise
from course_lib.checks.cases import built


def discounted(rewards, gamma, gae_lambda=0.5):
    if not 0 <= gae_lambda <= 1:
        raise ValueError(f"gae_lambda must lie in [0, 1], got {gae_lambda}")
    return rewards * gamma * gae_lambda


def forbidden(rewards, gamma, gae_lambda=0.5):
    raise AssertionError("nothing may be called")


def rewards(generator):
    return {"rewards": torch.randn(3, generator=generator, dtype=torch.float64), "gamma": 0.9}


def exercise(case, reference=forbidden, criteria=None):
    return Exercise("discounted", reference, criteria or {"values": 1.0}, (case,), (), {})


SLIPS = [
    (
        Case("λ = 1.5", lambda draws: rewards(draws) | {"gae_lamda": 1.5}, raises=["gae_lambda"]),
        "discounted, case 'λ = 1.5': the reference takes no argument 'gae_lamda' (did you mean gae_lambda?);"
        " it takes rewards, gamma, gae_lambda",
    ),
    (
        Case("few", lambda draws: {"gamma": 0.9}),
        "discounted, case 'few': the argument 'rewards' of the reference is missing; its inputs must draw one",
    ),
    (
        Case("leaf", rewards, differentiate=["reward"]),
        "discounted, case 'leaf': its 'differentiate' names 'reward', which is no argument (did you mean rewards?)",
    ),
    (
        Case("left", rewards, returns=["optimizer"]),
        "discounted, case 'left': its 'returns' names 'optimizer', which is no argument",
    ),
    (
        Case("drawn", lambda draws: rewards(drawn)),  # noqa: F821
        "discounted, case 'drawn': no inputs can be drawn, NameError: name 'drawn' is not defined",
    ),
    (
        Case("seen", rewards, view="epoch"),
        "discounted, case 'seen': there is no view 'epoch' (did you mean epochs?);"
        " views are functions of course_lib/checks/views.py",
    ),
]


@pytest.mark.parametrize("maker", ["seeding.generater", "envs.TimerVectorEnv", "generator"])
def test_something_to_be_built_that_the_library_has_not_is_told(maker):
    case = Case(
        "made", lambda draws: rewards(draws) | {"gae_lambda": [{"inner": built(maker, seed=built("seeding.generator", seed=1))}]}
    )
    assert list(freeze.refusals(exercise(case))) == [
        f"discounted, case 'made': course_lib has no {maker}, which `built` is to make; it takes module.name"
    ]


@pytest.mark.parametrize(("case", "sentence"), SLIPS, ids=[case.name for case, _ in SLIPS])
def test_a_slip_in_a_case_is_told_before_the_reference_is_called(case, sentence):
    assert list(freeze.refusals(exercise(case))) == [sentence]


@pytest.mark.parametrize(("case", "sentence"), SLIPS[:4], ids=[case.name for case, _ in SLIPS[:4]])
def test_a_misnamed_argument_is_never_passed_by_position(case, sentence):
    with pytest.raises(freeze.FreezeError) as caught:
        freeze.complete(exercise(case))
    assert str(caught.value) == sentence


def test_points_for_something_that_no_check_looks_at_are_refused():
    assert list(freeze.refusals(exercise(Case("c", rewards), criteria={"gradients": 1.0}))) == [
        "discounted: its criteria pay for 'gradients', which nothing looks at (did you mean gradient?);"
        " points are for values, gradient, dtype, inputs, errors"
    ]


@pytest.mark.parametrize(
    ("message", "case", "sentence"),
    [
        ("bad", {"raises": ["gamma"]}, "the reference must raise a ValueError that names gamma; it raises ValueError: bad"),
        (None, {"raises": ["gamma"]}, "the reference must raise a ValueError that names gamma; it returns a tensor"),
        ("bad", {}, "the reference raises ValueError: bad; a case that it must refuse says so by `raises`"),
    ],
)
def test_a_reference_that_ends_otherwise_than_its_case_says_is_told_in_a_sentence(message, case, sentence):
    def reference(rewards, gamma):
        if message:
            raise ValueError(message)
        return rewards

    with pytest.raises(freeze.FreezeError) as caught:
        freeze.complete(exercise(Case("c", rewards, **case), reference))
    assert str(caught.value) == f"discounted, case 'c': {sentence}"


def test_the_file_of_the_checks_is_named_for_exercises_of_the_course():
    real = checks.functions("ch44")[0]
    broken = replace(real, cases=(Case("c", rewards),))
    assert (paths.ROOT / complaints.checks_file(real)).is_file()
    with pytest.raises(freeze.FreezeError, match=r"^autograder/checks/ch44\.py: td_residuals, case 'c': "):
        freeze.complete(broken)


def test_a_slip_ends_verification_with_file_and_line():
    page = chapter.load("ch44")
    sources = contract.sources(page)
    broken = replace(sources.exercises[1], criteria={"gradients": sources.exercises[1].points})
    with pytest.raises(ChapterError) as caught:
        assemble.verify(page, replace(sources, exercises=(sources.exercises[0], broken, *sources.exercises[2:])))
    path, line, _ = str(caught.value).split(":", 2)
    assert path.endswith("autograder/checks/ch44.py")
    assert '"compute_gae"' in (paths.ROOT / path).read_text(encoding="utf-8").splitlines()[int(line) - 1]


def test_a_chapter_without_checks_or_solutions_is_told_which_file_to_write(tiny, monkeypatch):
    with pytest.raises(
        ChapterError, match=r"ch99_tiny.md:\d+: there is no solutions/ch99\.py, and so no solutions of double: write it"
    ):
        contract.sources(tiny.chapter)
    monkeypatch.setitem(sys.modules, "solutions.ch99", checks)
    with pytest.raises(
        ChapterError, match=r"ch99_tiny.md:\d+: there is no autograder/checks/ch99\.py, and so no checks of double: write"
    ):
        contract.sources(tiny.chapter)
    monkeypatch.setitem(sys.modules, "autograder.checks.ch99", checks)
    with pytest.raises(ChapterError, match=r"checks/__init__.py:1: .*`EXERCISES`"):
        contract.sources(tiny.chapter)


def test_a_module_that_is_there_and_imports_something_that_is_not_keeps_its_own_error(tiny, monkeypatch):
    def broken(name):
        raise ModuleNotFoundError("No module named 'numpi'", name="numpi")

    monkeypatch.setattr(contract.importlib, "import_module", broken)
    with pytest.raises(ModuleNotFoundError, match="numpi"):
        contract.sources(tiny.chapter)


def test_a_name_that_another_chapter_has_is_refused_with_both_places(tiny):
    taken = replace(tiny.sources(tiny.chapter), elsewhere={"quadruple": "chapters/ch44_gae.md:512"})
    with pytest.raises(
        ChapterError, match=r"ch99_tiny.md:\d+: the exercise quadruple is at chapters/ch44_gae.md:512, too; .*choose"
    ):
        assemble.verify(tiny.chapter, taken)


def test_the_names_of_all_other_chapters_are_known():
    known = contract.sources(chapter.load("ch44")).elsewhere
    assert known["clip_fraction"].startswith("chapters/ch43_ppo_intuition.md:") and "compute_gae" not in known
    names = [one.name for one in checks.all_exercises()]
    assert len(names) == len(set(names))
