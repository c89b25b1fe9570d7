"""Comparisons of short clips: cutting them from rollouts, pairing them, and the small reward models that are fitted to answers."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import nn


@dataclass(frozen=True)
class Segments:
    """B clips of at most T steps, each from within one episode; padded behind with zeros."""

    obs: torch.Tensor  # (B, T, O)
    actions: torch.Tensor  # (B, T, A), as sampled; a discrete action is one number
    rewards: torch.Tensor  # (B, T), the environment's own, which a person who compares does not write down
    mask: torch.Tensor  # (B, T) bool, True on the clip's own steps

    def __len__(self) -> int:
        return len(self.mask)

    def __getitem__(self, indices) -> Segments:
        """The clips of an int64 tensor of indices, in its order."""
        return Segments(*(getattr(self, field.name)[indices] for field in fields(self)))


def cut(rollout, length) -> Segments:
    """Cut a rollout into clips of `length` steps, one behind the other; where an episode ends, a clip ends early.

    Args:
      rollout: Rollout of (T, N) steps.
      length: steps of a full clip.

    Returns: Segments, environment by environment, in the order of time. A last clip that is short because the rollout stops is left
      out, so that a clip is short for one reason only: its episode ended.
    """
    ended = rollout.terminated | rollout.truncated
    clips: list[tuple[int, int, int]] = []  # environment, start, stop
    for env in range(ended.shape[1]):
        start = 0
        for stop in (*(torch.nonzero(ended[:, env]).flatten() + 1).tolist(), len(ended)):
            clips += [(env, first, min(first + length, stop)) for first in range(start, stop, length)]
            start = stop
    clips = [clip for clip in clips if clip[2] - clip[1] == length or ended[clip[2] - 1, clip[0]]]

    def padded(column: torch.Tensor) -> torch.Tensor:
        out = column.new_zeros(len(clips), length, *column.shape[2:])
        for row, (env, first, stop) in zip(out, clips, strict=True):
            row[: stop - first] = column[first:stop, env]
        return out

    actions = rollout.actions.float()
    return Segments(
        padded(rollout.obs),
        padded(actions if actions.dim() == 3 else actions.unsqueeze(-1)),
        padded(rollout.rewards),
        padded(torch.ones_like(ended)),
    )


def draw_pairs(num_segments, num_pairs, generator):
    """Pairs of different clips, drawn with replacement: two (num_pairs,) int64 tensors of indices."""
    first = torch.randint(num_segments, (num_pairs,), generator=generator)
    offset = torch.randint(1, num_segments, (num_pairs,), generator=generator)
    return first, (first + offset) % num_segments


class RewardModel(nn.Module):
    """A network of two hidden layers (ReLU) that gives each observation and action one number, in a unit of its own.

    Args:
      obs_dim: components of an observation.
      action_dim: components of an action; 0 for a reward of observations alone.
      hidden: width of the hidden layers.
      seed: of the weights.
    """

    def __init__(self, obs_dim, action_dim=0, hidden=32, seed=0):
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            inputs = obs_dim + action_dim
            self.layers = nn.Sequential(
                nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 1)
            )
        self.action_dim = action_dim
        self.centre, self.spread = torch.zeros(inputs), torch.ones(inputs)

    def scale_to(self, segments) -> RewardModel:
        """Let inputs enter in units of their spread among these clips; returns the model itself."""
        inputs = self._inputs(segments.obs, segments.actions)[segments.mask]
        self.centre, self.spread = inputs.mean(0), inputs.std(0).clamp(min=1e-3)
        return self

    def forward(self, obs, actions=None):
        """Rewards (...,) of obs (..., O) and actions (..., A)."""
        return self.layers((self._inputs(obs, actions) - self.centre) / self.spread).squeeze(-1)

    def _inputs(self, obs, actions):
        return torch.cat([obs, actions], dim=-1) if self.action_dim else obs


class QuadraticReward:
    """A reward model without training: r(s) = bias + Σ_i (linear_i s_i + quadratic_i s_i²). It is not zero at s = 0, as networks are not.

    Args:
      linear: (O,) tensor.
      quadratic: (O,) tensor.
      bias: (1,) tensor.
    """

    def __init__(self, linear, quadratic, bias):
        self.linear, self.quadratic, self.bias = linear, quadratic, bias

    def __call__(self, obs):
        """Rewards (...,) of obs (..., O)."""
        return obs @ self.linear + obs.square() @ self.quadratic + self.bias.squeeze()


class Scorer(nn.Module):
    """What a reward model gives to whole clips: called with Segments of B clips, it returns their learned returns, (B,).

    Args:
      model: torch module that gives observations (..., O) their rewards, (...,).
      returns_of: `returns_of(model, obs, mask) -> (B,)`, how rewards make returns.
    """

    def __init__(self, model, returns_of):
        super().__init__()
        self.model, self.returns_of = model, returns_of

    def forward(self, segments):
        """See the class."""
        return self.returns_of(self.model, segments.obs, segments.mask)


class WatchedScorer(nn.Module):
    """A scorer for trying out a training loop in milliseconds: a reward that is linear in the observations, and a diary.

    The diary has a row (clip, step) for each clip whose return passed gradient back: its number, which stands in actions[:, 0, 0], and
    how many different weights the scorer had had before. It is a buffer, and remains when weights are loaded.

    Args:
      weights: (O,) tensor.
    """

    def __init__(self, weights):
        super().__init__()
        self.weights = nn.Parameter(weights)
        self.seen, self.moves = weights.clone(), -1
        self.diary: torch.Tensor
        self.register_buffer("diary", torch.zeros(0, 2, dtype=torch.int64))

    def forward(self, segments):
        """Returns of all clips, (B,)."""
        weights = self.weights.detach()
        if self.moves < 0 or not torch.equal(weights, self.seen):
            self.seen, self.moves = weights.clone(), self.moves + 1
        returns = (segments.obs @ self.weights).masked_fill(~segments.mask, 0).sum(1)
        if returns.requires_grad:
            rows = torch.stack([segments.actions[:, 0, 0].long(), torch.full((len(returns),), self.moves)], 1)
            returns.register_hook(lambda gradient: self._write(rows[gradient != 0]))
        return returns

    def _write(self, rows):
        self.diary = torch.cat([self.diary, rows])

    def _load_from_state_dict(self, state_dict, prefix, *rest):
        state_dict[f"{prefix}diary"] = self.diary
        super()._load_from_state_dict(state_dict, prefix, *rest)


def fit(model, chosen, rejected, loss, steps=300, batch_size=32, learning_rate=2e-3, weight_decay=0.01, seed=0):
    """Fit a reward model to comparisons, in place, with AdamW.

    Args:
      model: torch module.
      chosen: Segments, the preferred clip of each pair.
      rejected: Segments, the other one.
      loss: `loss(model, chosen, rejected) -> scalar` for a minibatch of pairs.
      steps: minibatches, drawn with replacement.
      batch_size: pairs in a minibatch; all of them where there are fewer.
      learning_rate, weight_decay: of AdamW.
      seed: of the minibatches.

    Returns: the losses, (steps,) tensor.
    """
    optimizer = torch.optim.AdamW(model.parameters(), lr=learning_rate, weight_decay=weight_decay)
    generator, losses = torch.Generator().manual_seed(seed), []
    for _ in range(steps):
        pairs = torch.randint(len(chosen), (min(batch_size, len(chosen)),), generator=generator)
        value = loss(model, chosen[pairs], rejected[pairs])
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        losses.append(value.detach())
    return torch.stack(losses)
