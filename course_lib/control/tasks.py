"""Two continuous tasks that step all their environments at once, so that a training run takes seconds."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space


class _VectorTask(gym.vector.VectorEnv):
    """N environments without terminal states, truncated together after `time_limit` steps; same-step autoreset."""

    def __init__(self, num_envs, time_limit, observation_space, action_space):
        if time_limit < 1:
            raise ValueError(f"time_limit must be at least 1, got {time_limit}")
        self.num_envs, self.time_limit = num_envs, time_limit
        self.single_observation_space, self.single_action_space = observation_space, action_space
        self.low, self.high = action_space.low[0], action_space.high[0]
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def start(self, count):
        """New states, (count, S)."""
        raise NotImplementedError

    def observe(self, states):
        """The observations (N, O) float32 of states (N, S)."""
        raise NotImplementedError

    def advance(self, states, actions):
        """One step from states (N, S) with actions (N,): the next states and the rewards (N,)."""
        raise NotImplementedError

    def reset(self, *, seed=None, options=None):
        """Start all episodes; `options={"states": array}` places them."""
        super().reset(seed=seed)
        self.states = self.start(self.num_envs) if options is None else np.array(options["states"], dtype=float)
        self.elapsed = 0
        return self.observe(self.states), {}

    def step(self, actions):
        """Move every environment by one step; actions (N, 1)."""
        pushes = np.clip(np.asarray(actions, dtype=float)[:, 0], self.low, self.high)
        self.states, rewards = self.advance(self.states, pushes)
        self.elapsed += 1
        truncated = np.full(self.num_envs, self.elapsed == self.time_limit)
        info = {}
        if truncated[0]:
            info = {"final_obs": self.observe(self.states), "_final_obs": truncated}
            self.states, self.elapsed = self.start(self.num_envs), 0
        return self.observe(self.states), rewards, np.zeros(self.num_envs, dtype=bool), truncated, info


class PendulumVectorEnv(_VectorTask):
    """Gymnasium's Pendulum-v1, N at once: the same dynamics, rewards, observations and starts, in double precision.

    The reward of a step is -(θ² + 0.1 θ'² + 0.001 u²), with the angle θ from upright in [-π, π], its velocity θ' and the torque u, all
    before the step. Observations: (N, 3) cos θ, sin θ, θ'. Actions: (N, 1) torque in [-2, 2].

    Args:
      num_envs: N.
      time_limit: steps to truncation.
    """

    def __init__(self, num_envs=32, time_limit=200):
        high = np.array([1.0, 1.0, 8.0], dtype=np.float32)
        super().__init__(num_envs, time_limit, gym.spaces.Box(-high, high), gym.spaces.Box(-2.0, 2.0, (1,), np.float32))

    def start(self, count):
        """Any angle, velocities in [-1, 1]: (count, 2)."""
        return self.np_random.uniform([-np.pi, -1.0], [np.pi, 1.0], (count, 2))

    def observe(self, states):
        """(N, 3) of angles and velocities (N, 2)."""
        angle, velocity = states.T
        return np.stack([np.cos(angle), np.sin(angle), velocity], axis=-1).astype(np.float32)

    def advance(self, states, actions):
        """One step of 0.05 s: gravity 10, mass and length 1."""
        angle, velocity = states.T
        offset = (angle + np.pi) % (2 * np.pi) - np.pi
        rewards = -(offset**2 + 0.1 * velocity**2 + 0.001 * actions**2)
        velocity = np.clip(velocity + (15 * np.sin(angle) + 3 * actions) * 0.05, -8, 8)
        return np.stack([angle + velocity * 0.05, velocity], axis=-1), rewards


class CruiseVectorEnv(_VectorTask):
    """A car on an empty road whose passenger likes to get on, up to a point.

    The speed v drifts towards what the pedal asks for: v' = clip(v + 0.2 (2 + 2 a - v) + noise w, 0, 4), with w standard normal. The
    passenger's reward for a step is v' (2 - v'): it rises up to a speed of 1, is zero at 2, and falls steeply beyond.

    Args:
      num_envs: N.
      time_limit: steps to truncation.
      noise: standard deviation of a step's disturbance, in units of speed.
      start_speed: mean speed at the start; its standard deviation is 0.1.

    Observations: (N, 1) speed. Actions: (N, 1) pedal in [-1, 1].
    """

    TOP_SPEED = 4.0

    def __init__(self, num_envs=32, time_limit=50, noise=0.05, start_speed=0.4):
        self.noise, self.start_speed = noise, start_speed
        super().__init__(
            num_envs,
            time_limit,
            gym.spaces.Box(0.0, self.TOP_SPEED, (1,), np.float32),
            gym.spaces.Box(-1.0, 1.0, (1,), np.float32),
        )

    def start(self, count):
        """Speeds around the start speed, none negative: (count, 1)."""
        return np.abs(self.start_speed + 0.1 * self.np_random.standard_normal((count, 1)))

    def observe(self, states):
        """The speeds, in single precision."""
        return states.astype(np.float32)

    def advance(self, states, actions):
        """One step towards the speed that the pedal asks for."""
        speed, target = states[:, 0], 2 + 2 * actions
        disturbance = self.noise * self.np_random.standard_normal(len(speed))
        speed = np.clip(speed + 0.2 * (target - speed) + disturbance, 0, self.TOP_SPEED)
        return speed[:, None], self.passenger(speed)

    @staticmethod
    def passenger(speed):
        """What the passenger thinks of a speed, array or tensor: v (2 - v)."""
        return speed * (2 - speed)
