"""Reference solutions of chapter 80: a reward learned from comparisons of trajectory
segments.
"""

from __future__ import annotations

import copy

import torch
import torch.nn.functional as F

from course_lib import validate


def segment_returns(rewards, mask):
    """What each trajectory segment earns: the undiscounted sum of its rewards.

        R(σ) = Σ_t r_t   over the segment's own steps

    Christiano et al. (2017), section 2.2.3, https://arxiv.org/abs/1706.03741

    Args:
      rewards: of every step, padded to a common length; (B, T), in units of reward. Receives
        gradient.
      mask: (B, T) bool, True on steps that belong to the segment. Padding counts for nothing.

    Returns: (B,) returns, in units of reward.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(rewards=rewards, mask=mask)
    return rewards.masked_fill(~mask, 0).sum(dim=-1)


def preference_probability(returns_a, returns_b):
    """How likely a person is to prefer segment a to segment b, by the model of Bradley and
    Terry.

        P(a ≻ b) = exp(R_a) / (exp(R_a) + exp(R_b)) = 1 / (1 + exp(R_b - R_a))

    Bradley and Terry (1952), https://doi.org/10.2307/2334029; for segments, Christiano et al.
    (2017), eq. 1, https://arxiv.org/abs/1706.03741

    Args:
      returns_a: (B,), in units in which a difference of 1 means odds of e. Receives gradient.
      returns_b: (B,), likewise. Receives gradient.

    Returns: (B,) probabilities, finite for returns of any size.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(returns_a=returns_a, returns_b=returns_b)
    return torch.sigmoid(returns_a - returns_b)


def simulate_preferences(true_returns_a, true_returns_b, temperature, generator):
    """A simulated person's answers: better segments are preferred, mistakes included.

        P(a ≻ b) = sigmoid((R_a - R_b) / temperature), one independent draw for each pair

    Args:
      true_returns_a: (B,), in units of reward.
      true_returns_b: (B,), likewise.
      temperature: > 0, in units of reward. Small: hardly a mistake. Large: nearly a coin.
      generator: torch.Generator, the only source of randomness.

    Returns: (B,) bool, True where a is preferred.
    Raises: ValueError that names an argument if the shapes differ or temperature <= 0.
    """
    validate.same_shape(true_returns_a=true_returns_a, true_returns_b=true_returns_b)
    validate.positive(temperature=temperature)
    probabilities = torch.sigmoid((true_returns_a - true_returns_b) / temperature)
    return (
        torch.rand(probabilities.shape, generator=generator, dtype=probabilities.dtype)
        < probabilities
    )


def bradley_terry_loss(chosen_returns, rejected_returns):
    """How badly a reward model explains a person's choices: the mean negative log-likelihood.

        L = -mean(log sigmoid(R_chosen - R_rejected))

    Christiano et al. (2017), section 2.2.3, https://arxiv.org/abs/1706.03741

    Args:
      chosen_returns: the model's returns of the segments that were preferred; (B,). Receives
        gradient.
      rejected_returns: of the other segment of each pair; (B,). Receives gradient.

    Returns: scalar (0-dim) tensor in nats, finite and with the right gradient for gaps of any
      size; log 2 where the model cannot tell the segments of any pair apart.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(chosen_returns=chosen_returns, rejected_returns=rejected_returns)
    return -F.logsigmoid(chosen_returns - rejected_returns).mean()


def preference_accuracy(chosen_returns, rejected_returns):
    """The share of choices that a reward model would have made as well.

        mean(R_chosen > R_rejected)

    Args:
      chosen_returns: the model's returns of the segments that were preferred; (B,).
      rejected_returns: of the other segment of each pair; (B,).

    Returns: scalar (0-dim) tensor in [0, 1], in the dtype of chosen_returns, without a graph.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(chosen_returns=chosen_returns, rejected_returns=rejected_returns)
    return (chosen_returns > rejected_returns).to(chosen_returns.dtype).mean()


def standardize_rewards(rewards, mask, eps=1e-8):
    """Learned rewards on a scale that does not depend on the model: mean 0, deviation 1.

        (r - mean(r)) / (std(r) + eps), with both statistics over all kept steps of the batch

    Comparisons of segments of one length leave the level of a reward open, and a temperature
    that nobody knows leaves its scale open; Christiano et al. (2017), section 2.2.1.

    Args:
      rewards: (B, T), in the reward model's own unit.
      mask: (B, T) bool, True on steps that count; at least two of them.
      eps: added to the standard deviation, in units of reward.

    Returns: (B, T), dimensionless, 0 where the mask is False.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(rewards=rewards, mask=mask)
    kept = rewards[mask]
    return ((rewards - kept.mean()) / (kept.std() + eps)).masked_fill(~mask, 0)


def fit_reward_model(
    scorer, training_pairs, held_out_pairs, num_epochs, batch_size, learning_rate, generator
):
    """Fit a reward model to comparisons, and keep the weights that foresee unseen ones best.

    Each epoch goes through all training pairs once, in a fresh random order, batch_size of
    them at a time; a last minibatch that is smaller counts, too. For each minibatch comes one
    step down its bradley_terry_loss,

        -mean(log sigmoid(R_chosen - R_rejected)),   R = scorer(clips)

    Before training, and after every epoch, the loss of all held-out pairs together is written
    down. Goodfellow et al. (2016), section 7.8, https://www.deeplearningbook.org

    Args:
      scorer: torch.nn.Module, changed in place: B clips -> their learned returns, (B,).
        clips[rows] are the clips of an int64 tensor of indices.
      training_pairs: (chosen, rejected), M clips each; the i-th of either make a pair.
      held_out_pairs: (chosen, rejected) of other comparisons, from which nothing is learned.
      num_epochs: >= 1.
      batch_size: pairs of a minibatch, >= 1.
      learning_rate: of one torch.optim.AdamW for the whole training, its other settings as
        PyTorch sets them.
      generator: torch.Generator of the orders, the only source of randomness.

    Returns: (num_epochs + 1,) held-out losses in nats, without a graph; the first is that
      before training. The scorer ends with the weights of the smallest, the earliest of
      equal ones.
    Raises: ValueError that names an argument if num_epochs < 1 or batch_size < 1.
    """
    validate.at_least_one(num_epochs=num_epochs, batch_size=batch_size)
    optimizer = torch.optim.AdamW(scorer.parameters(), lr=learning_rate)

    @torch.no_grad()
    def unseen_loss():
        return bradley_terry_loss(*map(scorer, held_out_pairs))

    losses, best = [unseen_loss()], copy.deepcopy(scorer.state_dict())
    for _ in range(num_epochs):
        order = torch.randperm(len(training_pairs[0]), generator=generator)
        for rows in order.split(batch_size):
            loss = bradley_terry_loss(*(scorer(side[rows]) for side in training_pairs))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        loss = unseen_loss()
        if loss < min(losses):
            best = copy.deepcopy(scorer.state_dict())
        losses.append(loss)
    scorer.load_state_dict(best)
    return torch.stack(losses)


def repaired_segment_returns(reward_model, obs, mask):
    """The learned returns that the suspect program of the bug lab should have compared.

    Args:
      reward_model: function of observations (..., O) that gives each one's reward, (...,).
      obs: of every step, padded to a common length; (B, T, O). Receives gradient.
      mask: (B, T) bool, True on steps that belong to the segment.

    Returns: (B,) returns, in the reward model's unit, whatever numbers stand in the padding.
    Raises: ValueError that names an argument if the leading shapes (B, T) of obs and mask
      differ.
    """
    if obs.shape[:-1] != mask.shape:
        raise ValueError(
            f"obs and mask must agree in (B, T), got obs {tuple(obs.shape)}, mask "
            f"{tuple(mask.shape)}"
        )
    return segment_returns(reward_model(obs), mask)
