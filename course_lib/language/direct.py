"""Learning from pairs of texts without a reward model: batches, log-probabilities and the training step (chapter 97).

    reference, pairs = policy.frozen_copy(), encode_pairs(policy, chosen_texts, rejected_texts)
    ref_logps = reference_logps(reference, pairs, sequence_logps)          # once: the reference never changes
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-4, weight_decay=0.0, fused=True)
    for rows in like_lengths(pairs, batch=16, generator=seed_everything(0)):
        row = train_step(policy, optimizer, pairs.of(rows), ref_logps[rows], dpo_loss, sequence_logps)

What the chapter teaches, the log-probability of a completion and the loss, is handed in. What is saved is work that changes no number:
a prompt is read once for both sides, no logits are computed before the completions, little is padding, and the reference
is asked once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch

from course_lib.language.lm import LanguageModel


class Pairs(NamedTuple):
    """B pairs of texts that begin with the same prompts; (B, 2, L) each, the chosen text first."""

    input_ids: torch.Tensor
    attention_mask: torch.Tensor  # bool, False at padding, which is on the right
    completion_mask: torch.Tensor  # bool, True at the tokens behind the prompt

    def of(self, rows: torch.Tensor) -> Pairs:
        """Some of the pairs, without the columns that are padding in all of them."""
        longest = int(self.attention_mask[rows].sum(-1).max())
        return Pairs(*(part[rows, :, :longest] for part in self))


def encode_pairs(model: LanguageModel, chosen: Sequence[str], rejected: Sequence[str], prompts: Sequence[str] = ()) -> Pairs:
    """Pairs of completions as tokens, each with the end token behind it.

    Args:
      chosen, rejected: B completions each, such as " a fine film"; what joins them to the prompt, a space mostly, is theirs.
      prompts: B texts; if none are given, whole texts are compared.

    Raises: ValueError if a token would reach across the end of a prompt.
    """
    prompts = prompts or [""] * len(chosen)
    texts = [prompt + text for prompt, *both in zip(prompts, chosen, rejected, strict=True) for text in both]
    input_ids, attention_mask = (part.unflatten(0, (-1, 2)) for part in model.encode(texts, ended=True))
    beginnings = model.encode(prompts)
    width = beginnings.input_ids.shape[1]
    same = (input_ids[:, :, :width] == beginnings.input_ids[:, None]) | ~beginnings.attention_mask[:, None]
    if not same.all():
        raise ValueError("a prompt's tokens must stay the same when a completion follows: begin completions with a space")
    behind = torch.arange(input_ids.shape[-1], device=model.device) >= beginnings.attention_mask.sum(1)[:, None, None]
    return Pairs(input_ids, attention_mask, behind & attention_mask)


def completion_logps(model: LanguageModel, pairs: Pairs, sequence_logps: Callable) -> torch.Tensor:
    """log π(y|x) of both completions of each pair; (B, 2), with a graph where one is kept.

    Each pair goes through the network as one row, prompt, chosen and rejected completion, in which no completion sees the other: so the
    prompt is read once. The head, which is as wide as the vocabulary, is applied from the column before the first completion on.
    """
    input_ids, _, completion_mask = (part.flatten(0, 1) for part in pairs)  # (2B, L)
    start = int(completion_mask[:, 1:].any(0).nonzero()[0])
    hidden = _hidden_of_rows(model, pairs)[:, :, start:].flatten(0, 1)
    return sequence_logps(model.head(hidden), input_ids[:, start:], completion_mask[:, start:]).unflatten(0, (-1, 2))


def _hidden_of_rows(model: LanguageModel, pairs: Pairs) -> torch.Tensor:
    """What the last layer knows at each token of each text, (B, 2, L, D), from one row for each pair."""
    input_ids, attention_mask, completion_mask = pairs
    columns = torch.arange(input_ids.shape[-1], device=model.device).expand(input_ids.shape)
    chosen_tokens = completion_mask[:, 0].sum(-1)[:, None]
    places = columns.clone()  # of each token in its pair's row
    places[:, 1] += torch.where(completion_mask[:, 1], chosen_tokens, 0)
    needed = attention_mask | completion_mask
    width = int(places[needed].max()) + 1
    places = torch.where(needed, places, width)  # padding goes to a column that is cut off

    def rows_of(values: torch.Tensor) -> torch.Tensor:
        rows = values.new_zeros(len(values), width + 1)
        return rows.scatter(1, places.flatten(1), values.flatten(1))[:, :width]

    side = rows_of(completion_mask * torch.tensor([[1], [2]], device=model.device))  # 0 in the prompt
    seen = (side[:, None, :] == 0) | (side[:, None, :] == side[:, :, None])  # (B, asking, asked)
    seen &= rows_of(attention_mask)[:, None, :] & torch.ones(width, width, dtype=torch.bool, device=model.device).tril()
    positions = rows_of((attention_mask.cumsum(-1) - 1).clamp(min=0))
    inputs = {"input_ids": rows_of(input_ids), "attention_mask": seen[:, None], "position_ids": positions}
    hidden = model.network.base_model(**inputs, use_cache=False).last_hidden_state
    return hidden[torch.arange(len(hidden), device=model.device)[:, None, None], places.clamp(max=width - 1)]


@torch.no_grad()
def reference_logps(reference: LanguageModel, pairs: Pairs, sequence_logps: Callable, batch: int = 32) -> torch.Tensor:
    """`completion_logps` of any number of pairs under a model that doesn't change; (B, 2)."""
    logps = torch.empty(pairs.input_ids.shape[:2], device=reference.device)
    for rows in like_lengths(pairs, batch):
        logps[rows] = completion_logps(reference, pairs.of(rows), sequence_logps)
    return logps


def like_lengths(pairs: Pairs, batch: int, generator: torch.Generator | None = None) -> Iterator[torch.Tensor]:
    """Rows of all pairs, in batches of about the same length, so that little is padding.

    Args:
      generator: puts the batches, and pairs of the same length, in random order; from short to long if None.
    """
    lengths = pairs.attention_mask.sum(-1).amax(-1).cpu()  # (B,)
    order = torch.arange(len(lengths)) if generator is None else torch.randperm(len(lengths), generator=generator)
    batches = order[lengths[order].argsort(stable=True)].split(batch)
    turns = range(len(batches)) if generator is None else torch.randperm(len(batches), generator=generator).tolist()
    return (batches[turn] for turn in turns)


def train_step(
    policy: LanguageModel,
    optimizer: torch.optim.Optimizer,
    pairs: Pairs,
    ref_logps: torch.Tensor,
    loss: Callable,
    sequence_logps: Callable,
    max_grad_norm: float = 1.0,
) -> dict[str, float]:
    """One step of the optimiser on a batch of pairs.

    Args:
      ref_logps: of the same pairs, from `reference_logps`; (B, 2).
      loss: `dpo_loss`, or one with its arguments and results; its settings may be fixed with functools.partial.

    Returns: what was so before the step: loss, accuracy (share of pairs whose chosen text has the higher implicit reward), margin
      between the implicit rewards, and how far the log-probabilities of chosen and rejected texts have moved from the reference.
    """
    logps = completion_logps(policy, pairs, sequence_logps)
    losses, chosen_rewards, rejected_rewards = loss(*logps.unbind(1), *ref_logps.unbind(1))
    optimizer.zero_grad()
    losses.mean().backward()
    torch.nn.utils.clip_grad_norm_(policy.parameters(), max_grad_norm)
    optimizer.step()
    chosen_moved, rejected_moved = (logps.detach() - ref_logps).mean(0).tolist()
    return {
        "loss": losses.mean().item(),
        "accuracy": (chosen_rewards > rejected_rewards).float().mean().item(),
        "margin": (chosen_rewards - rejected_rewards).mean().item(),
        "chosen_moved": chosen_moved,
        "rejected_moved": rejected_moved,
    }
