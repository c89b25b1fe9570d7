"""The references against hand-sized cases and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from course_lib.control.demonstrations import Clone, SquaredError
from course_lib.control.road import LinearPolicy, RoadDriver, RoadEnv
from solutions.ch74 import (
    behavioural_cloning_loss,
    collect_demonstrations,
    dagger_round,
    evaluate,
    gaussian_cloning_loss,
    repaired_pairs,
    split_by_episode,
    state_shift,
    train_bc,
)

STRAIGHT_ON = LinearPolicy(torch.zeros(1, 5), torch.zeros(1))
HARD_LEFT = LinearPolicy(torch.zeros(1, 5), torch.full((1,), -5.0))
CALM = {"gust": 0.0, "bend": 0.0}


def column(*numbers):
    return torch.tensor(numbers, dtype=torch.float64).unsqueeze(-1)


def test_on_a_straight_calm_road_straight_on_earns_what_the_start_is_worth():
    env = RoadEnv(time_limit=10, **CALM)
    returns = evaluate(STRAIGHT_ON, env, 3, seed=5)
    for k, value in enumerate(returns.tolist()):
        start = env.reset(seed=5 + k)[0][0]
        assert value == pytest.approx(10 * (1 - start**2), rel=1e-5)


def test_an_episode_ends_off_the_road_and_its_last_step_is_written_down():
    shown = collect_demonstrations(HARD_LEFT, RoadEnv(time_limit=None, **CALM), 2, seed=0)
    lengths = shown.episode_ids.bincount()
    assert len(shown.obs) == lengths.sum() and (lengths > 3).all() and (lengths < 30).all()
    assert (shown.obs[:, 0].abs() <= 1).all()  # what came after the last action is nobody's observation
    assert (shown.actions == -5).all()  # as the policy said it, not as the wheel did it


def test_each_row_is_what_the_policy_saw():
    seen = []

    def policy(obs):
        assert obs.shape == (1, 5) and obs.dtype == torch.float32
        seen.append(obs.clone())
        return RoadDriver()(obs)

    shown = collect_demonstrations(policy, RoadEnv(time_limit=7), 3, seed=1)
    assert torch.equal(shown.obs, torch.cat(seen)) and torch.equal(shown.actions, RoadDriver()(shown.obs))
    assert shown.episode_ids.tolist() == [0] * 7 + [1] * 7 + [2] * 7
    assert torch.equal(shown.returns, evaluate(RoadDriver(), RoadEnv(time_limit=7), 3, seed=1))


def test_any_episode_can_be_flown_again_alone():
    three = collect_demonstrations(RoadDriver(), RoadEnv(time_limit=5), 3, seed=40)
    alone = collect_demonstrations(RoadDriver(), RoadEnv(time_limit=5), 1, seed=42)
    assert torch.equal(three.obs[three.episode_ids == 2], alone.obs) and three.returns[2] == alone.returns[0]


def test_demonstrations_survive_an_environment_that_reuses_its_array():
    class Reusing(RoadEnv):
        def _observe(self):
            self.array = getattr(self, "array", None)
            fresh = super()._observe()
            if self.array is None:
                self.array = fresh
            self.array[:] = fresh
            return self.array

    given = RoadDriver(), 2, 3
    right, reused = (collect_demonstrations(given[0], env(time_limit=6), *given[1:]) for env in (RoadEnv, Reusing))
    assert torch.equal(right.obs, reused.obs)


def test_types_are_those_of_the_contract_and_carry_no_graph():
    for policy, env, dtype, shape in (
        (STRAIGHT_ON, RoadEnv(time_limit=3), torch.float32, (3, 1)),
        (LinearPolicy(torch.zeros(3, 5), torch.zeros(3), discrete=True), RoadEnv(time_limit=3, discrete=True), torch.int64, (3,)),
    ):
        shown = collect_demonstrations(policy, env, 1, seed=0)
        assert shown.actions.dtype == dtype and shown.actions.shape == shape and not shown.actions.requires_grad
        assert (shown.obs.dtype, shown.episode_ids.dtype, shown.returns.dtype) == (torch.float32, torch.int64, torch.float32)


@pytest.mark.parametrize(("episodes", "fraction", "held"), [(10, 0.2, 2), (3, 0.1, 1), (3, 1.0, 2), (2, 0.5, 1), (7, 0.0, 1)])
def test_the_split_holds_out_whole_episodes_and_leaves_one_on_either_side(episodes, fraction, held):
    ids = (17 * torch.arange(episodes) - 3).repeat_interleave(4)
    train, held_out = split_by_episode(ids, fraction, torch.Generator().manual_seed(0))
    assert torch.equal(train, ~held_out) and len(ids[held_out].unique()) == held
    assert not set(ids[train].tolist()) & set(ids[held_out].tolist())


def test_the_split_is_drawn_from_the_generator_and_every_episode_has_its_turn():
    ids = torch.arange(10).repeat_interleave(2)
    first, again = (split_by_episode(ids, 0.3, torch.Generator().manual_seed(4))[1] for _ in range(2))
    assert torch.equal(first, again)
    generator = torch.Generator().manual_seed(0)
    counts = sum(split_by_episode(ids, 0.3, generator)[1].long() for _ in range(400))
    assert counts.sum() == 400 * 6 and (counts - 120).abs().max() < 40  # binomial: deviation 9


def test_cross_entropy_by_hand():
    logits = torch.tensor([[0.0, 0.0], [math.log(3), 0.0]], dtype=torch.float64)
    assert behavioural_cloning_loss(logits, torch.tensor([0, 1])).item() == pytest.approx((math.log(2) + math.log(4)) / 2)
    assert behavioural_cloning_loss(torch.tensor([[1000.0, 0.0]]), torch.tensor([1])).item() == pytest.approx(1000)


def test_normal_loss_by_hand():
    loss = gaussian_cloning_loss(torch.tensor([[0.0, 1.0]]), torch.tensor([0.0, math.log(2)]), torch.tensor([[1.0, 5.0]]))
    assert loss.item() == pytest.approx(0.5 + 2.0 + math.log(2) + math.log(2 * math.pi))


def test_the_best_sigma_is_the_root_mean_square_residual():
    mean, actions = torch.zeros(4, 1), torch.tensor([[1.0], [-1.0], [3.0], [-3.0]])
    log_std = torch.tensor([math.log(5) / 2], requires_grad=True)
    (gradient,) = torch.autograd.grad(gaussian_cloning_loss(mean, log_std, actions), log_std)
    assert gradient.item() == pytest.approx(0, abs=1e-6)


def test_gradient_reaches_the_policy_and_not_the_expert():
    mean, log_std, actions = (torch.rand(3, 2, requires_grad=True) for _ in range(3))
    reached = torch.autograd.grad(gaussian_cloning_loss(mean, log_std, actions), [mean, log_std, actions], allow_unused=True)
    assert [gradient is not None for gradient in reached] == [True, True, False]


def test_training_finds_the_least_squares_line():
    obs = torch.randn(200, 2, generator=torch.Generator().manual_seed(0))
    line = LinearPolicy(torch.zeros(1, 2), torch.zeros(1))
    losses = train_bc(line, SquaredError(), obs, obs @ torch.tensor([[2.0], [-1.0]]) + 0.5, 400, 50, 0.05)
    assert line.weights[0].tolist() == pytest.approx([2, -1], abs=0.02) and line.bias.item() == pytest.approx(0.5, abs=0.02)
    assert losses.shape == (400,) and losses[-1] < 1e-3 < losses[0] and not losses.requires_grad


def test_training_is_repeated_by_its_seed():
    def trained():
        obs = torch.randn(60, 3, generator=torch.Generator().manual_seed(1))
        torch.manual_seed(0)
        clone = Clone(obs, 1)
        generator = torch.Generator().manual_seed(2)
        return train_bc(clone, lambda out, a: gaussian_cloning_loss(*out, a), obs, obs[:, :1], 20, 16, generator=generator)

    assert torch.equal(trained(), trained())


def test_a_clone_scales_its_inputs_by_what_it_was_made_with():
    obs = torch.tensor([[0.0, 7.0], [2.0, 7.0]])
    clone = Clone(obs, 3)
    mean, log_std = clone(obs[:1] * 5)
    assert mean.shape == (1, 3) and log_std.tolist() == [0, 0, 0] and clone.obs_std.tolist() == [pytest.approx(math.sqrt(2)), 1]
    assert torch.equal(clone.act(obs[:1] * 5), mean)


def test_energy_distance_by_hand():
    # σ = √2: X = {0, √2}, Y = {2√2}: 2 · 1.5 √2 - √2 / 2 - 0
    assert state_shift(column(0, 2), column(4)).item() == pytest.approx(2.5 * math.sqrt(2))


def test_the_shift_is_zero_for_equal_samples_and_knows_no_units():
    x = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    y = x * 1.5 + 1
    assert state_shift(x, x.flip(0)).item() == pytest.approx(0, abs=1e-12)
    units = torch.tensor([1.0, 1000.0, 1e-3], dtype=torch.float64)
    assert state_shift(x * units + 5, y * units + 5).item() == pytest.approx(state_shift(x, y).item())


def test_the_shift_is_twice_the_area_between_squared_distribution_functions():
    x, y = column(0, 0, 3, 1), column(1, 2, 2)
    scale = x.std().item()
    grid = torch.linspace(-1, 4, 500_001, dtype=torch.float64) / scale
    f, g = ((sample / scale <= grid).double().mean(0) for sample in (x, y))
    area = (f - g).square().mean().item() * 5 / scale
    assert state_shift(x, y).item() == pytest.approx(2 * area, rel=1e-3)


def test_samples_of_more_than_one_block_and_far_from_zero():
    x = torch.arange(2500.0).unsqueeze(-1) + 1e5
    assert state_shift(x, x[:1200]).item() == pytest.approx(state_shift(x.double(), x[:1200].double()).item(), rel=1e-4)


def test_repaired_pairs_by_hand():
    obs, actions, ids = torch.arange(6.0)[:, None], torch.arange(6.0)[:, None] + 10, torch.tensor([4, 4, 4, 1, 9, 9])
    paired = repaired_pairs(obs, actions, ids)
    assert [one.flatten().tolist() for one in paired] == [[0, 1, 4], [11, 12, 15]]


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda: collect_demonstrations(STRAIGHT_ON, RoadEnv(), 0, 0), "num_episodes must be at least 1, got 0"),
        (lambda: evaluate(STRAIGHT_ON, RoadEnv(), -1, 0), "num_episodes must be at least 1, got -1"),
        (lambda: split_by_episode(torch.arange(4), 1.2, None), r"fraction must lie in \[0, 1\], got 1.2"),
        (lambda: split_by_episode(torch.zeros(4), 0.2, None), "episode_ids must name at least two"),
        (lambda: behavioural_cloning_loss(torch.zeros(2, 3), torch.zeros(2, 1).long()), r"expert_actions.*\(2, 1\)"),
        (lambda: behavioural_cloning_loss(torch.zeros(3), torch.zeros(3).long()), r"logits.*\(3,\)"),
        (lambda: gaussian_cloning_loss(torch.zeros(2, 3), torch.zeros(3), torch.zeros(2, 1)), "expert_actions"),
        (lambda: gaussian_cloning_loss(torch.zeros(2, 3), torch.zeros(2), torch.zeros(2, 3)), "log_std"),
        (lambda: train_bc(STRAIGHT_ON, SquaredError(), torch.zeros(3, 5), torch.zeros(2, 1)), "obs, actions"),
        (lambda: train_bc(STRAIGHT_ON, SquaredError(), torch.zeros(3, 5), torch.zeros(3, 1), 0), "num_steps"),
        (lambda: state_shift(torch.zeros(3, 2), torch.zeros(3, 1)), r"agent_obs.*\(3, 1\)"),
        (lambda: state_shift(torch.zeros(3), torch.zeros(3)), "expert_obs"),
        (lambda: repaired_pairs(torch.zeros(3, 2), torch.zeros(2, 1), torch.zeros(3)), "obs, actions, episode_ids"),
    ],
)
def test_errors_name_the_argument_and_the_value_received(call, names):
    with pytest.raises(ValueError, match=names):
        call()


def test_a_round_keeps_what_was_shown_and_asks_about_every_state_of_the_clone():
    env, driver = RoadEnv(time_limit=9, gust=0.05), RoadDriver()
    shown = collect_demonstrations(driver, env, 2, seed=3)
    union = dagger_round(HARD_LEFT, driver, env, shown, 3, seed=70)
    flown, old = collect_demonstrations(HARD_LEFT, env, 3, seed=70), len(shown.obs)
    assert torch.equal(union.obs[:old], shown.obs) and torch.equal(union.actions[:old], shown.actions)
    assert torch.equal(union.obs[old:], flown.obs) and torch.equal(union.actions[old:], driver(flown.obs))
    assert union.episode_ids.unique().tolist() == [0, 1, 2, 3, 4] and len(union.returns) == 5
    assert torch.equal(union.returns[2:], evaluate(HARD_LEFT, env, 3, seed=70))


def test_where_the_driver_flies_itself_a_round_is_more_demonstrations():
    env, driver = RoadEnv(time_limit=6), RoadDriver()
    shown = collect_demonstrations(driver, env, 1, seed=0)
    union, longer = dagger_round(driver, driver, env, shown, 2, seed=1), collect_demonstrations(driver, env, 3, seed=0)
    for name in ("obs", "actions", "episode_ids", "returns"):
        assert torch.equal(getattr(union, name), getattr(longer, name))
