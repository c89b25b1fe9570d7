"""The references against hand-sized arrays and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from solutions.ch44 import compute_gae
from solutions.ch102 import clip_fraction_as, gae_as, parting_ones, repaired_bootstrap, which_diagnostics, which_gae

INF = math.inf


def row(*numbers, dtype=torch.float64):
    return torch.tensor(numbers, dtype=dtype)


def column(*numbers):
    return row(*numbers).reshape(-1, 1)


def flags(*numbers):
    return row(*numbers, dtype=torch.bool).reshape(-1, 1)


def with_ratios(*ratios):
    """Log-probabilities that give these ratios against OLD."""
    return OLD + row(*ratios).log()


OLD = row(-1, -2, -3, -700)
NO = flags(0, 0, 0)
RULES = ["textbook", "termination", "leak", "current_value", "dropped"]
HALF = {"gamma": 0.5, "gae_lambda": 0.5}
PARTS = {"rewards": column(1, 2, 3), "values": column(10, 20, 30), "last_values": row(40)}
UNBROKEN = PARTS | {"next_values": column(20, 30, 40)}
AFTER_A_LIMIT = PARTS | {"next_values": column(20, 100, 40)}


def test_silenced_are_those_whose_gradient_the_clip_takes_away_and_no_others():
    moved = with_ratios(2, 0.5, 2, 0.5)  # above, below, above, below
    for advantages, silent in (
        ((1, 1, 1, 1), 0.5),
        ((-1, -1, -1, -1), 0.5),
        ((1, -1, 1, -1), 1),
        ((-1, 1, -1, 1), 0),
        ((0,) * 4, 0),
    ):
        batch = moved, OLD, row(*advantages)
        assert clip_fraction_as("silenced", *batch) == silent and clip_fraction_as("outside", *batch) == 1
        assert clip_fraction_as("silenced", *batch, INF) == clip_fraction_as("outside", *batch, INF) == 0


def test_a_log_tells_which_rules_made_its_two_numbers():
    batch = with_ratios(2, 0.5, 2, 1), OLD, row(1, 1, -1, 1)
    k1 = -math.log(2) / 4
    k3 = 1.5 / 4 + k1  # ρ - 1 adds up to 1.5
    for kl, fraction, fits in (
        (k1, 0.75, [True, False, True, False]),
        (k3, 0.25, [False, True, False, True]),
        (k3 + 1e-6, 0.5, [False, True, False, False]),
        (k3 + 1e-3, 0.25, [False, False, False, True]),
    ):
        assert which_diagnostics(*row(kl, fraction), *batch).tolist() == fits


def test_a_policy_that_stands_still_fits_every_rule():
    assert which_diagnostics(*row(0, 0), OLD, OLD, OLD).all()


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("textbook", [1 + 0.25 * 32, 32, -7]),
        ("termination", [1 - 0.25 * 18, -18, -7]),
        ("leak", [1 + 0.25 * (-3 - 0.25 * 7), -3 - 0.25 * 7, -7]),
        ("current_value", [1 - 0.25 * 8, -8, -7]),
        ("dropped", [1 + 0.5 * 20 - 10, 0, -7]),
    ],
)
def test_rules_of_libraries_at_a_time_limit_by_hand(rule, expected):
    found = gae_as(rule, **AFTER_A_LIMIT, terminated=NO, truncated=flags(0, 1, 0), **HALF)
    assert found.flatten().tolist() == expected


def test_dropped_looks_one_step_ahead_to_the_lambda_return():
    targets = [20 - 3 - 0.25 * 7, 30 - 7, 40]
    expected = [reward + 0.5 * target - value for reward, target, value in zip((1, 2, 3), targets, (10, 20, 30), strict=True)]
    assert gae_as("dropped", **UNBROKEN, terminated=NO, truncated=NO, **HALF).flatten().tolist() == expected


def test_a_time_limit_that_is_not_seen_pays_the_first_episode_for_the_second():
    nothing, limit = torch.zeros(4, 1, dtype=torch.float64), flags(0, 1, 0, 0)
    rollout = (column(1, 1, 100, 1), nothing, nothing, nothing[0], torch.zeros_like(limit), limit, 1, 1)
    assert gae_as("leak", *rollout)[0] == 103 and gae_as("textbook", *rollout)[0] == 2


@pytest.mark.parametrize("rule", RULES)
def test_every_rule_is_linear_in_rewards_and_values_so_that_single_ones_tell_it(rule):
    generator = torch.Generator().manual_seed(0)
    ends = {"terminated": flags(0, 1, 0, 0, 0, 0), "truncated": flags(0, 1, 0, 1, 0, 0)}
    names = ("rewards", "values", "next_values")
    given = {name: torch.randn(6, 1, generator=generator, dtype=torch.float64) for name in names}
    given["last_values"] = torch.randn(1, generator=generator, dtype=torch.float64)
    total = torch.zeros(6, 1, dtype=torch.float64)
    for name, numbers in given.items():
        for at in range(len(numbers)):
            probe = {other: torch.zeros_like(x) for other, x in given.items()}
            probe[name][at] = 1
            total += numbers[at] * gae_as(rule, **probe, **ends, **HALF)
    torch.testing.assert_close(gae_as(rule, **given, **ends, **HALF), total)


def test_advantages_of_a_log_tell_which_rules_can_have_made_them():
    for rollout, truncated, expected in (
        (AFTER_A_LIMIT, flags(0, 1, 0), {"leak"}),
        (UNBROKEN, NO, set(RULES) - {"dropped"}),
    ):
        given = rollout | {"terminated": NO, "truncated": truncated, **HALF}
        logged = gae_as("leak", **given).float().double()
        assert {rule for rule, fits in zip(RULES, which_gae(logged, RULES, **given), strict=True) if fits} == expected
        assert not which_gae(logged + 0.01, RULES, **given).any()


@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        (["textbook", "termination"], {"next_values": [0, 1, 0]}),
        (["leak", "termination"], {"rewards": [0, 0, 1], "values": [0, 0, 1], "last_values": [1]}),
        (["current_value", "termination"], {"values": [0, 1, 0]}),
        (["leak", "current_value", "dropped"], {"values": [0, 1, 0]}),
        (RULES, {}),
    ],
)
def test_a_single_one_parts_rules_where_they_read_another_number(rules, expected):
    found = parting_ones(rules, NO, flags(0, 1, 0), **HALF)
    assert {name: told.int().flatten().tolist() for name, told in found.items() if told.any()} == expected


def test_what_no_rollout_can_hold_parts_nothing():
    found = parting_ones(["textbook", "leak"], NO, NO)  # both read the same successor where no episode ends
    assert not any(told.any() for told in found.values())
    assert [tuple(told.shape) for told in found.values()] == [(3, 1)] * 3 + [(1,)]


def test_one_rule_has_nothing_to_be_told_from():
    with pytest.raises(ValueError, match="rules must be two"):
        parting_ones(["leak"], NO, NO)


@pytest.mark.parametrize("rule", ["truncation", "", None])
def test_a_rule_that_is_none_is_refused_by_name(rule):
    with pytest.raises(ValueError, match=f"rule.*{rule!r}"):
        gae_as(rule, **UNBROKEN, terminated=NO, truncated=NO)
    with pytest.raises(ValueError, match=f"rule.*{rule!r}"):
        clip_fraction_as(rule, OLD, OLD, OLD)


@pytest.mark.parametrize(("terminated", "paid"), [(NO, 50), (flags(0, 1, 0), 0)])
def test_a_future_that_was_paid_into_the_reward_is_counted_once(terminated, paid):
    truncated = flags(0, 1, 0)
    rollout = [AFTER_A_LIMIT[name] for name in ("values", "next_values")]
    stored = PARTS["rewards"] + column(0, paid, 0)
    right = compute_gae(PARTS["rewards"], *rollout, terminated, truncated, **HALF)
    assert torch.equal(repaired_bootstrap(stored, *rollout, terminated, truncated, **HALF), right)
    assert torch.equal(stored, PARTS["rewards"] + column(0, paid, 0))


def test_the_time_limit_that_is_paid_for_twice_is_what_the_repair_takes_away():
    truncated = flags(0, 1, 0)
    rollout = (AFTER_A_LIMIT["values"], AFTER_A_LIMIT["next_values"], NO, truncated)
    stored = PARTS["rewards"] + column(0, 50, 0)
    twice = compute_gae(stored, *rollout, **HALF) - repaired_bootstrap(stored, *rollout, **HALF)
    assert twice.flatten().tolist() == [0.25 * 50, 50, 0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept_and_no_graph_is_carried(dtype):
    parts = {name: x.to(dtype).requires_grad_() for name, x in UNBROKEN.items()}
    old = OLD.to(dtype).requires_grad_()
    found = [clip_fraction_as(rule, old, old, old) for rule in ("outside", "silenced")]
    found += [gae_as(rule, **parts, terminated=NO, truncated=NO) for rule in RULES]
    found.append(repaired_bootstrap(parts["rewards"], parts["values"], parts["next_values"], NO, NO))
    assert all(x.dtype == dtype and not x.requires_grad for x in found)
