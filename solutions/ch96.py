"""Reference solutions of chapter 96: reward models from comparisons, and best-of-n beside
them.
"""

from __future__ import annotations

import math

import torch
from torch.nn import functional

from course_lib import validate


def last_token_scores(values, attention_mask):
    """The reward model's verdict on each text: its number at the last token that is no
    padding.

        score = values_l,   l = max{t : attention_mask_t}

    Only there has a causal model read the whole text.

    Args:
      values: a number for each token; (B, L). Receives gradient.
      attention_mask: True (or 1) at tokens, False (or 0) at padding, which may be on
        either side; at least one token in each row; (B, L) bool or int64.

    Returns: (B,) scores.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(values=values, attention_mask=attention_mask)
    columns = torch.arange(values.shape[1], device=values.device)
    last = torch.where(attention_mask.bool(), columns, -1).argmax(1)  # (B,)
    return values.gather(1, last[:, None]).squeeze(1)


def reward_model_loss(chosen_scores, rejected_scores, margin=None):
    """Negative log-likelihood of the comparisons under the Bradley-Terry model.

        L = -mean(log σ(chosen - rejected - margin))

    Ouyang et al. (2022), eq. 1; with a margin: Touvron et al. (2023), eq. 2.

    Args:
      chosen_scores: of the texts that were preferred; (B,). Receives gradient.
      rejected_scores: of the others; (B,). Receives gradient.
      margin: by how much the chosen score should be higher, at least; (B,) or None for
        no margin. No gradient.

    Returns: scalar (0-dim) tensor, finite for any finite scores.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(chosen_scores=chosen_scores, rejected_scores=rejected_scores)
    gaps = chosen_scores - rejected_scores
    if margin is not None:
        validate.same_shape(chosen_scores=chosen_scores, margin=margin)
        gaps = gaps - margin.detach()
    return -functional.logsigmoid(gaps).mean()


def in_reference_units(scores, reference_scores, kl_coef):
    """Scores in units of the reference's texts, and the weight of the KL penalty that means
    the same there.

        score'_ij = (score_ij - zero_i) / unit
        π_ref exp(score' / β') ∝ π_ref exp(score / β),   for each prompt i

    Comparisons of texts to one prompt fix no zero that prompts have in common. So each
    prompt has its own: the mean of the reference's scores there. The unit is one number for
    all prompts: the deviation of the reference's scores within a prompt, which is the square
    root of the mean over prompts of their unbiased variances (sum of squares over k - 1).
    Nothing is added to it. The second line is what RLHF would reach: Rafailov et al. (2023),
    eq. 4, https://arxiv.org/abs/2305.18290

    Args:
      scores: of n ≥ 1 texts of any policy to each of B prompts; (B, n). Receives gradient.
      reference_scores: of k ≥ 2 texts of the reference policy to the same prompts, of the
        same reward model; (B, k). No gradient.
      kl_coef: β ≥ 0, in units of `scores` per nat.

    Returns: score', (B, n); and β', float, in the new unit per nat.
    Raises: ValueError that names an argument if the numbers of prompts differ, k < 2,
      kl_coef < 0, or no prompt has reference_scores that differ.
    """
    validate.same_length(scores=scores, reference_scores=reference_scores)
    validate.non_negative(kl_coef=kl_coef)
    reference = reference_scores.detach()
    if reference.shape[1] < 2 or bool((reference == reference[:, :1]).all()):
        raise ValueError(
            "reference_scores must have at least two texts to each prompt, and to some prompt"
            f" two scores, got {tuple(reference.shape)} with a deviation of 0"
        )
    unit = reference.var(1).mean().sqrt()
    return (scores - reference.mean(1, keepdim=True)) / unit, kl_coef / unit.item()


def best_of_n(scores):
    """Of n candidates for each prompt, the one with the highest score.

        argmax_i scores_i,   i = 0, …, n - 1

    Args:
      scores: of n completions of each of B prompts; (B, n).

    Returns: (B,) int64, indices of the best ones.
    """
    return scores.argmax(-1)


def best_of_n_kl(n):
    """How far best-of-n moves from the policy that it samples: KL(best of n ‖ policy).

        log n - (n - 1) / n

    Exact where no two candidates have one score, an upper bound otherwise.
    Beirami et al. (2025), https://arxiv.org/abs/2401.01879

    Args:
      n: number of candidates, at least 1.

    Returns: float, in nats.
    Raises: ValueError that names an argument if n < 1.
    """
    if n < 1:
        raise ValueError(f"n must be at least 1, got {n}")
    return math.log(n) - (n - 1) / n


def length_correlation(scores, lengths):
    """Pearson's correlation between the scores of texts and their lengths.

        Σ (s - s̄)(l - l̄) / sqrt(Σ (s - s̄)² Σ (l - l̄)²)

    A reward model that has learnt "longer is better" shows it here.

    Args:
      scores: of B texts, not all equal; (B,).
      lengths: of the same texts, in tokens, not all equal; (B,) int64 or floating point.

    Returns: scalar (0-dim) tensor in [-1, 1], in the dtype of scores, without a graph.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(scores=scores, lengths=lengths)
    a = scores.detach() - scores.detach().mean()
    b = lengths.detach().to(scores.dtype) - lengths.detach().to(scores.dtype).mean()
    return (a * b).sum() / (a.square().sum() * b.square().sum()).sqrt()


def repaired_choices(first, second, first_ratings, second_ratings):
    """The comparisons that the suspect program of the bug lab should have trained on.

    In each pair the text with the higher rating is chosen. A pair whose two ratings are
    equal says nothing about which text is better, and is left out.

    Args:
      first, second: which two texts of the collection each pair compares, by their index;
        (B,) int64.
      first_ratings, second_ratings: what one person said of either text; (B,) integers or
        floating point.

    Returns: chosen, rejected: indices of texts, in the order of the pairs without those
      that are left out; two tensors of one length, int64.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(
        first=first, second=second, first_ratings=first_ratings, second_ratings=second_ratings
    )
    decided = first_ratings != second_ratings
    first_wins = (first_ratings > second_ratings)[decided]
    first, second = first[decided], second[decided]
    return torch.where(first_wins, first, second), torch.where(first_wins, second, first)
