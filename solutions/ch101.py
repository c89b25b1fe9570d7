"""Reference solutions of chapter 101: learning from a program that says right or wrong."""

from __future__ import annotations

import torch

from course_lib import validate
from solutions.ch45 import minibatches
from solutions.ch95 import completion_mask, per_token_logps


def verify_sorted(prompts, completions):
    """Whether each completion is the prompt's digits in ascending order, and nothing else.

        reward_b = 1 if completion_b = sort(digits of prompt_b), else 0

    Args:
      prompts: B strings of ASCII digits that end with "=", such as "4938=".
      completions: B strings, whatever the policy wrote, without the end token.

    Returns: (B,) float32, 1.0 where right and 0.0 elsewhere.
    Raises: ValueError that names an argument if the numbers of strings differ.
    """
    if len(prompts) != len(completions):
        raise ValueError(
            f"prompts must be as many as completions, got {len(prompts)}, {len(completions)}"
        )
    pairs = zip(prompts, completions, strict=True)
    return torch.tensor(
        [float(text == "".join(sorted(prompt[:-1]))) for prompt, text in pairs]
    )


def pass_at_k(num_samples, num_correct, k):
    """Probability that at least one of k samples is right, estimated from n ≥ k samples.

        pass@k = 1 - C(n - c, k) / C(n, k) = 1 - Π_{i=0}^{k-1} (n - c - i) / (n - i)

    With fewer than k wrong samples pass@k is 1. Unbiased, which 1 - (1 - c/n)^k is not.
    Chen et al. (2021), eq. 1, https://arxiv.org/abs/2107.03374

    Args:
      num_samples: n, samples of each prompt; int.
      num_correct: c, how many of them were right; (P,) int64, each from 0 to n.
      k: how many samples one may try, from 1 to n; int.

    Returns: (P,) float64 probabilities. Finite for thousands of samples.
    Raises: ValueError that names an argument if k < 1, k > num_samples, or a count lies
      outside 0 to num_samples.
    """
    validate.at_least_one(k=k)
    if k > num_samples:
        raise ValueError(f"k must be at most num_samples = {num_samples}, got {k}")
    if (num_correct < 0).any() or (num_correct > num_samples).any():
        raise ValueError(f"num_correct must lie in 0 to {num_samples}, got {num_correct}")
    tries = torch.arange(k, dtype=torch.float64, device=num_correct.device)
    wrong = (num_samples - num_correct).double()[:, None]
    return 1 - ((wrong - tries).clamp(min=0) / (num_samples - tries)).prod(1)


def group_advantages(rewards, group_size, baseline="mean", scale="group", eps=1e-6):
    """How much better each completion did than the others of its group.

        A_i = (r_i - b_i) / s,   b_i = mean(r) or mean_{j≠i}(r_j),   s = std + ε or 1

    Groups are contiguous: rows 0 to G - 1 answer the first prompt, and so on. With "mean"
    and "group" this is Shao et al. (2024), section 4.1.2, https://arxiv.org/abs/2402.03300;
    with "leave_one_out" and "none" RLOO, https://arxiv.org/abs/2402.14740; with "mean" and
    "none" Dr. GRPO, https://arxiv.org/abs/2503.20783

    Args:
      rewards: of P groups one after the other; (P G,).
      group_size: G ≥ 2.
      baseline: "mean" of the group, or "leave_one_out", the mean of its other members.
      scale: divide by the standard deviation (over G or over G - 1) of the rewards of each
        "group", or of the whole "batch", each plus eps; or by nothing, "none".
      eps: ε > 0, in units of reward.

    Returns: (P G,) advantages without a graph; 0 in a group of equal rewards, up to rounding,
      which a small eps makes large.
    Raises: ValueError that names an argument if group_size < 2, the rewards are not a whole
      number of groups, or baseline or scale is another word.
    """
    if group_size < 2:
        raise ValueError(f"group_size must be at least 2, got {group_size}")
    if len(rewards) % group_size:
        raise ValueError(
            f"rewards must be whole groups of group_size = {group_size}, got {len(rewards)}"
        )
    if baseline not in ("mean", "leave_one_out"):
        raise ValueError(f"baseline must be mean or leave_one_out, got {baseline!r}")
    if scale not in ("group", "batch", "none"):
        raise ValueError(f"scale must be group, batch or none, got {scale!r}")
    groups = rewards.detach().reshape(-1, group_size)  # (P, G)
    advantages = groups - groups.mean(1, keepdim=True)
    if baseline == "leave_one_out":
        advantages = advantages * (group_size / (group_size - 1))
    if scale == "group":
        advantages = advantages / (groups.std(1, keepdim=True, correction=0) + eps)
    if scale == "batch":
        advantages = advantages / (groups.std(correction=0) + eps)
    return advantages.flatten()


def aggregate_loss(terms, mask, how="tokens", max_length=None):
    """One number from the terms of all kept tokens, by one of three rules.

        tokens:    Σ_{kept} x / (kept tokens of the batch)
        sequences: mean_b(Σ_{kept in b} x / (kept tokens of b))
        constant:  Σ_{kept} x / (B · max_length)

    DAPO, GRPO and Dr. GRPO, in this order: https://arxiv.org/abs/2503.14476, eq. 8;
    https://arxiv.org/abs/2402.03300, eq. 3; https://arxiv.org/abs/2503.20783

    Args:
      terms: of each token, such as losses; (B, L'). Receives gradient.
      mask: True at the completion's tokens, at least one in each row; (B, L') bool.
        Elsewhere terms may hold any finite numbers.
      how: "tokens", "sequences" or "constant".
      max_length: tokens that a completion may have at most, ≥ 1; for "constant" only.

    Returns: scalar (0-dim) tensor.
    Raises: ValueError that names an argument if the shapes differ, how is another word, or
      max_length is missing or below 1 where it is needed.
    """
    validate.same_shape(terms=terms, mask=mask)
    if how not in ("tokens", "sequences", "constant"):
        raise ValueError(f"how must be tokens, sequences or constant, got {how!r}")
    kept = torch.where(mask, terms, 0)
    if how == "tokens":
        return kept.sum() / mask.sum()
    if how == "sequences":
        return (kept.sum(1) / mask.sum(1)).mean()
    if max_length is None or max_length < 1:
        raise ValueError(f"max_length must be at least 1 for constant, got {max_length}")
    return kept.sum() / (len(terms) * max_length)


def kl_term(logps, ref_logps, estimator="k3"):
    """An estimate of the divergence from the reference at each token, as a term of the loss.

        k1 = x,   k2 = x² / 2,   k3 = e^(-x) - 1 + x,   x = logps - ref_logps

    For tokens drawn from the policy, the mean of k1 and k3 is KL(π ‖ π_ref). As a term of
    the loss what counts is its gradient, for which the draws are data: in expectation, at a
    given beginning of the answer, 0 for k1, that of KL(π ‖ π_ref) for k2, and that of
    KL(π_ref ‖ π) for k3.
    Schulman (2020), http://joschu.net/blog/kl-approx.html

    Args:
      logps: of the tokens under the current policy, in nats; (B, L'). Receives gradient.
      ref_logps: the same under the frozen reference; (B, L'). No gradient.
      estimator: "k1", "k2" or "k3".

    Returns: (B, L') terms in nats.
    Raises: ValueError that names an argument if the shapes differ or estimator is another
      word.
    """
    validate.same_shape(logps=logps, ref_logps=ref_logps)
    if estimator not in ("k1", "k2", "k3"):
        raise ValueError(f"estimator must be k1, k2 or k3, got {estimator!r}")
    x = logps - ref_logps.detach()
    if estimator == "k1":
        return x
    return x**2 / 2 if estimator == "k2" else (-x).expm1() + x


def grpo_loss(
    logps,
    old_logps,
    advantages,
    mask,
    clip_low=0.2,
    clip_high=0.28,
    ref_logps=None,
    beta=0.0,
    how="tokens",
    max_length=None,
):
    """The clipped objective with one advantage for all tokens of a completion, negated, and a
    divergence beside it.

        L = aggregate(-min(ρ A, clip(ρ, 1 - ε_low, 1 + ε_high) A) + β k3),
            ρ = exp(logps - old_logps)

    Shao et al. (2024), eq. 3, https://arxiv.org/abs/2402.03300, with the two bounds of
    Yu et al. (2025), eq. 10, https://arxiv.org/abs/2503.14476

    Args:
      logps: of the tokens under the current policy, in nats; (B, L'). Receives gradient.
      old_logps: the same under the policy that sampled them; (B, L'). No gradient.
      advantages: of the completions; (B,). No gradient.
      mask: True at the completion's tokens, at least one in each row; (B, L') bool.
        Elsewhere log-probabilities may be any finite numbers.
      clip_low: ε_low ≥ 0, dimensionless; infinity means no bound below.
      clip_high: ε_high ≥ 0, the same above.
      ref_logps: under the frozen reference; (B, L'), or None. No gradient.
      beta: β ≥ 0, price of a nat; 0 leaves the divergence out.
      how, max_length: of aggregate_loss.

    Returns: (loss, metrics): a scalar (0-dim) tensor, and a dict of detached 0-dim tensors
      of its dtype, clipped_low and clipped_high, the shares of kept tokens whose gradient
      each bound takes away (ρ below 1 - ε_low where A < 0, above 1 + ε_high where A > 0).
    Raises: ValueError that names an argument if shapes differ, clip_low, clip_high or beta
      is below 0, or beta > 0 without ref_logps.
    """
    validate.same_shape(logps=logps, old_logps=old_logps, mask=mask)
    validate.same_shape(advantages=advantages, logps=logps[:, 0])
    validate.non_negative(clip_low=clip_low, clip_high=clip_high, beta=beta)
    if beta > 0 and ref_logps is None:
        raise ValueError(f"ref_logps must be given where beta > 0, got None and {beta}")
    log_ratio = torch.where(mask, logps - old_logps.detach(), 0)  # before exp: no overflow
    ratio = log_ratio.exp()
    weights = advantages.detach()[:, None]
    bounded = ratio.clamp(1 - clip_low, 1 + clip_high)
    terms = -torch.minimum(ratio * weights, bounded * weights)
    if beta > 0:
        silent_logps = torch.where(mask, logps, 0)
        terms = terms + beta * kl_term(silent_logps, torch.where(mask, ref_logps, 0))
    with torch.no_grad():
        kept = mask.sum()
        low = (mask & (ratio < 1 - clip_low) & (weights < 0)).sum() / kept
        high = (mask & (ratio > 1 + clip_high) & (weights > 0)).sum() / kept
    metrics = {"clipped_low": low.to(ratio.dtype), "clipped_high": high.to(ratio.dtype)}
    return aggregate_loss(terms, mask, how, max_length), metrics


def sequence_ratio(logps, old_logps, mask):
    """How much likelier a whole completion has become, as a geometric mean over its tokens.

        s_b = exp(mean_{kept in b}(logps - old_logps)) = (π(y_b) / π_old(y_b))^(1/|y_b|)

    Zheng et al. (2025), eq. 7, https://arxiv.org/abs/2507.18071

    Args:
      logps: of the tokens under the current policy, in nats; (B, L'). Receives gradient.
      old_logps: the same under the policy that sampled them; (B, L'). No gradient.
      mask: True at the completion's tokens, at least one in each row; (B, L') bool.
        Elsewhere log-probabilities may be any finite numbers.

    Returns: (B,) ratios.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(logps=logps, old_logps=old_logps, mask=mask)
    log_ratio = torch.where(mask, logps - old_logps.detach(), 0)
    return (log_ratio.sum(1) / mask.sum(1)).exp()


def grpo_iteration(policy, prompts, verify, settings, generator):
    """Let the policy answer, have the answers verified, and improve it on what came out.

    Each of the P prompts is asked settings.group_size times in a row, all in one call of
    generate, and answers are compared within their group. Then come settings.epochs passes
    over all answers in random minibatches: for each a grpo_loss, without a divergence, and
    one step.

    Args:
      policy: changed in place; policy.generate(prompts, new_tokens, generator=generator)
        gives samples (input_ids, attention_mask, prompt_lengths, texts),
        policy.logits(input_ids, attention_mask) gives (B, L, V), policy.end_id is the end
        token, and policy.step(loss, max_grad_norm) makes one step down the loss's gradient.
      prompts: P strings.
      verify: (prompts, completions) -> rewards (B,), for as many of one as of the other.
      settings: group_size, new_tokens, baseline, scale, clip_low, clip_high, how, epochs,
        minibatch (answers of a step), max_grad_norm; max_length is new_tokens.
      generator: of all draws.

    Returns: dict of floats: reward, the mean over all answers; silent, the share of groups
      whose rewards are all equal; clipped_low and clipped_high, means over the minibatches.
    """
    asked = [prompt for prompt in prompts for _ in range(settings.group_size)]
    samples = policy.generate(asked, settings.new_tokens, generator=generator)
    ids, attention = samples.input_ids, samples.attention_mask
    rewards = verify(asked, samples.texts)
    size, length = settings.group_size, settings.new_tokens
    advantages = group_advantages(rewards, size, settings.baseline, settings.scale)
    mask = completion_mask(ids, samples.prompt_lengths, policy.end_id)[:, 1:]
    with torch.no_grad():
        old_logps = per_token_logps(policy.logits(ids, attention), ids)
    logged = []
    for _ in range(settings.epochs):
        for rows in minibatches(len(asked), settings.minibatch, generator):
            logps = per_token_logps(policy.logits(ids[rows], attention[rows]), ids[rows])
            loss, metrics = grpo_loss(
                logps,
                old_logps[rows],
                advantages[rows],
                mask[rows],
                settings.clip_low,
                settings.clip_high,
                how=settings.how,
                max_length=length,
            )
            policy.step(loss, settings.max_grad_norm)
            logged.append(torch.stack([metrics["clipped_low"], metrics["clipped_high"]]))
    low, high = torch.stack(logged).mean(0).tolist()
    groups = rewards.reshape(-1, size)
    silent = (groups == groups[:, :1]).all(1).float().mean().item()
    return {
        "reward": rewards.mean().item(),
        "silent": silent,
        "clipped_low": low,
        "clipped_high": high,
    }


def repaired_advantages(rewards, group_size):
    """What the suspect program of the bug lab should have handed to grpo_loss as advantages.

    Two answers of one group differ in advantage by as much as they differ in reward, in
    every group alike, and the advantages of each group add up to 0.

    Args:
      rewards: of P groups one after the other; (P G,).
      group_size: G ≥ 2.

    Returns: (P G,) advantages in units of reward, without a graph.
    Raises: ValueError that names an argument if group_size < 2 or the rewards are not a
      whole number of groups.
    """
    return group_advantages(rewards, group_size, scale="none")
