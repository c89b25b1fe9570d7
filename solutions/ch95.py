"""Reference solutions of chapter 95: PPO on the tokens of a language model, under masks."""

from __future__ import annotations

import torch

from course_lib import validate


def per_token_logps(logits, input_ids):
    """How likely the model found each token, given those before it.

        logps_t = log softmax(logits_t)[input_ids_{t+1}],   t = 0, …, L - 2

    The logits at position t predict the token at t + 1; the first token is predicted
    by nothing and has no log-probability.

    Args:
      logits: unnormalised log-probabilities of the next token; (B, L, V). Receives
        gradient.
      input_ids: the tokens; (B, L) int64.

    Returns: (B, L - 1) log-probabilities in nats, of input_ids[:, 1:].
    Raises: ValueError that names an argument if batch or length differ.
    """
    validate.same_shape(logits=logits[..., 0], input_ids=input_ids)
    return logits[:, :-1].log_softmax(-1).gather(-1, input_ids[:, 1:, None]).squeeze(-1)


def completion_mask(input_ids, prompt_lengths, eos_token_id):
    """Which tokens the policy chose: from the end of the prompt to the first end token.

        mask_t = [prompt_length ≤ t ≤ end],   end = min{t ≥ prompt_length : input_ids_t = eos}

    The end token itself is a choice and is kept. An end token within the prompt, or
    used as padding before it, ends nothing.

    Args:
      input_ids: prompts with completions; (B, L) int64.
      prompt_lengths: the column where each row's completion begins, whatever padding
        precedes the prompt; (B,) int64.
      eos_token_id: the end token.

    Returns: (B, L) bool, True from column prompt_lengths[b] up to and including the
      first end token at or after it, or up to the last column if there is none.
    Raises: ValueError that names an argument if the batch sizes differ.
    """
    validate.same_shape(prompt_lengths=prompt_lengths, input_ids=input_ids[:, 0])
    columns = torch.arange(input_ids.shape[1], device=input_ids.device)
    completion = columns >= prompt_lengths[:, None]  # (B, L)
    ends = (input_ids == eos_token_id) & completion
    ended_before = ends.cumsum(1) - ends.long() > 0
    return completion & ~ended_before


def kl_penalized_rewards(scores, logps, ref_logps, mask, kl_coef):
    """One reward for each token: a penalty for leaving the reference, and the score at the
    end.

        r_t = -β (log π(t) - log π_ref(t)) + score · [t is the row's last kept token]

    Ziegler et al. (2019), eq. 2, https://arxiv.org/abs/1909.08593, token by token.

    Args:
      scores: of the whole completions; (B,).
      logps: log-probabilities of the tokens under the policy that sampled them, in
        nats; (B, L').
      ref_logps: the same under the frozen reference; (B, L').
      mask: True at the completion's tokens, at least one in each row; (B, L') bool.
      kl_coef: β, in units of score per nat.

    Returns: (B, L') rewards without a graph, 0 where the mask is False.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(logps=logps, ref_logps=ref_logps, mask=mask)
    validate.same_shape(scores=scores, logps=logps[:, 0])
    with torch.no_grad():
        rewards = torch.where(mask, -kl_coef * (logps - ref_logps), 0)
        columns = torch.arange(mask.shape[1], device=mask.device)
        last = torch.where(mask, columns, -1).argmax(1)  # (B,)
        rewards[torch.arange(len(rewards)), last] += scores
        return rewards


def masked_mean(x, mask):
    """Mean over the kept entries of the whole batch.

        Σ_{kept} x / (number of kept entries)

    Not the mean of row means: that would make a token of a short row count for more.

    Args:
      x: any numbers; (B, L').
      mask: True = keep; (B, L') bool.

    Returns: scalar (0-dim) tensor.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(x=x, mask=mask)
    return x[mask].mean()


def masked_whiten(x, mask, eps=1e-8):
    """Shift and scale the kept entries to zero mean and unit deviation.

        (x - mean) / sqrt(variance + ε),   both over all kept entries of the batch

    Args:
      x: any numbers, such as advantages; (B, L').
      mask: True = keep; (B, L') bool.
      eps: ε ≥ 0, keeps constant entries from dividing by 0.

    Returns: (B, L'), 0 where the mask is False.
    Raises: ValueError that names an argument if the shapes differ.
    """
    mean = masked_mean(x, mask)
    variance = masked_mean((x - mean) ** 2, mask)
    return torch.where(mask, (x - mean) / (variance + eps).sqrt(), 0)


def masked_gae(rewards, values, mask, gamma, gae_lambda):
    """Generalised advantage estimates over the tokens of each completion.

        A_t = δ_t + γ λ A_{t+1},   δ_t = r_t + γ V_{t+1} - V_t

    V and A behind a row's last kept token are 0: the text ends there, nothing follows.
    Schulman et al. (2016), eq. 16, https://arxiv.org/abs/1506.02438

    Args:
      rewards: r_t, in units of score; (B, L').
      values: V_t, the critic's estimate before token t is chosen; (B, L').
      mask: True at the completion's tokens, contiguous in each row; (B, L') bool.
      gamma: discount per token, in [0, 1].
      gae_lambda: λ in [0, 1].

    Returns: (B, L') advantages without a graph, 0 where the mask is False.
    Raises: ValueError that names an argument if shapes differ, or gamma or gae_lambda lies
      outside [0, 1].
    """
    validate.same_shape(rewards=rewards, values=values, mask=mask)
    validate.unit_interval(gamma=gamma, gae_lambda=gae_lambda)
    advantages = torch.zeros_like(values)
    next_value = next_advantage = torch.zeros_like(values[:, 0])
    with torch.no_grad():
        for t in reversed(range(values.shape[1])):
            delta = rewards[:, t] + gamma * next_value - values[:, t]
            advantage = delta + gamma * gae_lambda * next_advantage
            next_value = torch.where(mask[:, t], values[:, t], 0)
            next_advantage = advantages[:, t] = torch.where(mask[:, t], advantage, 0)
    return advantages


def ppo_token_loss(logps, old_logps, advantages, mask, clip_range=0.2):
    """PPO's clipped surrogate loss over the kept tokens of a batch.

        L = -mean_{kept}(min(ρ A, clip(ρ, 1 - ε, 1 + ε) A)),   ρ = exp(logps - old_logps)

    The ratio is against the policy that sampled the text, not against the reference.
    Schulman et al. (2017), eq. 7, https://arxiv.org/abs/1707.06347

    Args:
      logps: log-probabilities of the tokens under the current policy, in nats; (B, L').
        Receives gradient.
      old_logps: the same under the policy that sampled them; (B, L'). No gradient.
      advantages: of the tokens; (B, L'). No gradient.
      mask: True at the completion's tokens; (B, L') bool. Elsewhere the others may hold
        any finite numbers, which matter neither to the loss nor to its gradient.
      clip_range: ε ≥ 0, dimensionless; infinity means no clipping.

    Returns: scalar (0-dim) tensor, the mean over all kept tokens, not of row means.
    Raises: ValueError that names an argument if the shapes differ or clip_range < 0.
    """
    validate.same_shape(logps=logps, old_logps=old_logps, advantages=advantages, mask=mask)
    validate.non_negative(clip_range=clip_range)
    ratio = (logps - old_logps.detach())[mask].exp()
    weights = advantages.detach()[mask]
    return -torch.minimum(
        ratio * weights, ratio.clamp(1 - clip_range, 1 + clip_range) * weights
    ).mean()


def repaired_reward_scaling(rewards, mask, eps=1e-8):
    """What the suspect program of the bug lab should have handed to masked_gae in place of raw
    rewards.

    Rewards on a scale of their own, whatever the unit of the score: the kept entries of
    the batch have unit standard deviation (around their mean), and every text is as much
    better or worse than every other as it was, but for that unit.

    Args:
      rewards: of every token, in units of score; (B, L').
      mask: True at the completion's tokens; (B, L') bool.
      eps: ε ≥ 0, added to the variance.

    Returns: (B, L') dimensionless rewards, 0 where the mask is False.
    Raises: ValueError that names an argument if the shapes differ.
    """
    variance = masked_mean((rewards - masked_mean(rewards, mask)) ** 2, mask)
    return torch.where(mask, rewards / (variance + eps).sqrt(), 0)
