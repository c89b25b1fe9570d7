"""Model-based policy optimisation: soft actor-critic that lives mostly in short dreams of a learned model (chapter 51).

    taught = Taught.of(globals())                       # your functions of chapters 51 and 47
    training = Training(gym.make("Pendulum-v1"), MBPOSettings(), seed=0, taught=taught)
    for row in training.rows(every=200):
        print(row["env_steps"], row["mean_return"])

Janner et al. (2019), algorithm 2, https://arxiv.org/abs/1906.08253. The agent, its updates and the loop are those of `control.sac`;
what is new is `learn`: where the batches come from. The model is an ensemble of probabilistic networks, as in Chua et al. (2018),
https://arxiv.org/abs/1805.12114: each member predicts how the observation changes, and the reward, as normal distributions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch.nn import functional

from course_lib.control import sac
from course_lib.control.networks import Adam, Networks
from course_lib.control.replay import ReplayBuffer, Transitions


@dataclass(frozen=True)
class Taught:
    """The functions that chapter 51 asks for, under their names there, and those of chapter 47."""

    gaussian_nll: Callable
    imagine: Callable
    agent: sac.Taught

    @classmethod
    def of(cls, namespace: Mapping[str, Any]) -> Taught:
        """Each function from a namespace; those of chapter 47 from your notebook of it if they are not there."""
        return cls(namespace["gaussian_nll"], namespace["imagine"], sac.Taught.of(namespace))


@dataclass(frozen=True)
class MBPOSettings(sac.SACSettings):
    """Everything that one may choose, with defaults for Pendulum; `SACSettings` has the agent's."""

    total_steps: int = 1_500  # environment steps
    learning_starts: int = 200  # of these, with actions drawn evenly, before the first model
    batch_size: int = 128
    learning_rate: float = 1e-3
    hidden: int = 64
    gamma: float = 0.95
    tau: float = 0.01
    updates: int = 10  # of the agent, after each step
    horizon: int = 5  # steps of an imagined trajectory; 0: nothing is imagined, and all batches are real
    refresh_every: int = 100  # steps between two models, each of which goes on from the last
    refreshed: bool = True  # False: the first model is the last
    imagined_steps: int = 5_000  # with each model
    imagined_size: int = 10_000  # imagined steps kept
    real_fraction: float = 0.05  # of each batch
    members: int = 5
    elites: int = 3  # members that are dreamt with
    model_hidden: int = 128
    model_batch: int = 64
    model_learning_rate: float = 2e-3
    held_out: float = 0.2  # of the steps, to judge members on
    patience: int = 5  # epochs without a better member, after which a model is finished


def never(next_obs):
    """No state ends an episode: Pendulum and HalfCheetah."""
    return torch.zeros(len(next_obs), dtype=torch.bool)


def hopper_ended(next_obs):
    """(B,) bool for observations (B, 11) of Hopper-v5: too low, leaning too far, or out of bounds."""
    healthy = (next_obs[:, 0] > 0.7) & (next_obs[:, 1].abs() < 0.2) & (next_obs[:, 1:].abs() < 100).all(1)
    return ~healthy


def walker2d_ended(next_obs):
    """(B,) bool for observations (B, 17) of Walker2d-v5: too low, too high, or leaning too far."""
    return ~((next_obs[:, 0] > 0.8) & (next_obs[:, 0] < 2.0) & (next_obs[:, 1].abs() < 1.0))


ENDED = {"Pendulum-v1": never, "HalfCheetah-v5": never, "Hopper-v5": hopper_ended, "Walker2d-v5": walker2d_ended}
"""Which states end an episode, from Gymnasium's documentation: as in MBPO this is given to the agent, not learned."""


class Ensemble:
    """A model of the world, as `imagine` calls it: networks that were trained apart, each with its own errors.

    Args:
      obs_dim, action_dim: O, A.
      settings: MBPOSettings.
      gaussian_nll: the loss, chapter 51's.
      ended: function of next_obs (B, O) that tells which of them end an episode, (B,) bool.
      seed: of the first weights.
    """

    log_var_range = (-10.0, 0.5)  # soft bounds, in units of the normalised targets

    def __init__(self, obs_dim, action_dim, settings, gaussian_nll, ended=never, seed=0):
        self.settings, self.gaussian_nll, self.ended = settings, gaussian_nll, ended
        sizes = (obs_dim + action_dim, *(settings.model_hidden,) * 2, 2 * (obs_dim + 1))
        self.networks = Networks(sizes, settings.members, torch.Generator().manual_seed(seed))
        self.optimizer = Adam(self.networks.weights, settings.model_learning_rate)
        self.input_level, self.input_scale = torch.zeros(obs_dim + action_dim), torch.ones(obs_dim + action_dim)
        self.target_level, self.target_scale = torch.zeros(obs_dim + 1), torch.ones(obs_dim + 1)
        self.elites = torch.arange(settings.elites)

    def predict(self, inputs):
        """Mean and log_var, (E, B, O + 1) each, of normalised targets for normalised inputs (B, O + A) or (E, B, O + A)."""
        mean, log_var = self.networks(inputs).chunk(2, -1)
        lowest, highest = self.log_var_range
        log_var = highest - functional.softplus(highest - log_var)
        return mean, lowest + functional.softplus(log_var - lowest)

    @torch.no_grad()
    def distributions(self, obs, actions):
        """What each member expects of next_obs and the reward: mean and standard deviation, (E, B, O + 1) each, in their own units."""
        inputs = (torch.cat([obs, actions], -1) - self.input_level) / self.input_scale
        mean, log_var = self.predict(inputs)
        mean, std = self.target_level + self.target_scale * mean, self.target_scale * (0.5 * log_var).exp()
        mean[..., :-1] += obs
        return mean, std

    def __call__(self, obs, actions, generator):
        """A step from obs (B, O) with actions (B, A) in (-1, 1): next_obs (B, O), rewards (B,), continues (B,) of 0 and 1.

        Each row is drawn from the distribution of one elite member, itself drawn anew for each row and step.
        """
        mean, std = self.distributions(obs, actions)
        members = self.elites[torch.randint(len(self.elites), (len(obs),), generator=generator)]
        rows = torch.arange(len(obs))
        drawn = torch.addcmul(mean[members, rows], std[members, rows], torch.randn(mean.shape[1:], generator=generator))
        next_obs, rewards = drawn[:, :-1], drawn[:, -1]
        return next_obs, rewards, (~self.ended(next_obs)).to(obs.dtype)

    def fit(self, steps: Transitions, generator):
        """Go on training, until no member gets better on the steps that are held out; each then keeps its best weights.

        Each member learns from a sample of its own, drawn with replacement.

        Returns: model_loss (mean of the elites' held-out losses, nats) and model_epochs.
        """
        inputs, targets = self._normalised(steps)
        held_out, training = _split(len(inputs), self.settings.held_out, generator)
        own = training[torch.randint(len(training), (self.settings.members, len(training)), generator=generator)]
        weights = self.networks.weights.detach().view(self.settings.members, -1)
        best, best_weights = self._losses(inputs[held_out], targets[held_out]), weights.clone()
        epochs, waited = 0, 0
        while waited < self.settings.patience:
            for places in own[:, torch.randperm(own.shape[1], generator=generator)].split(self.settings.model_batch, 1):
                loss = self.gaussian_nll(*self.predict(inputs[places]), targets[places])
                sac.minimise(loss, self.optimizer)
            losses = self._losses(inputs[held_out], targets[held_out])
            better = losses < best - 0.01
            best[better], best_weights[better] = losses[better], weights[better]
            epochs, waited = epochs + 1, 0 if better.any() else waited + 1
        weights.copy_(best_weights)
        self.elites = best.argsort()[: self.settings.elites]
        return {"model_loss": best[self.elites].mean(), "model_epochs": torch.tensor(float(epochs))}

    def _normalised(self, steps):
        """Inputs (N, O + A) and targets (N, O + 1) at mean 0 and deviation 1; the scales are kept."""
        inputs = torch.cat([steps.obs, steps.actions], -1)
        targets = torch.cat([steps.next_obs - steps.obs, steps.rewards[:, None]], -1)
        self.input_level, self.input_scale = inputs.mean(0), inputs.std(0).clamp(min=1e-6)
        self.target_level, self.target_scale = targets.mean(0), targets.std(0).clamp(min=1e-6)
        return (inputs - self.input_level) / self.input_scale, (targets - self.target_level) / self.target_scale

    @torch.no_grad()
    def _losses(self, inputs, targets):
        """Each member's own loss, (E,)."""
        means, log_vars = self.predict(inputs)
        return torch.stack(
            [self.gaussian_nll(mean[None], log_var[None], targets) for mean, log_var in zip(means, log_vars, strict=True)]
        )

    def state_dict(self):
        """What `load_state_dict` needs to go on from here."""
        return {"optimizer": self.optimizer.state_dict()} | {
            name: tensor.detach().clone() for name, tensor in self._tensors().items()
        }

    @torch.no_grad()
    def load_state_dict(self, state):
        """Go on from `state_dict()`."""
        self.optimizer.load_state_dict(state["optimizer"])
        for name, tensor in self._tensors().items():
            tensor.copy_(state[name])

    def _tensors(self):
        scales = "input_level", "input_scale", "target_level", "target_scale", "elites"
        return {"weights": self.networks.weights} | {name: getattr(self, name) for name in scales}


def _split(count, fraction, generator):
    """Places 0 to count - 1 in a random order, cut in two: a fraction of them, and the rest."""
    order = torch.randperm(count, generator=generator)
    cut = max(1, round(fraction * count))
    return order[:cut], order[cut:]


def imagined_steps(dream) -> Transitions:
    """The steps of `imagine`'s trajectories as one batch, without those after an end."""
    goes_on = dream["continues"].bool()
    begins = torch.cat([torch.ones_like(goes_on[:1]), goes_on[:-1]])
    columns = dream["obs"][:-1], dream["actions"], dream["rewards"], dream["obs"][1:], ~goes_on
    return Transitions(*(column[begins] for column in columns))


class Training(sac.Training):
    """`sac.Training`, whose updates are fed by a model.

    Args:
      env: a Gymnasium environment with flat observations and bounded continuous actions.
      settings: MBPOSettings.
      seed: of the environment, the weights and all that is drawn: two runs with one seed are equal bit for bit.
      taught: the functions of chapters 51 and 47.
      ended: which next_obs end an episode; by default that of `ENDED` for this environment.
      update: of the agent, in place of `sac.update`.
    """

    def __init__(self, env, settings, seed, taught, ended=None, update=sac.update):
        super().__init__(env, settings, seed, taught.agent, update)
        self.imagine = taught.imagine
        sizes = env.observation_space.shape[0], len(self.agent.low)
        self.model = Ensemble(*sizes, settings, taught.gaussian_nll, ended or ENDED[env.spec.id], seed)
        self.imagined = ReplayBuffer(settings.imagined_size, *sizes)
        self.of_model: dict[str, torch.Tensor] = {}  # metrics of the last fit

    def learn(self):
        """What happens after each step: now and then a better model and new dreams, and always some updates of the agent."""
        since = self.env_steps - self.settings.learning_starts - 1
        if self.settings.horizon and since % self.settings.refresh_every == 0:
            if since == 0 or self.settings.refreshed:
                self.of_model = self.model.fit(self.buffer[torch.arange(len(self.buffer))], self.generator)
            self.dream()
        for _ in range(self.settings.updates):
            latest = self.update(self.agent, self.batch(), self.settings, self.taught, self.generator)
        return latest | self.of_model

    def dream(self):
        """Imagine trajectories from real states, with the policy as it is, and keep their steps."""
        count = self.settings.imagined_steps // self.settings.horizon
        starts = self.buffer.sample(count, self.generator).obs
        with torch.no_grad():
            dream = self.imagine(self.model, self.agent.act, starts, self.settings.horizon, self.generator)
        steps = imagined_steps(dream)
        self.imagined.add(steps.obs, steps.actions, steps.rewards, steps.next_obs, steps.terminated)

    def batch(self):
        """Imagined steps, with a few real ones among them; without a model, real ones."""
        size = self.settings.batch_size
        if not self.settings.horizon:
            return self.buffer.sample(size, self.generator)
        real = round(self.settings.real_fraction * size)
        columns = self.buffer.sample(real, self.generator), self.imagined.sample(size - real, self.generator)
        return Transitions(*(torch.cat(pair) for pair in zip(*columns, strict=True)))

    def state_dict(self):
        """As `sac.Training.state_dict`, with the model and its dreams."""
        of_model = {name: value.item() for name, value in self.of_model.items()}
        return super().state_dict() | {
            "model": self.model.state_dict(),
            "imagined": self.imagined.state_dict(),
            "of_model": of_model,
        }

    def load_state_dict(self, state):
        """Go on from `state_dict()`."""
        super().load_state_dict(state)
        self.model.load_state_dict(state["model"])
        self.imagined.load_state_dict(state["imagined"])
        self.of_model = {name: torch.tensor(value) for name, value in state["of_model"].items()}
