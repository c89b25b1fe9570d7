"""What checks say of libraries is what the atlas has recorded of them."""

import pytest

from autograder import checks
from autograder.authoring import freeze, wild
from experiments.atlas import keeping


def row(library, rule, setting="", note="", formula="gae"):
    rows = [{"formula": formula, "numbers": [1.0], "equal": not rule, "rule": rule, "setting": setting, "note": note}]
    return {"versions": {library: "1.0"}, "rows": rows}


@pytest.fixture
def records(monkeypatch):
    known: dict = {}
    monkeypatch.setattr(wild, "_records", lambda: known)
    return known


def test_libraries_are_named_with_their_versions(records):
    records |= {"a": row("a", "leaks"), "b": row("b", "leaks"), "c": row("c", "leaks", "x=1, the default"), "d": row("d", "")}
    assert wild.also("leaks", "gae") == " In the wild, this is the rule of a 1.0, b 1.0 and c 1.0."
    assert wild.also("", "gae", what="“right” is") == " In the wild, “right” is the rule of d 1.0."


def test_who_has_to_be_asked_for_it_is_named_with_the_setting_and_only_where_nobody_does_it_unasked(records):
    records |= {"a": row("a", "leaks", "x=2")}
    assert wild.also("leaks", "gae") == " In the wild, this is the rule of a 1.0 (x=2)."
    records |= {"b": row("b", "leaks")}
    assert wild.also("leaks", "gae") == " In the wild, this is the rule of b 1.0."


def test_nothing_is_said_of_rules_that_nobody_follows_without_reservation(records):
    records |= {"a": row("a", "leaks", note="Its collector repairs it."), "b": row("b", "stops", formula="other")}
    records["c"] = row("c", "unknown")
    records["c"]["rows"][0]["rule"] = ""  # not equal, by no rule that is known
    assert wild.also("leaks", "gae") == wild.also("stops", "gae") == wild.also("", "gae") == ""


@pytest.mark.parametrize(
    ("assignment", "exercise", "misconception", "formula", "rule"),
    [
        ("ch43", "approx_kl", "log-ratio-estimator", "approx_kl", "k1"),
        ("ch44", "compute_gae", "truncated-treated-as-terminated", "gae", "truncation_as_end"),
        ("ch44", "repaired_targets", "truncated-treated-as-terminated", "gae", "truncation_as_end"),
        ("ch47", "temperature_loss", "log-alpha-taken-as-alpha", "temperature_loss", "log_alpha"),
        ("ch95", "masked_whiten", "row-by-row", "whitened", "by_row"),
        ("ch95", "ppo_token_loss", "mean-of-row-means", "token_policy_loss", "row_means"),
        ("ch97", "dpo_loss", "smoothing-ignored", "dpo_loss_smoothed_mean", "ignored"),
        ("ch102", "clip_fraction_as", "outside-by-either-rule", "token_clip_fraction", "silenced"),
        ("ch102", "which_diagnostics", "k1-never-negative", "approx_kl", "k1"),
        ("ch102", "gae_as", "always-termination", "gae", "truncation_as_end"),
        ("ch102", "gae_as", "termination-taken-for-leak", "gae", "truncation_ignored"),
        ("ch102", "repaired_bootstrap", "future-counted-twice", "stored_reward", ""),
    ],
)
def test_what_a_learner_reads_names_a_library_of_the_records(assignment, exercise, misconception, formula, rule):
    said = next(one for one in checks.exercises(assignment) if one.name == exercise)
    message = next(one.message for one in said.misconceptions if one.name == misconception)
    followers = [
        f"{name} {version}"
        for record in keeping.load_all().values()
        for name, version in record["versions"].items()
        if any(row["formula"] == formula and row["rule"] == rule for row in record["rows"])
    ]
    told = message.partition(" In the wild, ")[2]
    assert any(follower in told for follower in followers)


def test_the_names_are_in_the_checks_that_learners_get():
    gae = next(one for one in checks.exercises("ch44") if one.name == "compute_gae")
    message = freeze.visible(gae).messages["truncated-treated-as-terminated"]
    assert message.startswith("A time limit does not end the task: bootstrap from next_values there. Only terminated removes")
    assert "cleanrl" in message
