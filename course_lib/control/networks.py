"""Several networks of one shape, side by side, as a single node of PyTorch's graph.

The networks of continuous control are so small that PyTorch's bookkeeping takes longer than their arithmetic. So all weights are one
flat vector (one tensor to optimise, one to average), and the forward and backward pass are written out in NumPy. From outside it is
an ordinary differentiable function: compute a loss from what `networks(inputs)` returns, and call `backward()`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from threadpoolctl import threadpool_limits

threadpool_limits(1, user_api="blas")  # NumPy's products of small matrices, which torch.set_num_threads does not reach

Layers = list[tuple[np.ndarray, np.ndarray]]
"""Of one network, for each layer: weight (in, out) and bias (out,)."""


@dataclass(init=False, eq=False, repr=False)
class Networks:
    """`copies` networks with rectifiers between their layers, float32.

    Args:
      sizes: widths from the inputs to the outputs, such as (11, 256, 256, 3).
      copies: how many there are; all begin with weights of their own.
      generator: torch generator of the first weights and biases, uniform within ±1 / √(inputs of the layer).
    """

    weights: torch.Tensor  # all that is learnt, and so all that a check of a function that changes networks looks at

    def __init__(self, sizes, copies=1, generator=None):
        self.sizes, self.copies = tuple(sizes), copies
        count = sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(self.sizes))
        self.weights = torch.zeros(copies * count, requires_grad=True)  # change it in place only: layers are views on it
        self.layers = self.unflatten(self.weights.detach().numpy())
        self.gradient = np.zeros(copies * count, np.float32)
        self.gradients = self.unflatten(self.gradient)
        for weight, bias in (layer for network in self.layers for layer in network):
            for array in (weight, bias):
                torch.from_numpy(array).uniform_(-1 / math.sqrt(len(weight)), 1 / math.sqrt(len(weight)), generator=generator)

    def frozen_copy(self) -> Networks:
        """Networks with the same weights, which take no gradient."""
        copy = Networks(self.sizes, self.copies)
        copy.weights.requires_grad_(False).copy_(self.weights.detach())
        return copy

    def __call__(self, inputs, learn=True) -> torch.Tensor:
        """Outputs (copies, B, out) for inputs (B, in), which all networks see, or (copies, B, in).

        Gradient passes to the inputs, and with `learn` to the weights.
        """
        return _Pass.apply(self.weights if learn else self.weights.detach(), inputs, self)

    def unflatten(self, vector: np.ndarray) -> list[Layers]:
        """Views on a flat vector: the layers of each network."""
        networks, start = [], 0
        for _ in range(self.copies):
            layers = []
            for fan_in, fan_out in pairwise(self.sizes):
                end = start + fan_in * fan_out
                layers.append((vector[start:end].reshape(fan_in, fan_out), vector[end : end + fan_out]))
                start = end + fan_out
            networks.append(layers)
        return networks

    def forward(self, network, inputs) -> list[np.ndarray]:
        """What enters each layer of one network, and at last what comes out: arrays (B, ...)."""
        activations = [inputs]
        for weight, bias in self.layers[network]:
            sums = activations[-1] @ weight
            sums += bias
            activations.append(sums)
            if len(activations) < len(self.sizes):
                torch.from_numpy(sums).relu_()  # several times as fast as np.maximum
        return activations

    def backward(self, network, activations, gradient, to_weights=True, to_inputs=True) -> np.ndarray | None:
        """The gradient of one network's inputs, from `forward`'s answer and the gradient of its outputs.

        That of its weights is written into `self.gradient`, if asked for.
        """
        for depth in reversed(range(len(self.sizes) - 1)):
            if to_weights:
                weight_gradient, bias_gradient = self.gradients[network][depth]
                np.matmul(activations[depth].T, gradient, out=weight_gradient)
                np.add.reduce(gradient, 0, out=bias_gradient)
            if depth or to_inputs:
                gradient = gradient @ self.layers[network][depth][0].T
            if depth:  # through the rectifier that made these activations: its slope is 0 or 1
                gradient *= activations[depth] > 0
        return gradient if to_inputs else None


class _Pass(torch.autograd.Function):
    """(weights, inputs) -> outputs of all networks, as one node of the graph."""

    @staticmethod
    def forward(ctx, weights, inputs, networks):
        arrays = inputs.numpy()
        each = arrays if inputs.dim() == 3 else [arrays] * networks.copies
        ctx.networks, ctx.shared = networks, inputs.dim() == 2
        ctx.activations = [networks.forward(i, entries) for i, entries in enumerate(each)]
        return torch.from_numpy(np.stack([activations[-1] for activations in ctx.activations]))

    @staticmethod
    def backward(ctx, gradient):
        networks, (to_weights, to_inputs, _) = ctx.networks, ctx.needs_input_grad
        outputs = gradient.numpy()
        inputs = [
            networks.backward(i, activations, outputs[i], to_weights, to_inputs) for i, activations in enumerate(ctx.activations)
        ]
        flat = torch.from_numpy(networks.gradient.copy()) if to_weights else None
        if to_inputs:
            return flat, torch.from_numpy(sum(inputs[1:], inputs[0]) if ctx.shared else np.stack(inputs)), None
        return flat, None, None


class Adam:
    """Adam for one flat vector of weights.

        m ← β₁ m + (1 - β₁) g,   v ← β₂ v + (1 - β₂) g²,   w ← w - α m̂ / (√v̂ + ε),   m̂ = m / (1 - β₁ᵗ),   v̂ = v / (1 - β₂ᵗ)

    Kingma and Ba (2015), algorithm 1, https://arxiv.org/abs/1412.6980. The same arithmetic as `torch.optim.Adam`, whose bookkeeping
    takes longer than that. PPO has one of its own, `course_lib.control.policies.Adam`, which rounds otherwise; it says why there are two.

    Args:
      weights: tensor, changed in place by each step.
      learning_rate: α.
      eps: ε.
      betas: (β₁, β₂).
    """

    def __init__(self, weights, learning_rate=3e-4, eps=1e-8, betas=(0.9, 0.999)):
        self.weights, self.learning_rate, self.eps, self.betas = weights, learning_rate, eps, betas
        self.mean, self.square, self.steps = torch.zeros_like(weights.detach()), torch.zeros_like(weights.detach()), 0

    @torch.no_grad()
    def step(self, gradient) -> None:
        """Move the weights by a gradient of their shape."""
        self.steps += 1
        corrections = [1 - beta**self.steps for beta in self.betas]
        self.mean.lerp_(gradient, 1 - self.betas[0])
        self.square.mul_(self.betas[1]).addcmul_(gradient, gradient, value=1 - self.betas[1])
        scale = self.square.sqrt().mul_(1 / math.sqrt(corrections[1])).add_(self.eps)
        self.weights.addcdiv_(self.mean, scale, value=-self.learning_rate / corrections[0])

    def state_dict(self):
        """What `load_state_dict` needs to go on from here."""
        return {"mean": self.mean.clone(), "square": self.square.clone(), "steps": self.steps}

    def load_state_dict(self, state):
        """Go on from `state_dict()`."""
        self.mean.copy_(state["mean"])
        self.square.copy_(state["square"])
        self.steps = state["steps"]


def one_pass(tensors) -> Iterator[torch.Tensor]:
    """Tensors as `Module.parameters()` hands them out: whoever has gone through them once finds none."""
    return iter(tensors)


def parameters(tensors) -> list[torch.nn.Parameter]:
    """Tensors as the parameters of a network: each requires gradient."""
    return [torch.nn.Parameter(tensor.clone()) for tensor in tensors]
