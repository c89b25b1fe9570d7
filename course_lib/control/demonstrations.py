"""What an expert did, step by step: the data of imitation learning."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Demonstrations:
    """M steps of E episodes, one after another; row m holds what the expert saw and what it did then."""

    obs: torch.Tensor  # (M, O) float32, before the action
    actions: torch.Tensor  # (M, A) float32, as the expert chose them, or (M,) int64 for discrete ones
    episode_ids: torch.Tensor  # (M,) int64: 0, …, 0, 1, …, E - 1
    returns: torch.Tensor  # (E,) float32, undiscounted, in units of reward


def recorded(obs, actions, episode_ids, returns):
    """Demonstrations of numbers of any precision: obs, returns and actions that are no indices become float32."""
    actions = actions.float() if actions.is_floating_point() else actions
    return Demonstrations(obs.float(), actions, episode_ids, returns.float())


class SquaredError:
    """A loss: the mean of (gain · output - action)², for `loss_fn(outputs, actions)`."""

    def __init__(self, gain=1.0):
        self.gain = gain

    def __call__(self, outputs, actions):
        return (self.gain * outputs - actions).square().mean()


class RowCount:
    """A loss that tells how many rows it was given, for `loss_fn(outputs, actions)`; its gradient is 0."""

    def __call__(self, outputs, actions):
        return 0 * outputs.sum() + len(actions)


class Clone(torch.nn.Module):
    """A network that imitates: two hidden layers (tanh) from an observation to the mean of normal actions, and one σ for all states.

    Called with obs (B, O), it returns (mean (B, A), log_std (A,)); as a policy, `act` gives the mean. Observations enter as
    (obs - mean) / std, with the statistics of the observations it was made with, which never change afterwards.

    Args:
      train_obs: (M, O), what it will be trained on; a dimension that is constant there is not scaled.
      action_dim: A.
      hidden: width of the hidden layers.
    """

    def __init__(self, train_obs, action_dim, hidden=64):
        super().__init__()
        std = train_obs.std(0)
        self.register_buffer("obs_mean", train_obs.mean(0))
        self.register_buffer("obs_std", torch.where(std > 1e-6, std, 1.0))
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(train_obs.shape[1], hidden),
            torch.nn.Tanh(),
            torch.nn.Linear(hidden, hidden),
            torch.nn.Tanh(),
            torch.nn.Linear(hidden, action_dim),
        )
        self.log_std = torch.nn.Parameter(torch.zeros(action_dim))

    def forward(self, obs):
        """See the class."""
        return self.layers((obs - self.obs_mean) / self.obs_std), self.log_std

    def act(self, obs):
        """The likeliest action, (B, A)."""
        return self(obs)[0]
