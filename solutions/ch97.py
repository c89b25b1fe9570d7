"""Reference solutions of chapter 97: direct preference optimisation and what its
derivation rests on.
"""

from __future__ import annotations

import torch
from torch.nn import functional

from course_lib import validate


def sequence_logps(logits, input_ids, completion_mask):
    """Log-probability of each completion: the sum over its tokens.

        log π(y|x) = Σ_{t kept} log softmax(logits_{t-1})[input_ids_t]

    Args:
      logits: those at position t predict the token at t + 1; (B, L, V). Receives
        gradient.
      input_ids: prompts with completions; (B, L) int64.
      completion_mask: True at the completion's tokens, aligned with input_ids; column 0
        is predicted by nothing and never counts; (B, L) bool.

    Returns: (B,) log-probabilities in nats.
    Raises: ValueError that names an argument if batch or length differ.
    """
    validate.same_shape(
        logits=logits[..., 0], input_ids=input_ids, completion_mask=completion_mask
    )
    logps = logits[:, :-1].log_softmax(-1).gather(-1, input_ids[:, 1:, None]).squeeze(-1)
    return torch.where(completion_mask[:, 1:], logps, 0).sum(1)


def dpo_loss(
    chosen_logps,
    rejected_logps,
    ref_chosen_logps,
    ref_rejected_logps,
    beta=0.1,
    label_smoothing=0.0,
):
    """Direct preference optimisation: a reward model's loss in which the policy is the reward
    model.

        loss = -(1 - s) log σ(x) - s log σ(-x),
        x = β [(chosen - ref_chosen) - (rejected - ref_rejected)]

    Rafailov et al. (2023), eq. 7, https://arxiv.org/abs/2305.18290; smoothing: Mitchell
    (2023), "conservative DPO".

    Args:
      chosen_logps, rejected_logps: log π(y|x) of the preferred and the other completion
        under the policy, summed over tokens, in nats; (B,). Receive gradient.
      ref_chosen_logps, ref_rejected_logps: the same under the frozen reference; (B,).
        No gradient.
      beta: β > 0; the larger, the closer the policy stays to the reference.
      label_smoothing: s in [0, 0.5), the assumed share of labels that are wrong.

    Returns: losses, chosen_rewards, rejected_rewards; (B,) each. The implicit rewards,
      β (log π - log π_ref), carry no graph.
    Raises: ValueError that names an argument if the shapes differ, beta ≤ 0, or
      label_smoothing is outside [0, 0.5).
    """
    validate.same_shape(
        chosen_logps=chosen_logps,
        rejected_logps=rejected_logps,
        ref_chosen_logps=ref_chosen_logps,
        ref_rejected_logps=ref_rejected_logps,
    )
    validate.positive(beta=beta)
    if not 0 <= label_smoothing < 0.5:
        raise ValueError(f"label_smoothing must lie in [0, 0.5), got {label_smoothing}")
    chosen_rewards = beta * (chosen_logps - ref_chosen_logps.detach())
    rejected_rewards = beta * (rejected_logps - ref_rejected_logps.detach())
    margins = chosen_rewards - rejected_rewards
    right, wrong = functional.logsigmoid(margins), functional.logsigmoid(-margins)
    losses = -(1 - label_smoothing) * right - label_smoothing * wrong
    return losses, chosen_rewards.detach(), rejected_rewards.detach()


def ipo_loss(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, beta=0.1):
    """Identity preference optimisation: the margin is pulled to a finite target, not to
    infinity.

        loss = [(chosen - ref_chosen) - (rejected - ref_rejected) - 1 / (2 β)]²

    Azar et al. (2024), eq. 17, https://arxiv.org/abs/2310.12036 (β is their τ)

    Args:
      chosen_logps, rejected_logps: log-probabilities under the policy, in nats, as given:
        not divided by lengths here; (B,). Receive gradient.
      ref_chosen_logps, ref_rejected_logps: the same under the frozen reference; (B,).
        No gradient.
      beta: β > 0; the larger, the smaller the margin aimed at.

    Returns: (B,) losses, in nats squared.
    Raises: ValueError that names an argument if the shapes differ or beta ≤ 0.
    """
    validate.same_shape(
        chosen_logps=chosen_logps,
        rejected_logps=rejected_logps,
        ref_chosen_logps=ref_chosen_logps,
        ref_rejected_logps=ref_rejected_logps,
    )
    validate.positive(beta=beta)
    margins = (chosen_logps - ref_chosen_logps.detach()) - (
        rejected_logps - ref_rejected_logps.detach()
    )
    return (margins - 1 / (2 * beta)) ** 2


def kl_optimal_policy(ref_probs, rewards, beta):
    """The policy that RLHF would reach with all the time in the world.

        π*(y) = π_ref(y) exp(r(y) / β) / Z,   the maximum over π of  E_π[r] - β KL(π ‖ π_ref)

    Rafailov et al. (2023), eq. 4, https://arxiv.org/abs/2305.18290

    Args:
      ref_probs: π_ref, sums to 1 over the last axis; an answer that it never gives
        stays impossible; (..., Y).
      rewards: r, of any size, finite; (..., Y).
      beta: β > 0, in units of reward per nat.

    Returns: (..., Y) probabilities, sum to 1 over the last axis.
    Raises: ValueError that names an argument if the shapes differ or beta ≤ 0.
    """
    validate.same_shape(ref_probs=ref_probs, rewards=rewards)
    validate.positive(beta=beta)
    return (ref_probs.log() + rewards / beta).softmax(-1)


def dpo_epoch(
    policy, reference, pairs, batches, beta=0.1, learning_rate=2e-4, max_grad_norm=1.0
):
    """One epoch of direct preference optimisation: a step for each batch of pairs.

    Each step goes down the mean of dpo_loss over its batch, without label smoothing, by one
    torch.optim.AdamW for all steps, without weight decay; a gradient whose norm over all of
    the policy's parameters is larger than max_grad_norm is shortened to that first.
    Rafailov et al. (2023), eq. 7, https://arxiv.org/abs/2305.18290

    Args:
      policy: torch.nn.Module, changed in place, and left in the mode (train or eval) that it
        is in: policy.logits(input_ids, attention_mask) gives (B, L, V) for (B, L) each.
      reference: a module like it; never changed.
      pairs: input_ids, attention_mask and completion_mask of M pairs, (M, 2, L) each, the
        chosen text first. pairs.of(rows) has the same three for the pairs of an int64 tensor
        of indices, without the columns that are padding in all of them.
      batches: an iterable of such tensors, gone through once, in its order.
      beta: β > 0.
      learning_rate: of AdamW.
      max_grad_norm: > 0.

    Returns: dict of (steps,) tensors without a graph: loss, and the means of accuracy (1 where
      the chosen text has the larger implicit reward), chosen_rewards and rejected_rewards,
      over each batch as it was before its step.
    Raises: ValueError that names an argument if beta ≤ 0.
    """
    validate.positive(beta=beta)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=learning_rate, weight_decay=0.0)
    rows = []
    for picked in batches:
        # (B, 2, L) to (2 B, L): chosen and rejected texts alternate
        input_ids, attention_mask, mask = (part.flatten(0, 1) for part in pairs.of(picked))
        logps = sequence_logps(policy.logits(input_ids, attention_mask), input_ids, mask)
        with torch.no_grad():
            ref_logits = reference.logits(input_ids, attention_mask)
            ref_logps = sequence_logps(ref_logits, input_ids, mask)
        sides = logps[0::2], logps[1::2], ref_logps[0::2], ref_logps[1::2]
        losses, chosen_rewards, rejected_rewards = dpo_loss(*sides, beta)
        loss = losses.mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), max_grad_norm)
        optimizer.step()
        right = (chosen_rewards > rejected_rewards).to(logps.dtype)
        rows.append([part.mean() for part in (loss, right, chosen_rewards, rejected_rewards)])
    names = ("loss", "accuracy", "chosen_rewards", "rejected_rewards")
    columns = zip(*rows, strict=True)
    return {
        name: torch.stack(column).detach() for name, column in zip(names, columns, strict=True)
    }


def repaired_completion_mask(attention_mask, prompt_tokens):
    """Which tokens of each text the suspect program of the bug lab should have counted.

    Args:
      attention_mask: True at a text's own tokens, prompt and end token included, False at
        padding on either side; (B, L) bool.
      prompt_tokens: how many of a text's own tokens are its prompt; (B,) int64.

    Returns: (B, L) bool, True at the tokens that the policy would have to write.
    Raises: ValueError that names an argument if the numbers of rows differ.
    """
    validate.same_length(attention_mask=attention_mask, prompt_tokens=prompt_tokens)
    return attention_mask & (attention_mask.cumsum(1) > prompt_tokens[:, None])
