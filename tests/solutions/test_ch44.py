"""The references against hand-sized arrays and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from autograder.authoring import chapter
from solutions import ch44
from solutions.ch44 import (
    compute_gae,
    explained_variance,
    lambda_returns,
    normalize_advantages,
    repaired_targets,
    td_residuals,
)


def column(*numbers, dtype=torch.float64):
    return torch.tensor(numbers, dtype=dtype).reshape(-1, 1)


def flags(*numbers):
    return torch.tensor(numbers, dtype=torch.bool).reshape(-1, 1)


NO = flags(0, 0, 0)
REWARDS, VALUES, NEXT = column(1, 2, 3), column(10, 20, 30), column(20, 30, 40)


def test_residuals_by_hand():
    assert td_residuals(REWARDS, VALUES, NEXT, NO, 0.5).flatten().tolist() == [1 + 10 - 10, 2 + 15 - 20, 3 + 20 - 30]


def test_termination_removes_the_bootstrap_and_nothing_else():
    assert td_residuals(REWARDS, VALUES, NEXT, flags(0, 1, 0), 0.5).flatten().tolist() == [1, 2 - 20, -7]


def test_gae_by_hand():
    # δ = 1, -3, -7; γλ = 0.25
    expected = [1 + 0.25 * (-3 + 0.25 * -7), -3 + 0.25 * -7, -7]
    assert compute_gae(REWARDS, VALUES, NEXT, NO, NO, 0.5, 0.5).flatten().tolist() == expected


def test_truncation_bootstraps_and_stops_the_sum():
    expected = [1 + 0.25 * -3, -3, -7]
    assert compute_gae(REWARDS, VALUES, NEXT, NO, flags(0, 1, 0), 0.5, 0.5).flatten().tolist() == expected


def test_termination_wins_over_truncation_in_the_same_step():
    both = compute_gae(REWARDS, VALUES, NEXT, flags(0, 1, 0), flags(0, 1, 0), 0.5, 0.5)
    assert torch.equal(both, compute_gae(REWARDS, VALUES, NEXT, flags(0, 1, 0), NO, 0.5, 0.5))


@pytest.mark.parametrize("steps", [1, 7, 100])
def test_reward_one_for_ever_leaves_no_advantage_at_a_time_limit(steps):
    worth = torch.full((steps, 1), 1 / (1 - 0.9), dtype=torch.float64)
    cut = torch.zeros(steps, 1, dtype=torch.bool)
    cut[-1] = True
    advantages = compute_gae(torch.ones_like(worth), worth, worth, torch.zeros_like(cut), cut, 0.9, 0.95)
    assert advantages.abs().max() < 1e-12


def test_lambda_returns_add_the_values_back():
    assert lambda_returns(column(1, 2, 3), VALUES).flatten().tolist() == [11, 22, 33]


def test_normalised_advantages_have_zero_mean_and_unit_deviation():
    normalised = normalize_advantages(torch.arange(12.0, dtype=torch.float64).reshape(4, 3))
    assert abs(normalised.mean()) < 1e-12 and abs(normalised.std() - 1) < 1e-6


def test_explained_variance_of_a_perfect_a_constant_and_a_useless_critic():
    returns = column(1, 2, 3, 4)
    assert explained_variance(returns, returns) == 1
    assert explained_variance(torch.zeros_like(returns), returns) == 0
    assert explained_variance(-returns, returns) == -3
    assert math.isnan(explained_variance(returns, torch.ones_like(returns)))


def test_repaired_targets_keep_the_returns_in_units_of_reward():
    advantages, returns = repaired_targets(REWARDS, VALUES, NEXT, NO, NO, 0.5, 0.5)
    plain = compute_gae(REWARDS, VALUES, NEXT, NO, NO, 0.5, 0.5)
    assert torch.equal(returns, plain + VALUES)
    assert torch.equal(advantages, normalize_advantages(plain))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept_and_no_graph_is_carried(dtype):
    values = VALUES.to(dtype).requires_grad_()
    for result in (
        td_residuals(REWARDS.to(dtype), values, NEXT.to(dtype), NO),
        compute_gae(REWARDS.to(dtype), values, NEXT.to(dtype), NO, NO),
        lambda_returns(REWARDS.to(dtype), values),
        explained_variance(values, NEXT.to(dtype)),
    ):
        assert result.dtype == dtype and not result.requires_grad


@pytest.mark.parametrize(
    ("changes", "name"),
    [({"gamma": 1.5}, "gamma"), ({"gae_lambda": -0.1}, "gae_lambda"), ({"values": torch.zeros(3, 2)}, "values")],
)
def test_errors_name_the_argument_and_the_value_received(changes, name):
    arguments = {"rewards": REWARDS, "values": VALUES, "next_values": NEXT, "terminated": NO, "truncated": NO} | changes
    received = changes[name] if name != "values" else r"\(3, 2\)"
    with pytest.raises(ValueError, match=f"{name}.*{received}"):
        compute_gae(**arguments)


@pytest.fixture(scope="module")
def page():
    cells = [cell.source for cell in chapter.load("ch44").cells if cell.kind == "code"]
    page = dict(vars(ch44))
    for sign in ("from gymnasium.vector import", "def my_loss(", "def examine("):
        (source,) = [source for source in cells if sign in source]
        exec(source.partition("print(")[0], page)
    return page


class TestTryingTheLoss:
    """The cell of the page that says what is right about a reader's loss."""

    ANSWER = """
def my_loss(rollout, actor, critic, old_values, next_values, old_log_probs):
    ends = rollout.terminated, rollout.truncated
    advantages = compute_gae(rollout.rewards, old_values, next_values, *ends, 0.99, 0.95)
    returns = lambda_returns(advantages, old_values)
    weights = normalize_advantages(advantages)
    policy = Categorical(logits=actor(rollout.obs))
    ratio = (policy.log_prob(rollout.actions) - old_log_probs).exp()
    surrogate = torch.min(ratio * weights, ratio.clamp(0.8, 1.2) * weights).mean()
    value_loss = (critic(rollout.obs).squeeze(-1) - returns).pow(2).mean()
    return -surrogate + 0.5 * value_loss - 0.01 * policy.entropy().mean()
"""

    def said(self, page, *changes):
        answer = self.ANSWER
        for old, new in changes:
            assert answer.count(old) == 1
            answer = answer.replace(old, new)
        given = dict(page)
        exec(answer, given)
        return page["examine"](given["my_loss"])

    def test_the_page_begins_without_a_loss(self, page):
        assert page["examine"](page["my_loss"]) == "my_loss gives nothing yet"

    def test_the_right_loss_is_right_in_all(self, page):
        said = self.said(page)
        assert said.count(": right") == 2 and "perhaps" not in said

    @pytest.mark.parametrize(
        ("old", "new", "why"),
        [
            ("weights = normalize_advantages(advantages)", "weights = advantages", "weights are not normalised"),
            ("lambda_returns(advantages", "lambda_returns(normalize_advantages(advantages)", "targets are made of normalised"),
            ("ratio.clamp(0.8, 1.2)", "ratio", "ratio is not clipped"),
            ("0.5 * value_loss", "value_loss", "the half"),
            ("- 0.01", "+ 0.01", "entropy has the wrong sign"),
        ],
    )
    def test_a_mistake_is_named(self, page, old, new, why):
        assert why in self.said(page, (old, new))

    def test_a_graph_on_the_targets_is_a_wrong_gradient_of_the_critic_alone(self, page):
        graph = (
            "returns = lambda_returns(advantages, old_values) + (critic(rollout.obs) - critic(rollout.obs).detach()).squeeze(-1)"
        )
        said = self.said(page, ("returns = lambda_returns(advantages, old_values)", graph))
        assert "actor: right" in said and "critic: not right" in said and "perhaps" not in said
