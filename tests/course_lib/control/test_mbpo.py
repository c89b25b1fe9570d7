"""The model-based agent: what its ensemble learns, what it keeps of its dreams, and that a run goes on where it was stopped."""

import gymnasium as gym
import pytest
import torch

from course_lib.control import mbpo
from course_lib.control.mbpo import Ensemble, MBPOSettings, imagined_steps
from course_lib.control.replay import Transitions
from solutions import ch47, ch48, ch51

SMALL = MBPOSettings().but(
    total_steps=60, learning_starts=30, batch_size=16, hidden=8, updates=2, refresh_every=15, imagined_steps=40, imagined_size=60,
    members=3, elites=2, model_hidden=8, model_batch=16, patience=1,
)  # fmt: skip
TAUGHT = mbpo.Taught.of(vars(ch51) | vars(ch47))


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def linear_steps(count, noise=0.0, seed=0):
    """Steps of a linear world: s' = s W + a V + noise, reward = first component of s'."""
    generator = seeded(seed)
    obs, actions = 2 * torch.randn(count, 2, generator=generator) + 1, torch.randn(count, 1, generator=generator)
    change = obs @ torch.tensor([[0.0, 0.2], [-0.2, 0.0]]) + actions @ torch.tensor([[0.3, 0.1]])
    next_obs = obs + change + noise * torch.randn(obs.shape, generator=generator)
    return Transitions(obs, actions, next_obs[:, 0].clone(), next_obs, torch.zeros(count, dtype=torch.bool))


def ensemble(**changes):
    settings = MBPOSettings().but(model_hidden=32, members=3, elites=2, patience=3).but(**changes)
    return Ensemble(2, 1, settings, ch51.gaussian_nll)


def training(seed=0, **changes):
    return mbpo.Training(gym.make("Pendulum-v1"), SMALL.but(**changes), seed, TAUGHT, update=ch48.fast_sac_update)


def test_an_ensemble_learns_a_linear_world_and_its_noise():
    model, test = ensemble(), linear_steps(200, seed=1)
    model.fit(linear_steps(800, noise=0.1), seeded())
    mean, std = model.distributions(test.obs, test.actions)
    errors = (mean[model.elites, :, :2] - test.next_obs).square().mean().sqrt()
    assert errors < 0.06, errors
    torch.testing.assert_close(std[..., :2].mean(), torch.tensor(0.1), atol=0.03, rtol=0)


def test_a_prediction_does_not_depend_on_its_neighbours():
    model, steps = ensemble(), linear_steps(50)
    model.fit(steps, seeded())
    among, alone = (
        model.distributions(steps.obs, steps.actions)[0][:, :1],
        model.distributions(steps.obs[:1], steps.actions[:1])[0],
    )
    torch.testing.assert_close(among, alone)


def test_members_disagree_more_where_they_have_seen_nothing():
    model, steps = ensemble(), linear_steps(300, noise=0.05)
    model.fit(steps, seeded())
    near, far = (model.distributions(k * steps.obs, steps.actions)[0].std(0).mean() for k in (1, 6))
    assert far > 3 * near


def test_elites_are_the_members_with_the_least_loss_on_held_out_steps(monkeypatch):
    model = ensemble(members=4, elites=2)
    monkeypatch.setattr(model, "_losses", lambda inputs, targets: torch.tensor([3.0, 1.0, 2.0, 0.5]))
    model.fit(linear_steps(40), seeded())
    assert model.elites.tolist() == [3, 1]


def test_each_member_keeps_the_weights_with_which_it_was_best(monkeypatch):
    model, losses = ensemble(members=2, elites=1, patience=2), iter([[5.0, 5.0], [1.0, 6.0], [2.0, 7.0], [3.0, 8.0]])
    seen = []

    def measured(inputs, targets):
        seen.append(model.networks.weights.detach().view(2, -1).clone())
        return torch.tensor(next(losses))

    monkeypatch.setattr(model, "_losses", measured)
    told = model.fit(linear_steps(40), seeded())
    kept = model.networks.weights.detach().view(2, -1)
    assert torch.equal(kept[0], seen[1][0]) and torch.equal(kept[1], seen[0][1])
    assert told["model_epochs"] == 3 and told["model_loss"] == 1


def test_held_out_steps_and_training_steps_are_all_the_steps_once():
    held_out, rest = mbpo._split(25, 0.2, seeded())
    assert len(held_out) == 5 and sorted([*held_out.tolist(), *rest.tolist()]) == list(range(25))


def test_a_step_of_the_model_comes_from_elites_only_and_its_generator_only():
    model, steps = ensemble(members=3, elites=1), linear_steps(50)
    model.fit(steps, seeded())
    mean, std = model.distributions(steps.obs, steps.actions)
    first, again = (model(steps.obs, steps.actions, seeded(3)) for _ in range(2))
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one, other)
    drawn = torch.cat([first[0], first[1][:, None]], -1)
    assert ((drawn - mean[model.elites[0]]).abs() < 6 * std[model.elites[0]]).all()
    assert not any(column.requires_grad for column in first)


def test_nothing_but_the_networks_own_weights_is_trained():
    made = training()
    made.advance(30)
    before = [tensor.detach().clone() for tensor in made.agent.tensors()]
    made.model.fit(made.buffer[torch.arange(30)], made.generator)
    made.dream()
    assert all(torch.equal(old, new.detach()) for old, new in zip(before, made.agent.tensors(), strict=True))
    of_model = made.model.networks.weights.detach().clone()
    made.update(made.agent, made.batch(), made.settings, made.taught, made.generator)
    assert torch.equal(of_model, made.model.networks.weights.detach())


def test_imagined_steps_stop_with_the_step_that_ends_their_trajectory():
    dream = {
        "obs": torch.arange(8.0).view(4, 2, 1),
        "actions": torch.zeros(3, 2, 1),
        "rewards": torch.tensor([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]),
        "continues": torch.tensor([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]),
    }
    steps = imagined_steps(dream)
    assert steps.rewards.tolist() == [0, 1, 2, 4]
    assert steps.terminated.tolist() == [False, True, False, False]  # the horizon is no end
    assert steps.obs[:, 0].tolist() == [0, 1, 2, 4] and steps.next_obs[:, 0].tolist() == [2, 3, 4, 6]


def test_batches_are_mostly_imagined_and_all_real_without_a_model():
    made = training(real_fraction=0.25)
    made.advance(40)
    made.imagined.rows.fill_(7.0)
    batch = made.batch()
    assert len(batch.rewards) == 16 and (batch.rewards == 7).sum() == 12
    without = training(horizon=0)
    without.advance(40)
    assert len(without.imagined) == 0 and len(without.batch().rewards) == 16


@pytest.mark.parametrize("refreshed, fits", [(True, 2), (False, 1)])
def test_the_model_is_refreshed_or_stays_the_first(refreshed, fits, monkeypatch):
    made, calls = training(refreshed=refreshed), []
    fit = made.model.fit
    monkeypatch.setattr(made.model, "fit", lambda steps, generator: calls.append(len(steps.rewards)) or fit(steps, generator))
    made.advance(60)
    assert calls == [31, 46][:fits]


def test_a_run_that_goes_on_from_its_state_gives_the_same_numbers():
    whole, first = training(), training()
    whole.advance(60)
    first.advance(47)
    resumed = training(seed=5)
    resumed.env = first.env  # its own state is kept by experiments.snapshots
    resumed.load_state_dict(first.state_dict())
    resumed.advance(13)
    for one, other in zip(whole.agent.tensors(), resumed.agent.tensors(), strict=True):
        assert torch.equal(one.detach(), other.detach())
    assert torch.equal(whole.model.networks.weights.detach(), resumed.model.networks.weights.detach())
    assert torch.equal(whole.model.elites, resumed.model.elites) and torch.equal(whole.imagined.rows, resumed.imagined.rows)


@pytest.mark.parametrize("name", ["Hopper-v5", "Walker2d-v5"])
def test_ends_are_those_of_gymnasium(name):
    env, rule, ends = gym.make(name), mbpo.ENDED[name], 0
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(600):
        obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        assert rule(torch.as_tensor(obs)[None]).item() == terminated
        ends += terminated
        if terminated or truncated:
            env.reset()
    assert ends > 5


def test_pendulums_never_end():
    assert not mbpo.ENDED["Pendulum-v1"](torch.randn(5, 3, generator=seeded())).any()


def test_the_functions_come_from_the_namespace():
    assert TAUGHT.gaussian_nll is ch51.gaussian_nll and TAUGHT.agent.soft_q_target is ch47.soft_q_target
    with pytest.raises(KeyError, match="imagine"):
        mbpo.Taught.of({"gaussian_nll": ch51.gaussian_nll})
