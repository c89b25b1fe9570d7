"""Small environments whose exact values are known, so that an estimate can be compared with the truth."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space


def make(name, num_envs, **env_kwargs):
    """N copies of a Gymnasium environment, stepped one after another in this process, with same-step autoreset.

    Where an episode ends, `step` returns the first observation of the next one, and the true last observation is in
    `info["final_obs"]`. Nothing is drawn (`render_mode=None`) unless asked for: drawing costs more than the physics.

    Args:
      name: the environment's id, such as "LunarLanderContinuous-v3".
      num_envs: N.
      env_kwargs: passed on to the environment's constructor; `max_episode_steps` sets its time limit.
    """
    options = {"autoreset_mode": AutoresetMode.SAME_STEP}
    env_kwargs = {"render_mode": None, **env_kwargs}
    return gym.make_vec(name, num_envs, vectorization_mode="sync", vector_kwargs=options, **env_kwargs)


def begun(envs, seed, steps=0, action=0.0):
    """The environments after a reset with this seed and some steps in which every component of every action is `action`."""
    envs.reset(seed=seed)
    for _ in range(steps):
        envs.step(np.full(envs.action_space.shape, action, np.float32))
    return envs


class TimerVectorEnv(gym.vector.VectorEnv):
    """Episodes of fixed lengths, and a reward of 1 a step: every value and advantage can be worked out by hand.

    Environment i ends its episodes after `lengths[i]` steps, by *termination* where `terminates[i]`, else by *truncation*. What it
    shows is the number of steps since the episode's start. Beside the 1, the reward has `action_reward` times the sum of the
    action's components. Nothing is random. Same-step autoreset, as in ChainVectorEnv.

    Args:
      lengths: steps of an episode, one number for each of the N environments, at least 1.
      terminates: whether the task ends then, or only the recording; one bool for each environment.
      action_reward: what an action of 1 pays, in units of reward.
      low, high: the bounds of the actions.

    Observations: (N, 1) float32. Actions: (N, 1) float32 in [low, high].
    Raises: ValueError if lengths and terminates differ in number, or a length is less than 1.
    """

    def __init__(self, lengths=(3, 3), terminates=(True, False), action_reward=0.0, low=-1.0, high=1.0):
        self.lengths, self.terminates = np.asarray(lengths, dtype=int), np.asarray(terminates, dtype=bool)
        if self.lengths.shape != self.terminates.shape:
            raise ValueError(f"lengths and terminates must be of one length, got {lengths} and {terminates}")
        if (self.lengths < 1).any():
            raise ValueError(f"lengths must be at least 1, got {lengths}")
        self.num_envs, self.action_reward = len(self.lengths), action_reward
        self.single_observation_space = gym.spaces.Box(0.0, np.inf, (1,), np.float32)
        self.single_action_space = gym.spaces.Box(low, high, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.elapsed = np.zeros(self.num_envs, dtype=int)

    def observe(self):
        """The steps since the episodes' starts, (N, 1)."""
        return self.elapsed[:, None].astype(np.float32)

    def reset(self, *, seed=None, options=None):
        """Start all episodes."""
        super().reset(seed=seed)
        self.elapsed[:] = 0
        return self.observe(), {}

    def step(self, actions):
        """Let a step pass; see the class for what ends an episode."""
        self.elapsed += 1
        rewards = 1 + self.action_reward * np.asarray(actions).sum(-1)
        ended = self.elapsed == self.lengths
        info = {}
        if ended.any():
            info = {"final_obs": self.observe(), "_final_obs": ended}
            self.elapsed = np.where(ended, 0, self.elapsed)
        return self.observe(), rewards, ended & self.terminates, ended & ~self.terminates, info


class ChainVectorEnv(gym.vector.VectorEnv):
    """A row of cells: a one-off payment at the left end, a steady wage at the right end.

    Cells are numbered 0 to length - 1 and every episode starts in the middle one. Action 0 steps left, action 1 right; with
    probability `slip` the step goes the other way, and the right wall holds whoever walks into it. Reaching cell 0 pays
    `exit_reward` and *terminates* the episode: the task is over. A step that ends in the last cell pays 1, for as long as one
    stays. After `time_limit` steps the episode is *truncated*: the limit is a convenience of data collection, the task
    itself would go on. Every reward carries normal noise of standard deviation `reward_noise`.

    Gymnasium's vector interface with same-step autoreset: where an episode ends, `step` returns the first observation of the
    next one, and the true last observation is in `info["final_obs"]`.

    Args:
      num_envs: N chains, stepped together.
      length: number of cells, at least 3.
      time_limit: steps to truncation, or None for none.
      exit_reward: paid once at cell 0, in units of reward.
      slip: probability in [0, 1] that a step goes the other way.
      reward_noise: standard deviation of the noise, in units of reward.

    Observations: (N, 1) float32, the cell scaled to [-1, 1].
    Raises: ValueError if length, time_limit, slip or reward_noise is out of range.
    """

    def __init__(self, num_envs=16, length=7, time_limit=10, exit_reward=8.0, slip=0.1, reward_noise=0.45):
        if length < 3:
            raise ValueError(f"length must be at least 3, got {length}")
        if time_limit is not None and time_limit < 1:
            raise ValueError(f"time_limit must be at least 1 or None, got {time_limit}")
        if not 0 <= slip <= 1:
            raise ValueError(f"slip must lie in [0, 1], got {slip}")
        if reward_noise < 0:
            raise ValueError(f"reward_noise must not be negative, got {reward_noise}")
        self.num_envs, self.length, self.time_limit = num_envs, length, time_limit
        self.exit_reward, self.slip, self.reward_noise = exit_reward, slip, reward_noise
        self.start = length // 2
        self.single_observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.single_action_space = gym.spaces.Discrete(2)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.cells = np.full(num_envs, self.start)
        self.elapsed = np.zeros(num_envs, dtype=int)

    def observe(self, cells):
        """Scale cells, an integer array of any shape, to observations with a trailing axis of 1."""
        return (2 * np.asarray(cells)[..., None] / (self.length - 1) - 1).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        """Start all episodes; `options={"cells": array}` places them elsewhere than in the middle."""
        super().reset(seed=seed)
        self.cells[:] = self.start if options is None else options["cells"]
        self.elapsed[:] = 0
        return self.observe(self.cells), {}

    def step(self, actions):
        """Move every chain by one step; see the class for what ends an episode."""
        slipped = self.np_random.random(self.num_envs) < self.slip
        right = (np.asarray(actions) == 1) ^ slipped
        self.cells = np.minimum(self.cells + np.where(right, 1, -1), self.length - 1)
        self.elapsed += 1
        terminated = self.cells == 0
        truncated = ~terminated & (self.elapsed == self.time_limit)
        rewards = self.exit_reward * terminated + (self.cells == self.length - 1)
        rewards = rewards + self.reward_noise * self.np_random.standard_normal(self.num_envs)

        ended = terminated | truncated
        info = {}
        if ended.any():
            info = {"final_obs": self.observe(self.cells), "_final_obs": ended}
            self.cells = np.where(ended, self.start, self.cells)
            self.elapsed = np.where(ended, 0, self.elapsed)
        return self.observe(self.cells), rewards, terminated, truncated, info

    def model(self):
        """The exact dynamics: transitions P(s' | s, a), (2, length, length) by action, and mean rewards r(s, a), (2, length).

        Row 0 is zero: nothing follows the exit.
        """
        transitions = np.zeros((2, self.length, self.length))
        for cell in range(1, self.length):
            left, right = cell - 1, min(cell + 1, self.length - 1)
            transitions[:, cell, left] += 1 - self.slip, self.slip
            transitions[:, cell, right] += self.slip, 1 - self.slip
        landing_rewards = np.zeros(self.length)
        landing_rewards[0], landing_rewards[-1] = self.exit_reward, 1
        return transitions, transitions @ landing_rewards

    def values(self, right_probability, gamma):
        """The exact V of a policy in the task without time limit.

            V = (I - γ P)⁻¹ r,   V(0) = 0

        Bellman's equations are linear in V; Sutton and Barto (2018), section 4.1.

        Args:
          right_probability: π(right | s) of every cell, (length,), or one number for all; cell 0 counts for nothing.
          gamma: discount per step, in [0, 1).

        Returns: (length,) float64, in units of reward.
        """
        transitions, rewards = self.model()
        right = np.broadcast_to(np.asarray(right_probability, dtype=float), self.length)
        policy = np.stack([1 - right, right])
        mean_transitions = np.einsum("as,ast->st", policy, transitions)
        return np.linalg.solve(np.eye(self.length) - gamma * mean_transitions, (policy * rewards).sum(0))

    def action_values(self, right_probability, gamma):
        """The exact Q(s, a) = r(s, a) + γ Σ P(s' | s, a) V(s'): (length, 2) float64; arguments as for `values`."""
        transitions, rewards = self.model()
        return (rewards + gamma * transitions @ self.values(right_probability, gamma)).T


class HoverVectorEnv(gym.vector.VectorEnv):
    """A drone that should hover at height 0 and is shaken by gusts. Two numbers of state, one engine, no libraries.

        v' = v + 0.2 (2 clip(a, -1, 1) + gust * w),   h' = h + 0.2 v',   reward exp(-2 h'²),   w ~ N(0, 1)

    Episodes start at a height between -1.5 and 1.5, with a speed of standard deviation 0.5. Beyond a height of ±3 the drone is lost and
    the episode is *terminated*; after `time_limit` steps it is *truncated*.

    Gymnasium's vector interface with same-step autoreset, as for ChainVectorEnv.

    Args:
      num_envs: N drones, stepped together.
      time_limit: steps to truncation, at least 1.
      gust: standard deviation of the gusts, not negative.
      copy: as for gymnasium.vector.SyncVectorEnv. If False, every call returns the one array in which the environment keeps its
        observations, and the next step overwrites it: faster, where observations are large.

    Observations: (N, 2) float32, height and speed. Actions: (N, 1), clipped to [-1, 1] by the environment.
    Raises: ValueError if time_limit or gust is out of range.
    """

    def __init__(self, num_envs=16, time_limit=50, gust=0.3, copy=True):
        if time_limit < 1:
            raise ValueError(f"time_limit must be at least 1, got {time_limit}")
        if gust < 0:
            raise ValueError(f"gust must not be negative, got {gust}")
        self.num_envs, self.time_limit, self.gust, self.copy = num_envs, time_limit, gust, copy
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.states = np.zeros((num_envs, 2), np.float32)
        self.elapsed = np.zeros(num_envs, dtype=int)

    def reset(self, *, seed=None, options=None):
        """Start all episodes."""
        super().reset(seed=seed)
        self._start(np.ones(self.num_envs, dtype=bool))
        return self.observe(), {}

    def step(self, actions):
        """Move every drone by one step; see the class for what ends an episode."""
        thrust = 2 * np.clip(np.asarray(actions)[:, 0], -1, 1)
        self.states[:, 1] += 0.2 * (thrust + self.gust * self.np_random.standard_normal(self.num_envs))
        self.states[:, 0] += 0.2 * self.states[:, 1]
        self.elapsed += 1
        heights = self.states[:, 0].copy()
        terminated = np.abs(heights) > 3
        truncated = ~terminated & (self.elapsed == self.time_limit)
        ended = terminated | truncated
        info = {}
        if ended.any():
            info = {"final_obs": self.states.copy(), "_final_obs": ended}
            self._start(ended)
        return self.observe(), np.exp(-2 * heights**2), terminated, truncated, info

    def observe(self):
        """Height and speed of every drone, (N, 2): with copy=False, the array itself."""
        return self.states.copy() if self.copy else self.states

    def _start(self, which):
        count = which.sum()
        self.states[which, 0] = self.np_random.uniform(-1.5, 1.5, count)
        self.states[which, 1] = 0.5 * self.np_random.standard_normal(count)
        self.elapsed[which] = 0


class BalanceTask:
    """A point that drifts away from zero, and a controller that pushes it back. Everything about it is known exactly.

        s' = drift * s + a + noise * w,   a ~ N(-obs @ gains, std²),   reward exp(-s'² / 2),   s_0 ~ N(0, start_std²)

    with w standard normal: the reward is 1 at zero and vanishes far from it. `obs` holds the position s and the readings of
    `sensors` useless sensors, standard normal and fresh at every step. A policy is given by its `gains`, a (1 + sensors,)
    tensor, and its `std`. Whatever it makes of the sensors acts like more noise, so every state is normal, and expected
    rewards have closed forms.

    Args:
      sensors: number of useless sensors.
      drift: factor by which the distance to zero grows in a step without a push.
      noise: standard deviation of the disturbance in a step.
      start_std: standard deviation of the first state.
      gamma: discount per step, in (0, 1); sums over time stop where it has fallen below 1e-5.

    Raises: ValueError if gamma lies outside (0, 1).
    """

    def __init__(self, sensors=0, drift=1.1, noise=0.3, start_std=2.0, gamma=0.9):
        if not 0 < gamma < 1:
            raise ValueError(f"gamma must lie in (0, 1), got {gamma}")
        self.sensors, self.drift, self.noise, self.start_std, self.gamma = sensors, drift, noise, start_std, gamma
        steps = math.ceil(math.log(1e-5) / math.log(gamma))
        self.times = torch.arange(steps, dtype=torch.float64)

    def sample(self, gains, std, count, generator):
        """Draw steps as the policy takes them: one t steps after the start has the weight (1 - γ) γ^t.

        Returns: obs (count, 1 + sensors), actions (count,), float32.
        """
        steps = torch.multinomial(self.gamma**self.times, count, replacement=True, generator=generator)
        deviations = self._state_variances(gains, std).sqrt().float()[steps]
        positions = deviations * torch.randn(count, generator=generator)
        readings = torch.randn(count, self.sensors, generator=generator)
        obs = torch.cat([positions.unsqueeze(-1), readings], dim=-1)
        return obs, std * torch.randn(count, generator=generator) - obs @ gains

    def mean_reward(self, gains, std):
        """J = (1 - γ) E Σ γ^t r_t, the policy's exact discounted return on the scale of one reward: a float in [0, 1]."""
        landing = self._landing_variances(gains, std, self._state_variances(gains, std))[0]
        return (1 - self.gamma) * self._rewards_from(0.0, landing, gains, std).item()

    def advantages(self, obs, actions, gains, std):
        """The exact A(s, a) = Q(s, a) - V(s) of the policy, in units of reward: (B,), for obs (B, 1 + sensors), actions (B,)."""
        drifted = self.drift * obs[:, 0]
        action_values = self._rewards_from(drifted + actions, self.noise**2, gains, std)
        values = self._rewards_from(drifted - obs @ gains, self.noise**2 + std**2, gains, std)
        return (action_values - values).to(obs.dtype)

    def expected_advantage(self, new_gains, new_std, gains, std):
        """E A(s, a) over the states that (gains, std) visits and the actions of another policy there: a float.

        A is the advantage of (gains, std). Over the new policy's own states the same mean would be exactly the difference of
        their mean rewards: Kakade and Langford (2002), lemma 6.1.
        """
        states = self._state_variances(gains, std)
        weights = (1 - self.gamma) * self.gamma**self.times
        landings = (self._landing_variances(*policy, states) for policy in ((new_gains, new_std), (gains, std)))
        after_new, after_old = (self._rewards_from(0.0, landing, gains, std) @ weights for landing in landings)
        return (after_new - after_old).item()

    def _landing_variances(self, gains, std, state_variances):
        """The variance of the position after one step from a state N(0, variance)."""
        gains = torch.as_tensor(gains, dtype=torch.float64)
        return (self.drift - gains[0]) ** 2 * state_variances + gains[1:].square().sum() + std**2 + self.noise**2

    def _spread(self, gains, std):
        """What t = 0, 1, … steps do to a position: its mean is multiplied by factors[t], its variance grows by spreads[t]."""
        factors = ((self.drift - float(gains[0])) ** self.times).clamp(-1e60, 1e60)  # beyond all reward, short of overflow
        added = self._landing_variances(gains, std, 0.0) * factors**2
        return factors, torch.cat([added.new_zeros(1), added.cumsum(0)[:-1]])

    def _state_variances(self, gains, std):
        """The variance of the position after t = 0, 1, … steps."""
        factors, spreads = self._spread(gains, std)
        return factors**2 * self.start_std**2 + spreads

    def _rewards_from(self, mean, variance, gains, std):
        """The expected discounted sum of rewards from a first landing place N(mean, variance) on, itself included.

        E exp(-s²/2) = exp(-μ² / (2 (1 + v))) / √(1 + v) for s ~ N(μ, v).
        """
        mean, variance = (torch.as_tensor(given, dtype=torch.float64).unsqueeze(-1) for given in (mean, variance))
        factors, spreads = self._spread(gains, std)
        variances = 1 + factors**2 * variance + spreads
        return ((-((mean * factors) ** 2) / (2 * variances)).exp() / variances.sqrt()) @ self.gamma**self.times
