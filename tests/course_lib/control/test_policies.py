"""Networks whose written-out gradients are the true ones, an Adam that is Adam, and files that come back as they were."""

import copy
import math

import numpy as np
import pytest
import safetensors.torch
import torch

from course_lib.control.envs import ChainVectorEnv, TimerVectorEnv
from course_lib.control.policies import (
    LANDER,
    LANDER_SHAPES,
    Adam,
    Categorical,
    Gaussian,
    load_policy,
    make_policy,
    policy_for,
    save_policy,
    tensor_shapes,
)

OBS = torch.randn(7, 3, generator=torch.Generator().manual_seed(0))


def some_policy(discrete=False, obs_dim=3, action_dim=2):
    """A policy in the middle of its training: no parameter is zero, and observations are scaled."""
    policy = make_policy(obs_dim, action_dim, discrete, hidden=5, seed=1)
    policy.weights.data += 0.3 * torch.randn(policy.weights.shape, generator=torch.Generator().manual_seed(2))
    policy.obs_mean += torch.linspace(-1, 1, obs_dim)
    policy.obs_std *= torch.linspace(0.5, 2, obs_dim)
    return policy


def by_torch(policy, obs):
    """(outputs of the actor, log_std or None, values) by ordinary PyTorch operations, and the leaves they came from."""
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in policy.tensors().items()}
    outputs = []
    for network in ("actor", "critic"):
        x = (obs - policy.obs_mean) / policy.obs_std
        for layer in ("0", "1", "out"):
            x = x @ leaves[f"{network}.{layer}.weight"] + leaves[f"{network}.{layer}.bias"]
            x = x if layer == "out" else x.tanh()
        outputs.append(x)
    return outputs[0], leaves.get("log_std"), outputs[1].squeeze(-1), leaves


@pytest.mark.parametrize("discrete", [False, True])
def test_outputs_and_gradient_are_those_of_ordinary_operations(discrete):
    policy = some_policy(discrete)
    outputs, log_std, values, leaves = by_torch(policy, OBS)
    distribution, own_values = policy(OBS)
    torch.testing.assert_close(distribution[0], outputs)
    torch.testing.assert_close(own_values, values)

    def some_loss(outputs, log_std, values):
        return outputs.sin().sum() + values.pow(3).mean() + (0 if log_std is None else log_std.exp().sum())

    some_loss(outputs, log_std, values).backward()
    some_loss(distribution[0], None if discrete else distribution.log_std, own_values).backward()
    expected = torch.cat([leaf.grad.flatten() for leaf in leaves.values()])
    torch.testing.assert_close(policy.weights.grad, expected)


def test_a_policy_called_twice_in_one_loss_gets_both_gradients():
    once, twice = some_policy(), some_policy()
    once(OBS)[1].sum().backward()
    (twice(OBS[:4])[1].sum() + twice(OBS[4:])[1].sum()).backward()
    torch.testing.assert_close(twice.weights.grad, once.weights.grad)


def test_leading_axes_of_observations_are_kept():
    policy, obs = some_policy(), OBS[:6].reshape(3, 2, 3)
    distribution, values = policy(obs)
    assert isinstance(distribution, Gaussian) and distribution.mean.shape == (3, 2, 2) and values.shape == (3, 2)
    assert isinstance(some_policy(discrete=True)(obs)[0], Categorical)
    torch.testing.assert_close(policy.value(obs), values.detach())
    torch.testing.assert_close(policy.best_action(obs.numpy()), distribution.mean.detach())
    assert some_policy(discrete=True).act(obs, torch.Generator()).shape == (3, 2)


def test_sampled_actions_have_the_distribution_that_the_policy_states():
    generator, state = torch.Generator().manual_seed(0), OBS[:1].expand(40_000, 3)
    gaussian, categorical = some_policy(), some_policy(discrete=True, action_dim=4)
    actions, (mean, log_std) = gaussian.act(state, generator), gaussian(OBS[:1])[0]
    torch.testing.assert_close(actions.mean(0), mean[0].detach(), atol=0.03, rtol=0)
    torch.testing.assert_close(actions.std(0), log_std.exp().detach(), atol=0, rtol=0.02)
    shares = torch.bincount(categorical.act(state, generator), minlength=4) / len(state)
    torch.testing.assert_close(shares, categorical(OBS[:1])[0].logits[0].softmax(-1).detach(), atol=0.01, rtol=0)


@pytest.mark.parametrize("discrete", [False, True])
def test_one_generator_is_all_that_actions_are_drawn_from(discrete):
    policy = some_policy(discrete)
    first, second = (policy.act(OBS, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, second)
    assert first.dtype == (torch.int64 if discrete else torch.float32)


def test_a_new_policy_is_orthogonal_nearly_indifferent_and_the_same_for_one_seed():
    policy, again, other = make_policy(8, 2, seed=4), make_policy(8, 2, seed=4), make_policy(8, 2, seed=5)
    assert torch.equal(policy.weights, again.weights) and not torch.equal(policy.weights, other.weights)
    square = policy.tensors()["actor.1.weight"]
    torch.testing.assert_close(square @ square.T, 2 * torch.eye(64), atol=1e-5, rtol=0)
    assert policy.best_action(torch.randn(50, 8)).abs().max() < 0.1
    assert make_policy(8, 2, log_std=-0.5).tensors()["log_std"].tolist() == [-0.5, -0.5]


def test_policy_for_reads_the_spaces_of_the_environment():
    discrete, continuous = policy_for(ChainVectorEnv(num_envs=2)), policy_for(TimerVectorEnv(), hidden=8)
    assert (discrete.discrete, discrete.obs_dim, discrete.action_dim) == (True, 1, 2)
    assert (continuous.discrete, continuous.action_dim, continuous.hidden) == (False, 1, 8)


def test_scaling_of_observations_follows_all_that_were_seen():
    policy, obs = make_policy(3, 2), 5 + 3 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    for part in obs.split([100, 300, 100]):
        policy.observe(part)
    torch.testing.assert_close(policy.obs_mean, obs.mean(0))
    torch.testing.assert_close(policy.obs_std, obs.std(0, correction=0))


@pytest.mark.parametrize("max_grad_norm", [0.5, float("inf")])
def test_adam_takes_the_steps_of_pytorchs_adam_after_pytorchs_clipping(max_grad_norm):
    policy, reference = some_policy(), some_policy()
    optimizer, expected = Adam(1e-2), torch.optim.Adam([reference.weights], lr=1e-2, eps=1e-5)
    for scale in (1.0, 30.0, 0.01):
        for one in (policy, reference):
            one.weights.grad = None
            (scale * one(OBS)[1].square().mean()).backward()
        norm = torch.nn.utils.clip_grad_norm_([reference.weights], max_grad_norm)
        assert optimizer.step(policy, max_grad_norm) == pytest.approx(norm.item(), rel=1e-5)
        expected.step()
        torch.testing.assert_close(policy.weights, reference.weights)


@pytest.mark.parametrize("discrete", [False, True])
def test_a_saved_policy_comes_back_with_its_scaling(tmp_path, discrete):
    policy = some_policy(discrete)
    save_policy(policy, tmp_path / "policy.safetensors")
    again = load_policy(tmp_path / "policy.safetensors")
    assert torch.equal(again.weights, policy.weights) and again.discrete == discrete
    assert torch.equal(again.best_action(OBS), policy.best_action(OBS))
    assert torch.equal(again.value(OBS), policy.value(OBS))


def test_the_lander_file_has_fixed_names_and_shapes(tmp_path):
    save_policy(make_policy(**LANDER), tmp_path / "lander_policy.safetensors")
    tensors = safetensors.torch.load_file(tmp_path / "lander_policy.safetensors")
    assert {name: tuple(tensor.shape) for name, tensor in tensors.items()} == LANDER_SHAPES
    assert LANDER_SHAPES["actor.0.weight"] == (8, 64) and LANDER_SHAPES["log_std"] == (2,)
    assert sum(math.prod(shape) for shape in tensor_shapes(**LANDER).values()) == make_policy(**LANDER).weights.numel()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda tensors: tensors.pop("critic.0.bias"),
        lambda tensors: tensors.update(extra=torch.zeros(1)),
        lambda tensors: tensors.update({"actor.0.bias": torch.zeros(6)}),
        lambda tensors: tensors.update({"actor.0.bias": torch.full((5,), math.nan)}),
        lambda tensors: tensors.update({"obs_mean": torch.zeros(3, dtype=torch.float64)}),
        lambda tensors: tensors.update({"obs_std": torch.zeros(3)}),
        lambda tensors: tensors.clear(),
    ],
)
def test_files_that_are_no_policy_are_refused(tmp_path, spoil):
    path = tmp_path / "policy.safetensors"
    save_policy(some_policy(), path)
    tensors = safetensors.torch.load_file(path)
    spoil(tensors)
    safetensors.torch.save_file(tensors, path)
    with pytest.raises(ValueError, match=r"policy\.safetensors"):
        load_policy(path)


def test_a_copied_policy_is_a_policy_of_its_own():
    policy = some_policy()
    twin = copy.deepcopy(policy)
    twin.weights.data += 1
    assert not np.allclose(twin.value(OBS), policy.value(OBS))
    torch.testing.assert_close(twin.value(OBS), by_torch(twin, OBS)[2].detach())
