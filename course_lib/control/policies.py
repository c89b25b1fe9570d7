"""Small actor-critic networks for continuous and discrete actions, an optimiser for them, and their file format.

The networks are so small that the overhead of each PyTorch operation (microseconds) exceeds its arithmetic, and that of building
and walking a graph exceeds both. So all weights of a policy are one flat vector, and its forward and backward pass are written out
in NumPy inside a single node of PyTorch's graph. From outside it is an ordinary differentiable function: compute a loss from
what `policy(obs)` returns, call `backward()`, and the gradient is in `policy.weights.grad`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import safetensors
import safetensors.torch
import torch
from threadpoolctl import threadpool_limits

threadpool_limits(1, user_api="blas")  # NumPy's products of small matrices, which torch.set_num_threads does not reach

LAYERS = ("0", "1", "out")
LANDER = {"obs_dim": 8, "action_dim": 2, "discrete": False, "hidden": 64}
"""The architecture of a policy for LunarLanderContinuous that the course can fly: `make_policy(**LANDER)`."""


class Gaussian(NamedTuple):
    """Independent normal actions: mean (..., A), and the logarithm of the standard deviation, the same in every state, (A,)."""

    mean: torch.Tensor
    log_std: torch.Tensor


class Categorical(NamedTuple):
    """One of A actions: logits (..., A), unnormalised log-probabilities."""

    logits: torch.Tensor


def tensor_shapes(obs_dim, action_dim, discrete=False, hidden=64) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a policy's tensors, in the order of the flat vector; weights are (inputs, outputs)."""
    shapes: dict[str, tuple[int, ...]] = {}
    for network, outputs in (("actor", action_dim), ("critic", 1)):
        for layer, (fan_in, fan_out) in zip(LAYERS, ((obs_dim, hidden), (hidden, hidden), (hidden, outputs)), strict=True):
            shapes[f"{network}.{layer}.weight"] = (fan_in, fan_out)
            shapes[f"{network}.{layer}.bias"] = (fan_out,)
    return shapes if discrete else shapes | {"log_std": (action_dim,)}


LANDER_SHAPES = tensor_shapes(**LANDER) | {"obs_mean": (8,), "obs_std": (8,)}
"""The tensors of a lander's file, all float32."""


@dataclass(eq=False)
class ActorCritic:
    """Two networks of two hidden layers (tanh), one for the actions' distribution, one for the value; make one with `make_policy`.

    Observations enter as (obs - obs_mean) / obs_std. All methods take obs (..., obs_dim), as tensor or array.
    """

    obs_dim: int
    action_dim: int  # A: components of a continuous action, or number of discrete ones
    discrete: bool
    hidden: int
    weights: torch.Tensor  # all parameters in one vector, laid out by tensor_shapes; change it in place only
    obs_mean: torch.Tensor  # (obs_dim,)
    obs_std: torch.Tensor  # (obs_dim,)
    observed: int = 0  # observations that the two were computed from

    def __post_init__(self):
        self.shapes = tensor_shapes(self.obs_dim, self.action_dim, self.discrete, self.hidden)
        self.arrays = self.unflatten(self.weights.detach().numpy())  # views: they follow the vector
        self.gradient = np.zeros_like(self.weights.detach().numpy())
        self.gradients = self.unflatten(self.gradient)

    def __deepcopy__(self, memo) -> ActorCritic:
        """A policy of its own: plain copying would lose that the arrays are views on the weights."""
        weights = self.weights.detach().clone().requires_grad_()
        return replace(self, weights=weights, obs_mean=self.obs_mean.clone(), obs_std=self.obs_std.clone())

    def __call__(self, obs) -> tuple[Gaussian | Categorical, torch.Tensor]:
        """The distribution of actions in each state, and the values (...,); both pass gradient to `weights`."""
        inputs = self.normalize(obs)
        outputs, log_std, values = _Networks.apply(self.weights, self, inputs.reshape(-1, self.obs_dim))
        outputs, values = outputs.view(*inputs.shape[:-1], -1), values.view(inputs.shape[:-1])
        return (Categorical(outputs) if self.discrete else Gaussian(outputs, log_std)), values

    def value(self, obs) -> torch.Tensor:
        """V(obs), (...,), without a graph."""
        return torch.from_numpy(self.forward("critic", self.normalize(obs))[-1][..., 0])

    def act(self, obs, generator) -> torch.Tensor:
        """Sample actions, (..., A) or (...,) int64, without a graph; `generator` is all that is drawn from."""
        outputs = torch.from_numpy(self.forward("actor", self.normalize(obs))[-1])
        if self.discrete:  # the Gumbel trick: argmax of logits + noise is a draw from softmax(logits)
            noise = torch.empty_like(outputs).exponential_(generator=generator).log()
            return (outputs - noise).argmax(-1)
        noise = torch.randn(outputs.shape, generator=generator, dtype=outputs.dtype)
        return outputs.addcmul_(noise, torch.from_numpy(np.exp(self.arrays["log_std"])))

    def best_action(self, obs) -> torch.Tensor:
        """The likeliest action, (..., A) or (...,) int64, without a graph."""
        outputs = torch.from_numpy(self.forward("actor", self.normalize(obs))[-1])
        return outputs.argmax(-1) if self.discrete else outputs

    def observe(self, obs) -> None:
        """Let the scaling of observations follow all that were passed here since the beginning: obs (B, obs_dim).

        This changes the policy, a little less each time. Between an action and the update that learns from it, leave it alone.
        """
        total = self.observed + len(obs)
        mean, var = obs.mean(0), obs.var(0, correction=0)
        shift, share = mean - self.obs_mean, len(obs) / total
        var = (1 - share) * self.obs_std.square() + share * var + share * (1 - share) * shift.square()
        self.obs_mean += share * shift
        self.obs_std.copy_(var.sqrt().clamp(min=1e-4))
        self.observed = total

    def tensors(self) -> dict[str, torch.Tensor]:
        """The parameters by name: views on `weights`."""
        return {name: torch.from_numpy(array) for name, array in self.arrays.items()}

    def unflatten(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        """Views on a flat vector by the names of the parameters."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes.values()])
        return {
            name: part.reshape(shape)
            for (name, shape), part in zip(self.shapes.items(), np.split(vector, ends[:-1]), strict=True)
        }

    def normalize(self, obs) -> np.ndarray:
        """(obs - obs_mean) / obs_std, an array of the type of the weights."""
        obs = obs.numpy() if isinstance(obs, torch.Tensor) else np.asarray(obs)
        return ((obs - self.obs_mean.numpy()) / self.obs_std.numpy()).astype(self.arrays["actor.0.bias"].dtype, copy=False)

    def forward(self, network, inputs) -> list[np.ndarray]:
        """What enters each of the three layers of "actor" or "critic", and at last what comes out: arrays (B, ...)."""
        activations = [inputs]
        for layer in LAYERS:
            sums = activations[-1] @ self.arrays[f"{network}.{layer}.weight"]
            sums += self.arrays[f"{network}.{layer}.bias"]
            activations.append(sums if layer == "out" else np.tanh(sums, out=sums))
        return activations

    def backward(self, network, activations, gradient) -> None:
        """Write the gradient of a network's weights into `self.gradient`, from `forward`'s answer and its output's gradient."""
        for layer, inputs in zip(reversed(LAYERS), reversed(activations[:-1]), strict=True):
            np.matmul(inputs.T, gradient, out=self.gradients[f"{network}.{layer}.weight"])
            np.add.reduce(gradient, 0, out=self.gradients[f"{network}.{layer}.bias"])
            if layer != "0":  # through the tanh that made these inputs: its derivative is 1 - tanh²
                gradient = gradient @ self.arrays[f"{network}.{layer}.weight"].T
                slope = inputs * inputs
                gradient *= np.subtract(1, slope, out=slope)


class _Networks(torch.autograd.Function):
    """(weights) -> (actor's outputs, log_std, values): both networks as one node of the graph."""

    @staticmethod
    def forward(ctx, weights, policy, inputs):
        ctx.policy, ctx.actor, ctx.critic = policy, policy.forward("actor", inputs), policy.forward("critic", inputs)
        log_std = policy.arrays.get("log_std", np.empty(0, inputs.dtype)).copy()
        return tuple(map(torch.from_numpy, (ctx.actor[-1], log_std, ctx.critic[-1][:, 0])))

    @staticmethod
    def backward(ctx, outputs_gradient, log_std_gradient, values_gradient):
        policy = ctx.policy
        policy.backward("actor", ctx.actor, outputs_gradient.numpy())
        policy.backward("critic", ctx.critic, values_gradient.numpy()[:, None])
        if not policy.discrete:
            policy.gradients["log_std"][:] = log_std_gradient.numpy()
        return torch.from_numpy(policy.gradient.copy()), None, None


def make_policy(obs_dim, action_dim, discrete=False, hidden=64, log_std=0.0, seed=0) -> ActorCritic:
    """A new policy with orthogonal weights and zero biases.

    The gains are √2 in the hidden layers, 0.01 for the actions (all states begin with nearly the same distribution) and 1 for the
    value: Andrychowicz et al. (2021), section 3.2, https://arxiv.org/abs/2006.05990

    Args:
      obs_dim: components of an observation.
      action_dim: components of a continuous action, or number of discrete ones.
      discrete: whether the actions are discrete.
      hidden: width of the hidden layers.
      log_std: logarithm of the first standard deviation of continuous actions.
      seed: of the weights.
    """
    count = sum(math.prod(shape) for shape in tensor_shapes(obs_dim, action_dim, discrete, hidden).values())
    weights = torch.zeros(count, requires_grad=True)
    policy = ActorCritic(obs_dim, action_dim, discrete, hidden, weights, torch.zeros(obs_dim), torch.ones(obs_dim))
    gains = {"actor.out.weight": 0.01, "critic.out.weight": 1.0}
    generator = torch.Generator().manual_seed(seed)
    for name, tensor in policy.tensors().items():
        if name.endswith("weight"):
            torch.nn.init.orthogonal_(tensor, gains.get(name, math.sqrt(2)), generator=generator)
        elif name == "log_std":
            tensor.fill_(log_std)
    return policy


def policy_for(envs, hidden=64, log_std=0.0, seed=0) -> ActorCritic:
    """A new policy for a vector environment with flat observations."""
    actions = envs.single_action_space
    discrete = isinstance(actions, gym.spaces.Discrete)
    action_dim = int(actions.n) if discrete else actions.shape[0]
    return make_policy(envs.single_observation_space.shape[0], action_dim, discrete, hidden, log_std, seed)


@dataclass(eq=False)
class Adam:
    """Adam for a policy's one vector of weights, with the clipping of the gradient's norm that precedes it in PPO.

        m ← β₁ m + (1 - β₁) g,   v ← β₂ v + (1 - β₂) g²,   w ← w - α m̂ / (√v̂ + ε),   m̂ = m / (1 - β₁ᵗ),   v̂ = v / (1 - β₂ᵗ)

    Kingma and Ba (2015), algorithm 1, https://arxiv.org/abs/1412.6980. The same arithmetic as `torch.nn.utils.clip_grad_norm_` and
    `torch.optim.Adam`, in a tenth of their time. It belongs to the policy of its first step.

    There is another in `course_lib.control.networks`, and both must stay: NumPy and PyTorch round a moving average differently, so that
    recorded runs of PPO would not repeat bit for bit with the other, nor those of SAC with this one. At PPO's ten thousand weights this
    one is also the quicker of the two, at SAC's hundred thousand the slower.
    """

    learning_rate: float = 3e-4
    eps: float = 1e-5  # as in most implementations of PPO; PyTorch's own default is 1e-8
    betas: tuple[float, float] = (0.9, 0.999)
    steps: int = 0
    moments: list[np.ndarray] = field(default_factory=list)

    def step(self, policy, max_grad_norm=float("inf")) -> float:
        """Move `policy.weights` by the gradient in `policy.weights.grad`, shortened to max_grad_norm; returns its length before."""
        weights, gradient = policy.weights.detach().numpy(), policy.weights.grad.numpy()
        norm = math.sqrt(gradient @ gradient)
        if norm > max_grad_norm:
            gradient = gradient * gradient.dtype.type(max_grad_norm / (norm + 1e-6))
        if not self.moments:
            self.moments = [np.zeros_like(weights), np.zeros_like(weights)]
        self.steps += 1
        for moment, beta, latest in zip(self.moments, self.betas, (gradient, gradient * gradient), strict=True):
            moment *= beta
            moment += (1 - beta) * latest
        corrections = [1 - beta**self.steps for beta in self.betas]
        scale = np.sqrt(self.moments[1])
        scale *= 1 / math.sqrt(corrections[1])
        scale += self.eps
        weights -= (self.learning_rate / corrections[0]) * self.moments[0] / scale
        return norm


def save_policy(policy, path) -> None:
    """Write a policy as a safetensors file: its parameters by name, `obs_mean` and `obs_std`."""
    tensors = {name: tensor.clone() for name, tensor in policy.tensors().items()}
    tensors |= {"obs_mean": policy.obs_mean, "obs_std": policy.obs_std}
    safetensors.torch.save_file(tensors, Path(path))


def load_policy(path) -> ActorCritic:
    """Read what `save_policy` wrote.

    Raises: ValueError if names, shapes or types are not those of a policy, or a number is not finite.
    """
    tensors = safetensors.torch.load_file(Path(path))
    try:
        obs_dim, hidden = tensors["actor.0.weight"].shape
        action_dim = tensors["actor.out.bias"].shape[0]
    except (KeyError, ValueError, IndexError):
        raise ValueError(f"{path} must hold the tensors of a policy, got {sorted(tensors)}") from None
    policy = make_policy(obs_dim, action_dim, "log_std" not in tensors, hidden)
    copy_tensors(policy, tensors, path)
    return policy


def copy_tensors(policy, tensors, source) -> None:
    """Put named tensors into a policy, in place, if they fit.

    Raises: ValueError that names `source` if names, shapes or types differ from the policy's, or a number is not finite.
    """
    targets = policy.tensors() | {"obs_mean": policy.obs_mean, "obs_std": policy.obs_std}
    expected = {name: tuple(tensor.shape) for name, tensor in targets.items()}
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if expected != found:
        raise ValueError(f"{source} must hold tensors of these shapes: {expected}, got {found}")
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32 or not tensor.isfinite().all():
            raise ValueError(f"{source}: {name} must hold finite float32 numbers, got {tensor.dtype}")
        targets[name].copy_(tensor)
    if not (policy.obs_std > 0).all():
        raise ValueError(f"{source}: obs_std must be positive, got {policy.obs_std.tolist()}")
