"""The experiment of chapter 45: every mistake changes what is learned from, in the way that its name says, and nothing else."""

from contextlib import ExitStack

import numpy as np
import pytest
import torch

from course_lib.control import envs
from course_lib.control.policies import load_policy, policy_for
from experiments import lander
from solutions import ch45


def learned_from(variant, terminate=True):
    """The batch of one rollout of 4 x 8 steps, some of which end an episode, and the value targets' advantages."""
    settings = lander.SETTINGS[variant].but(num_steps=8, reward_scale=1.0)
    training = envs.TimerVectorEnv([3, 4, 5, 6], [terminate] * 4)
    policy = policy_for(training, 8, 0.0, seed=0)
    rollout = ch45.collect_rollout(training, policy, 8, training.reset(seed=0)[0], torch.Generator().manual_seed(0))
    with ExitStack() as patches:
        for patch in lander.MISTAKES.get(variant, list)():
            patches.enter_context(patch)
        batch, _ = ch45.estimate(policy, rollout, settings)
    return batch


@pytest.mark.parametrize("variant", lander.MISTAKES)
def test_a_mistake_is_undone_when_its_run_ends(variant):
    before = vars(ch45).copy()
    learned_from(variant)
    assert vars(ch45) == before


def test_signs_are_flipped():
    assert torch.equal(learned_from("broken_sign_flipped").advantages, -learned_from("ours").advantages)


def test_terminations_are_ignored():
    cut = learned_from("ours", terminate=False)
    assert torch.equal(learned_from("broken_terminated_ignored").returns, cut.returns)
    assert not torch.allclose(cut.returns, learned_from("ours").returns)


def test_returns_are_made_of_normalised_advantages():
    ours, broken = learned_from("ours"), learned_from("broken_returns_from_normalised")
    assert torch.equal(broken.advantages, ours.advantages) and not torch.allclose(broken.returns, ours.returns)


def test_every_step_pays_the_mean_reward():
    rewards = torch.tensor([[1.0], [2.0], [6.0]])
    values, never = torch.zeros(3, 1), torch.zeros(3, 1, dtype=torch.bool)
    with ExitStack() as patches:
        for patch in lander.MISTAKES["broken_rewards_centred"]():
            patches.enter_context(patch)
        assert ch45.compute_gae(rewards, values, values, never, never, 1.0, 0.0).flatten().tolist() == [-2.0, -1.0, 3.0]


def test_advantages_are_misaligned():
    ours, broken = learned_from("ours").advantages, learned_from("broken_misaligned").advantages
    assert torch.equal(broken, ours.view(8, 4).T.flatten()) and not torch.equal(broken, ours)


def test_likeliest_actions_take_the_place_of_those_taken():
    ours, broken = learned_from("ours"), learned_from("broken_mean_action")
    assert torch.equal(broken.advantages, ours.advantages) and not torch.equal(broken.actions, ours.actions)
    assert (broken.old_log_probs >= ours.old_log_probs).all()


def test_executed_actions_take_the_place_of_those_sampled():
    ours, broken = learned_from("ours"), learned_from("broken_executed")
    assert (ours.actions.abs() > 1).any() and torch.equal(broken.actions, ours.actions.clamp(-1, 1))
    same = (ours.actions.abs() <= 1).all(-1)
    torch.testing.assert_close(broken.old_log_probs[same], ours.old_log_probs[same])
    assert (broken.old_log_probs[~same] != ours.old_log_probs[~same]).all() and torch.equal(broken.advantages, ours.advantages)


def test_an_inverted_ratio_turns_the_gradient_around():
    log_probs = np.zeros(3, np.float32)
    _, before = ch45.clipped_surrogate_gradient(log_probs, log_probs, np.ones(3, np.float32), 0.2)
    with ExitStack() as patches:
        for patch in lander.MISTAKES["broken_ratio_inverted"]():
            patches.enter_context(patch)
        _, inverted = ch45.clipped_surrogate_gradient(log_probs, log_probs, np.ones(3, np.float32), 0.2)
    np.testing.assert_array_equal(inverted, -before)


def test_variants_change_one_setting_each():
    for variant, configuration in lander.VARIANTS.items():
        base = lander.VARIANTS["ours" if variant.startswith(("ours", "broken")) else "ours_200k"]
        changed = [name for name in configuration if configuration[name] != base.get(name)]
        assert len(changed) == (variant != "ours"), variant


def test_a_run_gives_rows_a_hundred_returns_and_policies(monkeypatch, tmp_path):
    monkeypatch.setitem(lander.SETTINGS, "ours", lander.OURS.but(total_steps=2048, num_steps=64))
    monkeypatch.setattr(lander, "EPISODES", 40)
    reports = []
    result = lander.run("ours", 0, tmp_path, lambda *progress: reports.append(progress))
    assert [row["env_steps"] for row in result.rows] == [1024, 2048] and reports == [(1024, 2048), (2048, 2048)]
    assert {"mean_return", "approx_kl", "clip_fraction", "explained_variance", "entropy"} <= result.rows[0].keys()
    assert len(result.summary["eval_returns"]) == len(result.summary["eval_lengths"]) == 40
    stages = {f"{stage}.{suffix}" for stage in ("first", "middle", "final") for suffix in ("mp4", "webp")}
    assert result.artefacts.keys() == {"safetensors", "first.safetensors", "middle.safetensors"} | stages
    (tmp_path / "policy.safetensors").write_bytes(result.artefacts["safetensors"])
    flown = lander.fly(load_policy(tmp_path / "policy.safetensors"), 40, lander.EVALUATION_SEED)
    assert result.summary["eval_lengths"] == flown[1], "the file holds the policy that was flown"
