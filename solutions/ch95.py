"""Reference solutions of chapter 95: PPO on the tokens of a language model, under masks."""

from __future__ import annotations

import torch

from course_lib import validate
from solutions.ch45 import minibatches


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


def rlhf_iteration(actor, reference, prompts, score, settings, generator):
    """One iteration of PPO on tokens: write, look, estimate, improve.

    Every prompt is continued once, all in one call of generate. What the policy, the
    reference, the critic and the score say of these texts is asked once, before the first
    step. The advantages are whitened; the critic's targets are advantages plus values before
    that. Then come settings.epochs passes over all texts in random minibatches; for each, one
    step down

        ppo_token_loss(...) + mean_{kept}((V - target)²)

    Ziegler et al. (2019), section 2, https://arxiv.org/abs/1909.08593

    Args:
      actor: changed in place. actor.policy.generate(prompts, new_tokens, generator=generator)
        gives samples: input_ids, attention_mask, prompt_lengths, texts.
        actor.policy.logits(input_ids, attention_mask) gives (B, L, V), actor.policy.end_id is
        the end token. actor.critic(features) gives (..., 1) for (..., D).
        actor.step(loss, max_grad_norm) makes one step of policy and critic.
      reference: never changed. reference.hidden(input_ids, attention_mask) gives (B, L, D),
        what is known at each column, which is also what the critic reads before the next
        token is chosen; reference.head(hidden) gives logits (B, L, V).
      prompts: B strings.
      score: samples -> (B,), what each text is worth.
      settings: new_tokens, kl_coef, gamma, gae_lambda, clip_range, epochs, minibatch (texts
        of a step), max_grad_norm.
      generator: of all draws: the texts first, then the minibatches.

    Returns: dict of floats about the texts: score and tokens, means over them; kl, the mean of
      a text's log-ratio to the reference, in nats; and clip_fraction, the share of kept tokens
      whose ratio is further than clip_range from 1, a mean over the minibatches.
    """
    policy = actor.policy
    samples = policy.generate(prompts, settings.new_tokens, generator=generator)
    input_ids, attention_mask = samples.input_ids, samples.attention_mask
    # (B, L) to (B, L - 1): column t is about the choice of token t + 1
    mask = completion_mask(input_ids, samples.prompt_lengths, policy.end_id)[:, 1:]
    with torch.no_grad():
        old_logps = per_token_logps(policy.logits(input_ids, attention_mask), input_ids)
        hidden = reference.hidden(input_ids, attention_mask)
        ref_logps = per_token_logps(reference.head(hidden), input_ids)
        features = hidden[:, :-1]
        values = actor.critic(features).squeeze(-1)
    scores = score(samples)
    rewards = kl_penalized_rewards(scores, old_logps, ref_logps, mask, settings.kl_coef)
    advantages = masked_gae(rewards, values, mask, settings.gamma, settings.gae_lambda)
    returns = advantages + values
    advantages = masked_whiten(advantages, mask)
    fractions = []
    for _ in range(settings.epochs):
        for rows in minibatches(len(input_ids), settings.minibatch, generator):
            kept, old = mask[rows], old_logps[rows]
            logits = policy.logits(input_ids[rows], attention_mask[rows])
            logps = per_token_logps(logits, input_ids[rows])
            loss = ppo_token_loss(logps, old, advantages[rows], kept, settings.clip_range)
            errors = actor.critic(features[rows]).squeeze(-1) - returns[rows]
            actor.step(loss + masked_mean(errors**2, kept), settings.max_grad_norm)
            outside = (logps.detach() - old).expm1().abs() > settings.clip_range
            fractions.append(masked_mean(outside.to(logps.dtype), kept).item())
    return {
        "score": scores.mean().item(),
        "kl": torch.where(mask, old_logps - ref_logps, 0).sum(1).mean().item(),
        "tokens": mask.sum(1).float().mean().item(),
        "clip_fraction": sum(fractions) / len(fractions),
    }


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
