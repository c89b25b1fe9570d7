"""Soft actor-critic: the agent, and the loop that trains it (chapters 47, 48 and 51).

    taught = Taught.of(globals())                       # your functions of chapter 47
    training = Training(gym.make("Pendulum-v1"), SACSettings(), seed=0, taught=taught)
    for row in training.rows(every=1000):
        print(row["env_steps"], row["mean_return"])

The loop is here and reads from top to bottom; the losses, the target and the density of an action are handed to it. An update is
mostly matrix products: beside them it is kept short by fused optimisers, by asking for no gradient that nobody uses, and by a replay
buffer that is a single matrix.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from torch.nn import functional

from course_lib.chapters import earlier
from course_lib.control.networks import Adam, Networks
from course_lib.control.replay import ReplayBuffer, Transitions


@dataclass(frozen=True)
class Taught:
    """The functions that chapter 47 asks for, under their names there."""

    squashed_gaussian_log_prob: Callable
    soft_q_target: Callable
    sac_actor_loss: Callable
    temperature_loss: Callable
    polyak_update: Callable

    @classmethod
    def of(cls, namespace: Mapping[str, Any]) -> Taught:
        """Each function from a namespace, and from your notebook of chapter 47 where it has none."""
        names = [field.name for field in fields(cls)]
        return cls(**{name: namespace[name] if name in namespace else earlier(name, 47) for name in names})


@dataclass(frozen=True)
class SACSettings:
    """Everything that one may choose in SAC. The defaults are those of Haarnoja et al. (2018b), table 1."""

    total_steps: int = 200_000  # environment steps
    learning_starts: int = 10_000  # steps with actions drawn evenly, before the first update
    batch_size: int = 256
    learning_rate: float = 3e-4
    gamma: float = 0.99
    tau: float = 0.005
    hidden: int = 256
    buffer_size: int = 1_000_000
    target_entropy: float | None = None  # nats; None: minus the number of action components
    initial_alpha: float = 1.0

    def but(self, **changes) -> Self:
        """These settings with some changed."""
        return replace(self, **changes)


@dataclass(init=False, eq=False, repr=False)
class Agent:
    """A squashed Gaussian policy, twin critics, their slow copies, and a temperature, each with its optimiser.

    Inside, actions lie in (-1, 1); `low` and `high`, (A,), are the bounds of what the environment takes.
    """

    actor: Networks
    critics: Networks
    targets: Networks
    log_alpha: torch.Tensor
    log_std_range = (-20.0, 2.0)

    def __init__(self, obs_dim, low, high, settings, seed=0):
        generator, actions, hidden = torch.Generator().manual_seed(seed), len(low), (settings.hidden,) * 2
        self.actor = Networks((obs_dim, *hidden, 2 * actions), generator=generator)
        self.critics = Networks((obs_dim + actions, *hidden, 1), copies=2, generator=generator)
        self.targets = self.critics.frozen_copy()
        self.log_alpha = torch.tensor(math.log(settings.initial_alpha), requires_grad=True)
        self.target_entropy = -float(actions) if settings.target_entropy is None else settings.target_entropy
        self.low, self.high = (torch.as_tensor(bound, dtype=torch.float32) for bound in (low, high))
        learned = self.actor.weights, self.critics.weights, self.log_alpha
        self.actor_optimizer, self.critics_optimizer, self.temperature_optimizer = (
            Adam(weights, settings.learning_rate) for weights in learned
        )

    def distribution(self, obs):
        """Mean and log_std, (B, A) each, of the actions before squashing."""
        mean, log_std = self.actor(obs)[0].chunk(2, -1)
        return mean, log_std.clamp(*self.log_std_range)

    def sample(self, obs, generator, log_prob):
        """Actions in (-1, 1), (B, A), and their log-probabilities (B,) by the function log_prob; gradient passes through both."""
        mean, log_std = self.distribution(obs)
        noise = torch.randn(mean.shape, generator=generator)
        pre_tanh_actions = torch.addcmul(mean, log_std.exp(), noise)
        return pre_tanh_actions.tanh(), log_prob(mean, log_std, pre_tanh_actions)

    @torch.no_grad()
    def act(self, obs, generator):
        """Sample actions in (-1, 1), (N, A), for obs (N, O)."""
        mean, log_std = self.distribution(torch.as_tensor(obs, dtype=torch.float32))
        return torch.addcmul(mean, log_std.exp(), torch.randn(mean.shape, generator=generator)).tanh_()

    @torch.no_grad()
    def best_action(self, obs):
        """The action at the middle of the distribution, (N, A), as the environment takes it, for obs (N, O)."""
        mean, _ = self.distribution(torch.as_tensor(obs, dtype=torch.float32))
        return self.scaled(mean.tanh_())

    def scaled(self, actions):
        """Actions in (-1, 1) as the environment takes them."""
        return self.low + 0.5 * (actions + 1) * (self.high - self.low)

    def state_dict(self):
        """All that `load_state_dict` needs to go on from here."""
        tensors = [tensor.detach().clone() for tensor in self.tensors()]
        return {"tensors": tensors, "optimizers": [optimizer.state_dict() for optimizer in self._optimizers()]}

    @torch.no_grad()
    def load_state_dict(self, state):
        """Go on from `state_dict()`."""
        for tensor, saved in zip(self.tensors(), state["tensors"], strict=True):
            tensor.copy_(saved)
        for optimizer, saved in zip(self._optimizers(), state["optimizers"], strict=True):
            optimizer.load_state_dict(saved)

    def tensors(self):
        """What is learnt: the weights of actor, critics and targets, and log_alpha."""
        return self.actor.weights, self.critics.weights, self.targets.weights, self.log_alpha

    def _optimizers(self):
        return self.actor_optimizer, self.critics_optimizer, self.temperature_optimizer


def begun(obs_dim, low, high, settings, seed=0):
    """An agent in the midst of its training, for checks of an update: its policy and critics have moved away from where they began.

    Its optimisers' ε is 1, so that a step tells the size of a gradient and not its sign alone.
    """
    agent, generator = Agent(obs_dim, low, high, settings, seed), torch.Generator().manual_seed(seed)
    for networks in (agent.actor, agent.critics):
        with torch.no_grad():
            networks.weights.add_(0.3 * torch.randn(networks.weights.shape, generator=generator))
    for optimizer in agent._optimizers():
        optimizer.eps = 1.0
    return agent


def values(critics: Networks, obs, actions, learn=True):
    """What two critics say of actions (B, A) in (-1, 1) in states (B, O): (B,) from each."""
    first, second = critics(torch.cat([obs, actions], -1), learn).squeeze(-1)
    return first, second


def minimise(loss, *optimizers):
    """One step of each optimiser on a loss."""
    gradients = torch.autograd.grad(loss, [optimizer.weights for optimizer in optimizers])
    for optimizer, gradient in zip(optimizers, gradients, strict=True):
        optimizer.step(gradient)


def update(agent: Agent, batch: Transitions, settings: SACSettings, taught: Taught, generator: torch.Generator):
    """Improve the critics, the policy and the temperature by a step each, and let the slow copies follow.

    Haarnoja et al. (2018b), algorithm 1, https://arxiv.org/abs/1812.05905

    Returns: critic_loss, q (mean value of the policy's actions), entropy (nats) and alpha: 0-dim tensors without a graph.
    """
    alpha = agent.log_alpha.detach().exp()
    with torch.no_grad():
        next_actions, next_log_probs = agent.sample(batch.next_obs, generator, taught.squashed_gaussian_log_prob)
        next_q1, next_q2 = values(agent.targets, batch.next_obs, next_actions)
    targets = taught.soft_q_target(batch.rewards, batch.terminated, next_q1, next_q2, next_log_probs, alpha, settings.gamma)
    q1, q2 = values(agent.critics, batch.obs, batch.actions)
    critic_loss = functional.mse_loss(q1, targets) + functional.mse_loss(q2, targets)
    minimise(critic_loss, agent.critics_optimizer)

    actions, log_probs = agent.sample(batch.obs, generator, taught.squashed_gaussian_log_prob)
    q1, q2 = values(agent.critics, batch.obs, actions, learn=False)
    actor_loss = taught.sac_actor_loss(q1, q2, log_probs, alpha)
    temperature_loss = taught.temperature_loss(agent.log_alpha, log_probs, agent.target_entropy)
    minimise(actor_loss + temperature_loss, agent.actor_optimizer, agent.temperature_optimizer)  # neither is moved by the other

    taught.polyak_update([agent.targets.weights], [agent.critics.weights], settings.tau)
    return {
        "critic_loss": critic_loss.detach(),
        "q": q1.detach().mean(),
        "entropy": -log_probs.detach().mean(),
        "alpha": alpha,
    }


class Training:
    """SAC at work in one environment: a step of it, then an update, and so on.

    Args:
      env: a Gymnasium environment with flat observations and bounded continuous actions.
      settings: SACSettings.
      seed: of the environment, the weights and all that is drawn: two runs with one seed are equal bit for bit.
      taught: the functions of chapter 47.
      update: called in place of `update`, with the same arguments.
    """

    def __init__(self, env, settings, seed, taught, update=update):
        self.env, self.settings, self.taught, self.update = env, settings, taught, update
        self.generator = torch.Generator().manual_seed(seed)
        actions, (obs_dim,) = env.action_space, env.observation_space.shape
        self.agent = Agent(obs_dim, actions.low, actions.high, settings, seed)
        capacity = min(settings.buffer_size, settings.total_steps)
        self.buffer = ReplayBuffer(capacity, obs_dim, len(actions.low))
        self.obs, self.env_steps, self.running_return = env.reset(seed=seed)[0], 0, 0.0
        self.finished: list[float] = []  # returns of episodes since the last row
        self.latest: dict[str, torch.Tensor] = {}  # metrics of the last update

    def step(self):
        """One step of the environment, and what follows from it."""
        if self.env_steps < self.settings.learning_starts:
            actions = 2 * torch.rand((1, len(self.agent.low)), generator=self.generator) - 1
        else:
            actions = self.agent.act(self.obs[None], self.generator)
        next_obs, reward, terminated, truncated, _ = self.env.step(self.agent.scaled(actions)[0].numpy())
        self.buffer.add(self.obs[None], actions, [reward], next_obs[None], [terminated])
        self.env_steps += 1
        self.running_return += float(reward)
        self.obs = next_obs
        if terminated or truncated:
            self.finished.append(self.running_return)
            self.obs, self.running_return = self.env.reset()[0], 0.0
        if self.env_steps > self.settings.learning_starts:
            self.latest = self.learn()

    def learn(self):
        """What happens after each step once learning has started: here one update on a batch of all steps so far."""
        batch = self.buffer.sample(self.settings.batch_size, self.generator)
        return self.update(self.agent, batch, self.settings, self.taught, self.generator)

    def advance(self, num_steps) -> dict[str, float]:
        """Go on for some steps, and tell: env_steps, mean_return (of the episodes that ended; NaN if none), and the last metrics."""
        for _ in range(num_steps):
            self.step()
        row = {"env_steps": self.env_steps, "mean_return": float(np.mean(self.finished)) if self.finished else math.nan}
        self.finished = []
        return row | {name: metric.item() for name, metric in self.latest.items()}

    def rows(self, every=1000) -> Iterator[dict[str, float]]:
        """Train to the end: a row after every so many steps, with `seconds` since the start."""
        start = time.perf_counter()
        while (left := self.settings.total_steps - self.env_steps) > 0:
            yield self.advance(min(every, left)) | {"seconds": time.perf_counter() - start}

    def state_dict(self):
        """All that `load_state_dict` needs to go on from here, but for the environment's own state."""
        return {
            "agent": self.agent.state_dict(),
            "buffer": self.buffer.state_dict(),
            "generator": self.generator.get_state(),
            "obs": torch.from_numpy(np.array(self.obs)),
            "env_steps": self.env_steps,
            "running_return": self.running_return,
            "finished": list(self.finished),
        }

    def load_state_dict(self, state):
        """Go on from `state_dict()`; the environment is to be put where it was by whoever knows how."""
        self.agent.load_state_dict(state["agent"])
        self.buffer.load_state_dict(state["buffer"])
        self.generator.set_state(state["generator"])
        self.obs, self.env_steps, self.running_return = state["obs"].numpy(), state["env_steps"], state["running_return"]
        self.finished = list(state["finished"])
