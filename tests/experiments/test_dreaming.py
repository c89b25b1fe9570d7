"""The small Dreamer of chapter 51: the page shows what was recorded, and its policy learns through the model."""

import inspect

import pytest
import torch

from autograder.authoring import chapter
from course_lib.control import mbpo
from experiments import dreaming


def test_the_page_shows_the_program_that_was_recorded():
    (cell,) = [cell for cell in chapter.load("ch51").cells if cell.kind == "code" and "class Dreamer" in cell.source]
    for part in (dreaming.differentiable, dreaming.value, dreaming.Dreamer, dreaming.dreaming):
        assert inspect.getsource(part).strip() in cell.source


def test_the_configuration_says_what_the_program_does():
    source = inspect.getsource(dreaming.Dreamer) + inspect.getsource(dreaming.dreaming)
    for name, written in {
        "horizon": "{}, generator)",
        "reward_scale": "{} * dream",
        "tau": "detach(), {})",
        "noise": "{} * torch.randn",
    }.items():
        assert written.format(dreaming.DREAMER[name]) in source, name
    assert dreaming.VARIANTS["lam_0"] == dreaming.DREAMER | {"lam": 0.0}
    assert dreaming.VARIANTS["pulled"] == dreaming.DREAMER | {"pull": 0.01}


def test_gradient_passes_through_the_world_and_not_to_its_weights():
    model = mbpo.Ensemble(3, 1, mbpo.MBPOSettings().but(members=2, elites=1, model_hidden=8), lambda *_: None)
    obs, actions = torch.randn(5, 3, requires_grad=True), torch.randn(5, 1, requires_grad=True)
    next_obs, rewards, _ = dreaming.differentiable(model)(obs, actions, None)
    (next_obs.sum() + rewards.sum()).backward()
    assert obs.grad.abs().min() > 0 and actions.grad.abs().sum() > 0
    assert model.networks.weights.grad is None
    expected = model.distributions(obs.detach(), actions.detach())[0][model.elites].mean(0)
    torch.testing.assert_close(torch.cat([next_obs, rewards[:, None]], 1).detach(), expected)


def test_a_policy_learns_through_what_its_actions_bring_and_from_nothing_else():
    def world(obs, actions, generator):
        """The reward of an action comes a step late."""
        return torch.cat([actions, obs[:, 1:]], 1), obs[:, 0], torch.ones(len(obs))

    starts = torch.randn(16, 3, generator=torch.Generator().manual_seed(1))
    agent = dreaming.Dreamer(0)
    before = agent.act(starts).mean().item()
    for _ in range(3):
        agent.learn(world, starts, None)
    assert agent.act(starts).mean().item() > before + 0.01
    with pytest.raises(RuntimeError, match="does not require grad"):
        agent.learn(lambda *given: tuple(part.detach() for part in world(*given)), starts, None)


def test_rows_are_evaluations_and_a_variant_sets_lambda(tmp_path, monkeypatch):
    asked = []

    def short(seed, steps, lam, pull):
        asked.append((seed, steps, lam, pull))
        yield from ((100, dreaming.Dreamer(seed, lam)), (200, dreaming.Dreamer(seed, lam)))

    monkeypatch.setattr(dreaming, "dreaming", short)
    told = []
    result = dreaming.run("lam_0", 3, tmp_path, lambda done, total: told.append((done, total)))
    assert asked == [(3, 1000, 0.0, 0.0)] and told == [(100, 1000), (200, 1000)]
    assert [row["env_steps"] for row in result.rows] == [100, 200] and len(result.summary["final_returns"]) == 10
    assert all(row["eval_return"] < 0 for row in result.rows)


def test_a_pull_keeps_the_policy_from_its_bounds():
    def world(obs, actions, generator):
        """All reward is for the action, and the more the better."""
        return obs, actions[:, 0], torch.ones(len(obs))

    starts, found = torch.randn(16, 3, generator=torch.Generator().manual_seed(1)), []
    for pull in (0.0, 1.0):
        agent = dreaming.Dreamer(0, pull=pull)
        for _ in range(30):
            agent.learn(world, starts, None)
        found.append(agent.act(starts).mean().item())
    assert found[1] < 0.5 * found[0]
