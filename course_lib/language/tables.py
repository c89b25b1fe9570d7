"""Language models that are tables, for trying out training loops in milliseconds (chapters 95 and 97)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from course_lib.language import lm


class Bigrams(torch.nn.Module):
    """A language model in which the next token depends on the one before it alone; texts are digits, such as "0213".

    The last token of the vocabulary begins, ends and pads. In training mode the logits of every other token are dropped, as dropout would,
    but always of the same ones; it begins in eval mode.

    Args:
      table: logits of the next token (columns) behind each token (rows); (V, V).
      training: whether it begins in training mode.
    """

    def __init__(self, table: torch.Tensor, training: bool = False):
        super().__init__()
        self.table = torch.nn.Parameter(table)
        self.end_id = len(table) - 1
        self.train(training)

    def hidden(self, input_ids: torch.Tensor, attention_mask: torch.Tensor) -> torch.Tensor:
        """What is known at every position, (B, L, V): the row of its token."""
        kept = torch.arange(len(self.table)) % 2 == 0
        table = torch.where(kept, 2 * self.table, 0) if self.training else self.table
        return table[input_ids]

    def head(self, hidden: torch.Tensor) -> torch.Tensor:
        """Logits of the next token from what is known: the same."""
        return hidden

    def logits(self, input_ids: torch.Tensor, attention_mask: torch.Tensor) -> torch.Tensor:
        """(B, L, V); what they are at padding means nothing."""
        return self.head(self.hidden(input_ids, attention_mask))

    @torch.no_grad()
    def generate(self, prompts: Sequence[str], max_new_tokens: int, generator: torch.Generator | None = None) -> lm.Samples:
        """See lm.LanguageModel.generate."""
        rows = [[self.end_id, *map(int, prompt)] for prompt in prompts]
        width = max(map(len, rows))
        ids = torch.tensor([[self.end_id] * (width - len(row)) + row for row in rows])
        mask = torch.arange(width) >= width - torch.tensor([[len(row)] for row in rows])
        alive = torch.ones(len(rows), dtype=torch.bool)
        for _ in range(max_new_tokens):
            drawn = torch.multinomial(self.table[ids[:, -1]].softmax(-1), 1, generator=generator).squeeze(1)
            ids = torch.cat([ids, torch.where(alive, drawn, self.end_id)[:, None]], 1)
            mask = torch.cat([mask, alive[:, None]], 1)
            alive = alive & (drawn != self.end_id)
        texts = ["".join(str(token) for token in row if token != self.end_id) for row in ids[:, width:].tolist()]
        return lm.Samples(ids, mask, torch.full((len(ids),), width), texts)


class TableActor(torch.nn.Module):
    """A policy that is a table and a linear critic, which one step of plain gradient descent changes together: an `ActorCritic`.

    Args:
      table: of the policy; see Bigrams.
      weights: of the critic; (1, V).
      learning_rate, critic_learning_rate: of the two.
    """

    def __init__(self, table: torch.Tensor, weights: torch.Tensor, learning_rate: float, critic_learning_rate: float):
        super().__init__()
        self.policy = Bigrams(table)
        self.critic = torch.nn.Linear(weights.shape[1], 1, bias=False, dtype=weights.dtype)
        self.critic.weight = torch.nn.Parameter(weights)
        self.rates = (learning_rate, critic_learning_rate)
        self.steps: torch.Tensor
        self.register_buffer("steps", torch.tensor(0))

    def step(self, loss: torch.Tensor, max_grad_norm: float) -> None:
        """One step down the gradient of a loss; the policy's is shortened to this norm if it is longer."""
        parameters = (self.policy.table, self.critic.weight)
        for_policy, for_critic = torch.autograd.grad(loss, parameters, allow_unused=True)
        for weights, gradient, rate, most in zip(
            parameters, (for_policy, for_critic), self.rates, (max_grad_norm, float("inf")), strict=True
        ):
            if gradient is not None:
                weights.data.sub_(rate * gradient * min(1.0, most / gradient.norm().clamp(min=1e-9).item()))
        self.steps.add_(1)


def fondness(token: int) -> Callable[[lm.Samples], torch.Tensor]:
    """A score: how often a token, one digit, stands in each completion."""
    return lambda samples: torch.tensor([text.count(str(token)) for text in samples.texts], dtype=torch.float64)
