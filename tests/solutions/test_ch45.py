"""PPO by hand-sized numbers, time limits all the way through, and one seed that decides everything."""

import copy
import math

import numpy as np
import pytest
import torch

from course_lib.control.envs import ChainVectorEnv, HoverVectorEnv, TimerVectorEnv, make
from course_lib.control.policies import Adam, make_policy
from course_lib.control.ppo import Batch, PPOSettings
from solutions import ch45
from solutions.ch43 import approx_kl, clip_fraction, clipped_surrogate_loss
from solutions.ch44 import compute_gae
from solutions.ch45 import (
    collect_rollout,
    evaluate_actions,
    fast_ppo_update,
    gaussian_entropy,
    gaussian_log_prob,
    minibatches,
    ppo_loss,
    ppo_update,
    torch_ppo_steps,
    train_ppo,
)

HALF_LOG_2PI = 0.9189385


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def constant_policy(value, log_std=0.0):
    """Mean action 0 everywhere, and one value for all states."""
    policy = make_policy(1, 1, hidden=2, log_std=log_std)
    for name, tensor in policy.tensors().items():
        if name.endswith("weight"):
            tensor.zero_()
    policy.tensors()["critic.out.bias"].fill_(value)
    return policy


def random_batch(policy, size=100, seed=0):
    """Steps of a policy that has changed a little since it acted."""
    generator = seeded(seed)
    obs = torch.randn(size, policy.obs_dim, generator=generator)
    actions = policy.act(obs, generator)
    log_probs = evaluate_actions(policy, obs, actions)[0].detach()
    noise = torch.randn(3, size, generator=generator)
    return Batch(obs, actions, log_probs + 0.3 * noise[0], noise[1], 5 * noise[2])


def test_log_prob_of_a_standard_normal_and_of_a_narrow_one():
    mean, actions = torch.tensor([[0.0, 0.0], [1.0, -1.0]]), torch.tensor([[0.0, 0.0], [2.0, -3.0]])
    expected = torch.tensor([0.0, -0.5 - 2.0]) - 2 * HALF_LOG_2PI
    torch.testing.assert_close(gaussian_log_prob(mean, torch.zeros(2), actions), expected)
    narrow = torch.tensor([0.5, 0.25]).log()
    expected = torch.tensor([0.0, -2.0 - 32.0]) + math.log(8) - 2 * HALF_LOG_2PI
    torch.testing.assert_close(gaussian_log_prob(mean, narrow, actions), expected)
    torch.testing.assert_close(gaussian_log_prob(mean, narrow.expand(2, 2), actions), expected)


def test_log_prob_agrees_with_pytorchs_distribution_and_gives_actions_no_gradient():
    mean, log_std, actions = (torch.randn(5, 3, generator=seeded(i), requires_grad=True) for i in range(3))
    result = gaussian_log_prob(mean, log_std, actions)
    torch.testing.assert_close(result, torch.distributions.Normal(mean, log_std.exp()).log_prob(actions).sum(-1))
    result.sum().backward()
    assert mean.grad is not None and log_std.grad is not None and actions.grad is None


def test_entropy_of_a_standard_normal_and_per_state():
    assert gaussian_entropy(torch.zeros(2)).item() == pytest.approx(2 * (0.5 + HALF_LOG_2PI))
    per_state = gaussian_entropy(torch.tensor([[0.0, 0.0], [math.log(2), 0.0]]))
    torch.testing.assert_close(per_state[1] - per_state[0], torch.tensor(math.log(2)))


@pytest.mark.parametrize(("shape", "named"), [((4, 3), "actions"), ((3,), "log_std"), ((4, 1), "log_std")])
def test_shapes_that_do_not_fit_are_named(shape, named):
    mean = torch.zeros(4, 2)
    arguments = {"log_std": torch.zeros(2), "actions": torch.zeros(4, 2), named: torch.zeros(shape)}
    with pytest.raises(ValueError, match=named):
        gaussian_log_prob(mean, **arguments)


def test_minibatches_visit_every_index_once_in_an_order_of_the_generator():
    epochs = [list(minibatches(10, 4, generator)) for generator in (seeded(0), seeded(0), seeded(1))]
    assert [len(indices) for indices in epochs[0]] == [4, 4, 2]
    orders = [torch.cat(epoch) for epoch in epochs]
    assert orders[0].dtype == torch.int64 and orders[0].sort().values.tolist() == list(range(10))
    assert torch.equal(orders[0], orders[1]) and not torch.equal(orders[0], orders[2])
    generator = seeded(0)
    assert not torch.equal(*(torch.cat(list(minibatches(10, 4, generator))) for _ in range(2)))


@pytest.mark.parametrize(("sizes", "named"), [((0, 4), "batch_size"), ((4, 0), "minibatch_size")])
def test_sizes_below_one_are_named(sizes, named):
    with pytest.raises(ValueError, match=rf"\b{named} must be at least 1, got 0"):
        minibatches(*sizes, seeded())


def test_loss_of_two_samples_by_hand():
    """Ratios 1.5 and 0.5; the first is clipped at 1.2, the second, whose advantage is negative, at 0.8."""
    log_probs, advantages = torch.tensor([1.5, 0.5]).log(), torch.tensor([2.0, -1.0])
    values, returns = torch.tensor([1.0, 3.0]), torch.tensor([2.0, 0.0])
    loss, metrics = ppo_loss(log_probs, torch.zeros(2), advantages, values, returns, torch.tensor(0.7), 0.2, 0.5, 0.1)
    assert metrics["policy_loss"].item() == pytest.approx(-(2.4 - 0.8) / 2)
    assert metrics["value_loss"].item() == pytest.approx((1 + 9) / 2)
    assert metrics["entropy"].item() == pytest.approx(0.7) and metrics["clip_fraction"].item() == 1
    assert metrics["approx_kl"].item() == pytest.approx((0.5 - math.log(1.5) - 0.5 - math.log(0.5)) / 2)
    assert loss.item() == pytest.approx(-0.8 + 2.5 - 0.07)


def test_loss_is_the_sum_of_what_chapter_43_taught_and_no_gradient_strays():
    names = ("log_probs", "old_log_probs", "advantages", "values", "returns", "entropy")
    given = {name: (0.3 * torch.randn(50, generator=seeded(i))).requires_grad_() for i, name in enumerate(names)}
    loss, metrics = ppo_loss(**given, clip_range=0.2, vf_coef=0.5, ent_coef=0.01)
    pair = given["log_probs"], given["old_log_probs"]
    expected = clipped_surrogate_loss(*pair, given["advantages"], 0.2)
    expected = expected + 0.5 * (given["values"] - given["returns"]).square().mean() - 0.01 * given["entropy"].mean()
    torch.testing.assert_close(loss, expected)
    torch.testing.assert_close(metrics["approx_kl"], approx_kl(*pair))
    torch.testing.assert_close(metrics["clip_fraction"], clip_fraction(*pair, 0.2))
    loss.backward()
    assert {name for name in names if given[name].grad is not None} == {"log_probs", "values", "entropy"}
    assert not any(metric.requires_grad or metric.dim() for metric in metrics.values())


def test_loss_refuses_shapes_that_would_broadcast_and_negative_clips():
    column = torch.zeros(4)
    for position in range(6):
        arguments = [column] * 6
        arguments[position] = torch.zeros(4, 1)
        with pytest.raises(ValueError, match="shape"):
            ppo_loss(*arguments, 0.2, 0.5, 0.0)
    with pytest.raises(ValueError, match=r"clip_range.*-0\.1"):
        ppo_loss(*[column] * 6, -0.1, 0.5, 0.0)


def test_three_ways_to_treat_an_end_give_three_different_sums_of_advantages():
    """A reward of 1 for ever is worth 1 / (1 - 0.9) = 10, which is what the critic says everywhere: no advantage but at a true end.

    There V = 10 is 9 too much after the last reward; with λ = 1 the steps before are blamed for it by γ each.
    """
    envs, policy = TimerVectorEnv(lengths=(3, 3), terminates=(True, False)), constant_policy(10.0)
    rollout = collect_rollout(envs, policy, 3, envs.reset(seed=0)[0], seeded())
    values, next_values = policy.value(rollout.obs), policy.value(rollout.next_obs)

    def total(terminated, truncated):
        return compute_gae(rollout.rewards, values, next_values, terminated, truncated, 0.9, 1.0).sum(0).tolist()

    never, ended = torch.zeros_like(rollout.terminated), rollout.terminated | rollout.truncated
    blame = -9 * (1 + 0.9 + 0.81)
    assert total(rollout.terminated, rollout.truncated) == pytest.approx([blame, 0.0], abs=1e-4)
    assert total(ended, never) == pytest.approx([blame, blame], abs=1e-4)
    assert total(never, never) == pytest.approx([0.0, 0.0], abs=1e-4)


def test_rollout_has_the_true_successors_and_goes_on_where_the_last_one_stopped():
    envs, policy, generator = TimerVectorEnv(lengths=(3, 4), terminates=(True, False)), constant_policy(0.0), seeded()
    first = collect_rollout(envs, policy, 4, envs.reset(seed=0)[0], generator)
    assert first.obs[..., 0].tolist() == [[0, 0], [1, 1], [2, 2], [0, 3]]
    assert first.next_obs[..., 0].tolist() == [[1, 1], [2, 2], [3, 3], [1, 4]]
    assert first.terminated.tolist() == [[False, False]] * 2 + [[True, False], [False, False]]
    assert first.truncated.tolist() == [[False, False]] * 3 + [[False, True]]
    assert first.last_obs.tolist() == [[1], [0]]
    second = collect_rollout(envs, policy, 1, first.last_obs, generator)
    assert torch.equal(second.obs[0], first.last_obs) and not torch.equal(second.actions[0], first.actions[0])


def test_environments_get_clipped_actions_and_the_rollout_keeps_the_sampled_ones():
    envs = TimerVectorEnv(action_reward=1.0)
    rollout = collect_rollout(envs, constant_policy(0.0, log_std=1.0), 50, envs.reset(seed=0)[0], seeded())
    assert rollout.actions.abs().max() > 2
    torch.testing.assert_close(rollout.rewards, 1 + rollout.actions.clamp(-1, 1).squeeze(-1))
    assert rollout.rewards.dtype == torch.float32 and rollout.actions.shape == (50, 2, 1)


def test_rollout_of_discrete_actions_and_refusal_of_next_step_autoreset():
    envs = ChainVectorEnv(num_envs=3)
    rollout = collect_rollout(envs, make_policy(1, 2, discrete=True), 5, envs.reset(seed=0)[0], seeded())
    assert rollout.actions.dtype == torch.int64 and rollout.actions.shape == (5, 3)
    envs.metadata = {}
    with pytest.raises(ValueError, match="same-step autoreset"):
        collect_rollout(envs, make_policy(1, 2, discrete=True), 5, rollout.last_obs, seeded())


def test_update_on_the_full_batch_is_one_step_of_adam_on_the_loss():
    policy = make_policy(3, 2, hidden=4, seed=1)
    batch, reference = random_batch(policy), copy.deepcopy(policy)
    settings = PPOSettings(num_epochs=1, minibatch_size=len(batch), learning_rate=1e-2)
    metrics = ppo_update(policy, Adam(1e-2), batch, settings, seeded())

    log_probs, entropy, values = evaluate_actions(reference, batch.obs, batch.actions)
    loss, expected = ppo_loss(log_probs, batch.old_log_probs, batch.advantages, values, batch.returns, entropy, 0.2, 0.5, 0.01)
    loss.backward()
    torch.nn.utils.clip_grad_norm_([reference.weights], 0.5)
    torch.optim.Adam([reference.weights], lr=1e-2, eps=1e-5).step()
    torch.testing.assert_close(policy.weights, reference.weights)
    torch.testing.assert_close(metrics, expected)


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize(
    ("changes", "steps"),
    [({}, 16), ({"clip_range": math.inf}, 16), ({"target_kl": 0.0}, 8), ({"ent_coef": 1.0, "minibatch_size": 100}, 4)],
)
def test_the_fast_update_is_the_plain_one(discrete, changes, steps):
    settings = PPOSettings(num_epochs=2, minibatch_size=32).but(**changes)
    plain, fast = (make_policy(3, 2, discrete, hidden=8, log_std=-0.3, seed=1) for _ in range(2))
    batch, optimizers = random_batch(plain), (Adam(1e-2), Adam(1e-2))
    for seed in range(2):  # the second time with an optimiser that has a past
        expected = ppo_update(plain, optimizers[0], batch, settings, seeded(seed))
        metrics = fast_ppo_update(fast, optimizers[1], batch, settings, seeded(seed))
        torch.testing.assert_close(metrics, expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(fast.weights.grad, plain.weights.grad, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(fast.weights, plain.weights, rtol=1e-4, atol=1e-5)
    assert optimizers[0].steps == optimizers[1].steps == steps


def test_steps_with_torchs_own_are_those_of_the_update():
    policy = make_policy(3, 2, hidden=8, log_std=-0.3, seed=1)
    batch, settings = random_batch(policy), PPOSettings(num_epochs=5, minibatch_size=10_000, learning_rate=1e-2)
    before = policy.weights.detach().clone()
    losses, weights = torch_ppo_steps(policy.tensors(), batch, settings, num_steps=5)
    assert torch.equal(policy.weights, before) and losses.shape == (5,)
    metrics = ppo_update(policy, Adam(1e-2), batch, settings, seeded())
    torch.testing.assert_close(weights, policy.tensors(), rtol=1e-4, atol=1e-5)
    total = metrics["policy_loss"] + 0.5 * metrics["value_loss"] - 0.01 * metrics["entropy"]
    torch.testing.assert_close(losses.mean(), total, rtol=1e-4, atol=1e-5)


SMALL = PPOSettings(total_steps=1024, num_steps=32, minibatch_size=64, learning_rate=3e-3, gamma=0.9, gae_lambda=0.9, hidden=16)


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.parametrize("update", [ppo_update, fast_ppo_update])
def test_two_runs_with_one_seed_are_equal_bit_for_bit(name, update):
    weights, logs = [], []
    for seed in (0, 0, 1):
        rows = []
        settings = SMALL.but(total_steps=512, normalize_obs=True, anneal=True)
        weights.append(train_ppo(make(name, 4), settings, seed, log=rows.append, update=update).weights)
        logs.append([{key: value for key, value in row.items() if key != "seconds"} for row in rows])
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])
    assert repr(logs[0]) == repr(logs[1]) != repr(logs[2])
    assert [row["env_steps"] for row in logs[0]] == [128, 256, 384, 512]


def test_training_learns_what_pays_and_reports_it():
    rows = []
    envs = TimerVectorEnv(lengths=(8,) * 4, terminates=(False,) * 4, action_reward=1.0)
    policy = train_ppo(envs, SMALL.but(total_steps=4096), log=rows.append)
    assert rows[-1]["mean_return"] > rows[0]["mean_return"] + 2
    assert policy.best_action(torch.zeros(1, 1)).item() > 0.5
    assert rows[-1]["explained_variance"] <= 1 and rows[0]["episodes"] == 16
    assert {"policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction", "seconds"} <= rows[0].keys()


def test_a_reward_of_ones_own_is_learned_from_while_the_environments_is_reported():
    rows, shapes = [], []

    def reward(obs, actions, next_obs):
        shapes.append((obs.shape, actions.shape, next_obs.shape))
        return -actions.clamp(-1, 1).squeeze(-1)

    envs = TimerVectorEnv(lengths=(8,) * 4, terminates=(False,) * 4, action_reward=1.0)
    policy = make_policy(1, 1, hidden=16)
    assert train_ppo(envs, SMALL.but(total_steps=4096), policy=policy, reward=reward, log=rows.append) is policy
    assert rows[-1]["mean_return"] < rows[0]["mean_return"] - 2
    assert shapes[0] == ((32, 4, 1),) * 3


def test_advantages_are_normalised_unless_told_otherwise():
    envs, policy = TimerVectorEnv(), constant_policy(10.0)
    rollout = collect_rollout(envs, policy, 6, envs.reset(seed=0)[0], seeded())
    settings = PPOSettings(gamma=0.9, gae_lambda=1.0, reward_scale=2.0)
    normalised = ch45.estimate(policy, rollout, settings)[0].advantages
    assert normalised.mean().item() == pytest.approx(0, abs=1e-6) and normalised.std().item() == pytest.approx(1, abs=1e-5)
    batch, explained = ch45.estimate(policy, rollout, settings.but(normalize_advantages=False))
    torch.testing.assert_close(batch.returns - 10, batch.advantages)
    assert batch.returns.view(6, 2)[2].tolist() == pytest.approx([2.0, 2 + 9]) and explained.item() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("copy", [True, False])
def test_the_repaired_rollout_keeps_what_the_policy_saw(copy):
    envs, policy = HoverVectorEnv(num_envs=3, time_limit=4, copy=copy), make_policy(2, 1, hidden=4)
    start = envs.reset(seed=0)[0].copy()
    rollout = ch45.repaired_rollout(envs, policy, 10, envs.observe(), seeded())
    goes_on = ~(rollout.terminated | rollout.truncated)[:-1]
    assert torch.equal(rollout.obs[0], torch.from_numpy(start))
    assert torch.equal(rollout.obs[1:][goes_on], rollout.next_obs[:-1][goes_on])
    assert (rollout.obs != rollout.next_obs).any(-1).all()
    before = rollout.last_obs.clone()
    envs.step(np.ones((3, 1)))
    assert torch.equal(rollout.last_obs, before)
