"""Clips, pairs and reward models."""

import torch
import torch.nn.functional as F

from course_lib.control.clips import RewardModel, Segments, cut, draw_pairs, fit
from course_lib.control.rollouts import Rollout


def rollout(ends, steps=7):
    """One environment whose rewards count the steps, with episode ends after the steps in `ends`."""
    count = torch.arange(steps, dtype=torch.float32)[:, None]
    terminated = torch.zeros(steps, 1, dtype=torch.bool)
    terminated[list(ends)] = True
    return Rollout(
        count[..., None],
        torch.zeros(steps, 1, dtype=torch.int64),
        count,
        count[..., None],
        terminated,
        terminated & False,
        count[-1:],
    )


def test_a_clip_never_crosses_an_episodes_end_and_only_an_end_shortens_it():
    clips = cut(rollout(ends=[1]), 3)
    assert [row[kept].tolist() for row, kept in zip(clips.rewards, clips.mask, strict=True)] == [[0, 1], [2, 3, 4]]
    assert not clips.obs[~clips.mask].any() and clips.actions.shape == (2, 3, 1)


def test_an_end_at_the_last_step_keeps_the_short_clip():
    clips = cut(rollout(ends=[1, 6]), 3)
    assert [row[kept].tolist() for row, kept in zip(clips.rewards, clips.mask, strict=True)] == [[0, 1], [2, 3, 4], [5, 6]]


def test_pairs_are_of_different_clips():
    first, second = draw_pairs(3, 500, torch.Generator().manual_seed(0))
    assert (first != second).all()
    assert set(first.tolist()) == set(second.tolist()) == {0, 1, 2}


def test_a_seed_fixes_a_reward_model_and_leaves_the_global_one_alone():
    torch.manual_seed(1)
    expected = torch.rand(1)
    torch.manual_seed(1)
    models = [RewardModel(3, 1, seed=4) for _ in range(2)]
    assert torch.rand(1) == expected
    obs, actions = torch.ones(2, 5, 3), torch.ones(2, 5, 1)
    assert models[0](obs, actions).shape == (2, 5)
    assert torch.equal(*(model(obs, actions) for model in models))


def test_fitting_finds_what_was_preferred():
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(200, 5, 2, generator=generator)
    clips = Segments(obs, obs[..., :0], obs[..., 0], torch.ones(200, 5, dtype=torch.bool))
    first, second = draw_pairs(200, 300, generator)
    ahead = clips.rewards.sum(1)[first] > clips.rewards.sum(1)[second]
    chosen, rejected = torch.where(ahead, first, second), torch.where(ahead, second, first)
    model = RewardModel(2, seed=0).scale_to(clips)

    def loss(model, better, worse):
        return F.softplus(model(worse.obs).sum(1) - model(better.obs).sum(1)).mean()

    losses = fit(model, clips[chosen], clips[rejected], loss, steps=150)
    assert losses[-20:].mean() < 0.25 < losses[:3].mean()
    learned = model(obs).detach().flatten()
    assert torch.corrcoef(torch.stack([learned, clips.rewards.flatten()]))[0, 1] > 0.9
