"""A small task for imitation: a rover on a winding road, the driver who can keep it there, and others who may not."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import torch

OBSERVATIONS = gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)
COMMANDS = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
CHOICES = gym.spaces.Discrete(3)


class RoadEnv(gym.Env):
    """A rover that must keep to a winding road. Only the steering is to be chosen; the speed is constant.

    The steering angle follows the command with a lag, as a real actuator does. The road's bends are drawn anew for every episode,
    and gusts of wind turn the rover at every step; both come from the seed of `reset`.

        wheel   ← wheel + 0.6 (clip(command, -1, 1) - wheel)
        heading ← heading + 0.12 wheel - bend + gust
        offset  ← offset + 0.5 sin(heading)

    Observations: (5,) float32: the offset from the middle of the road (its edges are at ±1), the heading against the road's
    direction (radians), the steering angle in [-1, 1], and the road's bend here and five steps ahead (radians per step).
    Actions: the command, (1,) float32; with `discrete=True` 0 (left, -1), 1 (straight on, 0) or 2 (right, 1).
    Reward: 1 - offset², at most 1, for every step that ends on the road. Leaving it pays 0 and *terminates* the episode; after
    `time_limit` steps it is *truncated*. A step after the end of an episode raises a RuntimeError.

    Args:
      time_limit: steps to truncation, or None for none.
      gust: standard deviation of the wind's turns, in radians.
      bend: how strongly the road winds, in radians per step; 0 is a straight road.
      start: the offset at which an episode begins is drawn from ±start.
      discrete: three commands instead of any number.
      one_array: every observation is the same array, filled anew, as fast environments have it.

    Raises: ValueError if time_limit is below 1, or gust, bend or start negative.
    """

    def __init__(self, time_limit=200, gust=0.01, bend=0.05, start=0.2, discrete=False, one_array=False):
        if time_limit is not None and time_limit < 1:
            raise ValueError(f"time_limit must be at least 1 or None, got {time_limit}")
        for name, value in {"gust": gust, "bend": bend, "start": start}.items():
            if value < 0:
                raise ValueError(f"{name} must not be negative, got {value}")
        self.time_limit, self.gust, self.bend, self.start, self.discrete = time_limit, gust, bend, start, discrete
        self.observation_space = OBSERVATIONS
        self.action_space = CHOICES if discrete else COMMANDS
        self.ended = True
        self.array = np.zeros(5, dtype=np.float32) if one_array else None

    def reset(self, *, seed=None, options=None):
        """Start an episode on a new road."""
        super().reset(seed=seed)
        self.phases = self.np_random.uniform(0, 2 * math.pi, 2)
        self.offset = self.np_random.uniform(-self.start, self.start)
        self.heading, self.wheel, self.elapsed, self.ended = 0.0, 0.0, 0, False
        return self._observe(), {}

    def step(self, action):
        """Move the rover by one step; see the class."""
        if self.ended:
            raise RuntimeError("the episode has ended: call reset before the next step")
        command = int(action) - 1 if self.discrete else min(max(float(np.asarray(action).reshape(())), -1.0), 1.0)
        self.wheel += 0.6 * (command - self.wheel)
        self.heading += 0.12 * self.wheel - self._bend_at(self.elapsed) + self.gust * self.np_random.standard_normal()
        self.offset += 0.5 * math.sin(self.heading)
        self.elapsed += 1
        terminated = abs(self.offset) > 1
        truncated = not terminated and self.elapsed == self.time_limit
        self.ended = terminated or truncated
        return self._observe(), 0.0 if terminated else 1 - self.offset**2, terminated, truncated, {}

    def _bend_at(self, step):
        slow, fast = self.phases
        return self.bend * (math.sin(2 * math.pi * step / 61 + slow) + math.sin(2 * math.pi * step / 27 + fast)) / 2

    def _observe(self):
        bends = self._bend_at(self.elapsed), self._bend_at(self.elapsed + 5)
        seen = np.array([self.offset, self.heading, self.wheel, *bends], dtype=np.float32)
        if self.array is None:
            return seen
        self.array[:] = seen
        return self.array


class RoadDriver:
    """The expert of `RoadEnv`: a policy that steers with the bend, and back to the middle of the road.

    Called with obs (B, 5), it returns commands (B, 1) in [-1, 1]; with `discrete=True` the nearest of the three, (B,) int64.

    Args:
      tremor: standard deviation of the normal noise that the driver's hand adds to each command.
      generator: what the noise is drawn from; needed only where there is any.
      discrete: see above.
    """

    def __init__(self, tremor=0.0, generator=None, discrete=False):
        self.tremor, self.generator, self.discrete = tremor, generator, discrete

    def __call__(self, obs):
        offset, heading, _, bend, bend_ahead = obs.unbind(-1)
        turn = (bend + bend_ahead) / 2 - 0.3 * offset - 0.7 * heading
        command = (turn / 0.12).clamp(-1, 1)
        if self.tremor:
            command = command + self.tremor * torch.randn(command.shape, generator=self.generator)
        return (command.round().clamp(-1, 1) + 1).long() if self.discrete else command.unsqueeze(-1)


class LinearPolicy(torch.nn.Module):
    """actions = obs @ weights.T + bias, for obs (B, O); with `discrete=True` the index of the largest, (B,) int64.

    The actions carry a graph, as those of any network do. A single observation without its batch axis is refused.

    Args:
      weights: (A, O).
      bias: (A,).

    Raises: ValueError if obs is not (B, O).
    """

    def __init__(self, weights, bias, discrete=False):
        super().__init__()
        self.weights = torch.nn.Parameter(torch.as_tensor(weights, dtype=torch.float32))
        self.bias = torch.nn.Parameter(torch.as_tensor(bias, dtype=torch.float32))
        self.discrete = discrete

    def forward(self, obs):
        """See the class."""
        if obs.ndim != 2:
            raise ValueError(f"obs must be (B, O), a batch of observations, got shape {tuple(obs.shape)}")
        scores = obs.to(torch.float32) @ self.weights.T + self.bias
        return scores.argmax(-1) if self.discrete else scores
