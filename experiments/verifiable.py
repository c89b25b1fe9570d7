"""GRPO on sorting digits with a model of 100,000 parameters, and what may stand in its place (chapter 101).

Baselines, a critic, supervised learning, sampling at lower temperatures, difficulty, the division by a group's deviation, a verifier with
a hole, a silent bug, room for long answers, and bounds on the ratio with the entropy that is left. A run's seed is that of the model, of
its warm-up and of training. Every iteration of every variant asks the verifier about 192 answers; a row stands for ten iterations unless
"rows" says otherwise. In some of them the policy is measured on prompts whose answers were never asked for in training.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from course_lib.language import lm, verifiable
from course_lib.language.rlhf import next_token_loss
from course_lib.language.verifiable import GroupSettings, Learner, Verify, answer, measured, questions
from course_lib.seeding import seed_everything
from experiments.campaign import Report, Result
from solutions.ch45 import minibatches
from solutions.ch95 import completion_mask, masked_gae, masked_mean, masked_whiten, per_token_logps, ppo_token_loss
from solutions.ch101 import grpo_iteration, pass_at_k, verify_sorted

WEAK, STRONG = 100, 300  # steps of supervised learning before
COMMON = {"method": "grpo", "warm_up": WEAK, "iterations": 90, "digits": [5], "room": 8, "prompts": 24, "group_size": 8}
MIXED = COMMON | {"digits": [3, 3, 3, 7], "room": 10, "warm_up": 150, "iterations": 60}
LONG = COMMON | {"room": 24, "iterations": 30, "rows": 5, "scale": "none"}
PASSES = COMMON | {"epochs": 4, "iterations": 30, "rows": 5, "watched": True}
PRICE = 1e-3  # of a character, in the silent bug
VARIANTS: dict[str, dict] = {
    "grpo": COMMON,
    "rloo": COMMON | {"baseline": "leave_one_out", "scale": "none"},
    "dr_grpo": COMMON | {"scale": "none", "how": "constant"},
    "ppo": COMMON | {"method": "ppo"},
    "no_critic": COMMON | {"method": "no_critic"},
    "supervised": COMMON | {"method": "supervised"},
    "rejection": COMMON | {"method": "rejection"},
    "lab_suspect": MIXED | {"price": PRICE},
    "lab_repaired": MIXED | {"price": PRICE, "scale": "none"},
    "lab_batch": MIXED | {"price": PRICE, "scale": "batch"},
    "strong": COMMON | {"warm_up": STRONG},
    "hole": COMMON | {"verifier": "ascending"},
    **{f"group_{size}": COMMON | {"prompts": 192 // size, "group_size": size} for size in (2, 4, 16, 32)},
    **{f"long_{how}": LONG | {"how": how} for how in ("sequences", "tokens", "constant")},
    "clip_both": PASSES | {"clip_low": 0.2, "clip_high": 0.2},
    "clip_higher": PASSES | {"clip_low": 0.2, "clip_high": 0.28},
    "clip_tight": PASSES | {"clip_low": 0.2, "clip_high": 0.02},
    "clip_above": PASSES | {"clip_low": 1e6, "clip_high": 0.28},  # no bound below
    "cold": COMMON | {"colder": [0.5, 0.3]},  # the run "grpo" again, looked at once more before and after it
    "mixed_group": MIXED,
    "mixed_none": MIXED | {"scale": "none"},
    **{f"digits_{n}": COMMON | {"digits": [n], "room": n + 3, "iterations": 0} for n in (4, 5, 6, 7)},
}
SEEDS = 5
ROWS, LOOK = 10, 30  # iterations that a row stands for, and between two measurements
SETTINGS = ("prompts", "group_size", "baseline", "scale", "how", "epochs", "clip_low", "clip_high")


def ascending(prompts: list[str], completions: list[str]) -> torch.Tensor:
    """A verifier with a hole: 1 for any digits in ascending order, whatever the prompt was."""
    del prompts
    return torch.tensor([float(text == "".join(sorted(text))) for text in completions])


def priced(price: float) -> Verify:
    """The verifier of the chapter's lab: right or wrong, and a price for each character to decide between answers that tie."""
    return lambda prompts, completions: (
        verify_sorted(prompts, completions) - price * torch.tensor([float(len(text)) for text in completions])
    )


def started(choice: dict, seed: int) -> lm.LanguageModel:
    policy = verifiable.fresh(seed)
    for _ in verifiable.warm_up(policy, choice["warm_up"], seed, choice["digits"]):
        pass
    return policy


class Watched(Learner):
    """A learner that notes the mean entropy of its next token, in nats, over all tokens that it has just written."""

    entropy = float("nan")

    def generate(self, prompts, max_new_tokens, generator=None):
        samples = super().generate(prompts, max_new_tokens, generator)
        with torch.no_grad():
            logps = self.logits(samples.input_ids, samples.attention_mask)[:, :-1].log_softmax(-1)
        mask = completion_mask(samples.input_ids, samples.prompt_lengths, self.end_id)[:, 1:]
        self.entropy = masked_mean(-(logps.exp() * logps).sum(-1), mask).item()
        return samples


def ppo(policy: lm.LanguageModel, seed: int, settings: GroupSettings, with_critic: bool = True) -> Callable:
    """An iteration with a critic of the policy's size, as in chapter 95, on as many answers, each to a prompt of its own.

    Without the critic all values are 0, and what is left of the baseline is the mean of the batch.
    """
    torch.manual_seed(seed)
    critic = Learner(lm.ValueModel(policy), 1e-3)

    def iteration(policy, prompts, verify, settings, generator):
        samples = policy.generate(prompts, settings.new_tokens, generator=generator)
        ids, attention = samples.input_ids, samples.attention_mask
        scores = verify(prompts, samples.texts)
        mask = completion_mask(ids, samples.prompt_lengths, policy.end_id)[:, 1:]
        columns = torch.arange(mask.shape[1])
        rewards = scores[:, None] * (columns == torch.where(mask, columns, -1).amax(1, keepdim=True))
        with torch.no_grad():
            old_logps = per_token_logps(policy.logits(ids, attention), ids)
            values = critic.model(ids, attention)[:, :-1] if with_critic else torch.zeros_like(old_logps)
        advantages = masked_gae(rewards, values, mask, 1.0, 1.0)
        returns, advantages = advantages + values, masked_whiten(advantages, mask)
        for rows in minibatches(len(prompts), settings.minibatch, generator):
            logps = per_token_logps(policy.logits(ids[rows], attention[rows]), ids[rows])
            loss = ppo_token_loss(logps, old_logps[rows], advantages[rows], mask[rows])
            policy.step(loss, settings.max_grad_norm)
            if with_critic:
                errors = critic.model(ids[rows], attention[rows])[:, :-1] - returns[rows]
                critic.step(masked_mean(errors**2, mask[rows]), settings.max_grad_norm)
        return {"reward": scores.mean().item()}

    return iteration


def imitate(policy: Learner, texts, settings, generator) -> None:
    for rows in minibatches(len(texts), settings.minibatch, generator):
        policy.step(next_token_loss(policy.model, [texts[row] for row in rows.tolist()]), settings.max_grad_norm)


def supervised(policy, prompts, verify, settings, generator) -> dict[str, float]:
    """Right answers to as many prompts as GRPO has answers; each is worth a verifier's call."""
    imitate(policy, [prompt + answer(prompt) for prompt in prompts], settings, generator)
    return {}


def rejection(policy, prompts, verify, settings, generator) -> dict[str, float]:
    """Imitate those of the policy's own answers that were right."""
    asked = [prompt for prompt in prompts for _ in range(settings.group_size)]
    texts = policy.generate(asked, settings.new_tokens, generator=generator).texts
    rewards = verify(asked, texts)
    right = [prompt + text for prompt, text, reward in zip(asked, texts, rewards.tolist(), strict=True) if reward]
    if right:
        imitate(policy, right, settings, generator)
    return {"reward": rewards.mean().item()}


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Warm up, train, and measure before, on the way and at the end. A run takes seconds and is begun anew after a kill."""
    choice = VARIANTS[variant]
    method, iterations, digits, room = (choice[name] for name in ("method", "iterations", "digits", "room"))
    begun = time.process_time()
    policy = started(choice, seed)
    warm_seconds = time.process_time() - begun
    settings = GroupSettings(new_tokens=room).but(**{name: choice[name] for name in SETTINGS if name in choice})
    answers = settings.prompts * settings.group_size
    pays = ascending if choice.get("verifier") else priced(choice["price"]) if "price" in choice else verify_sorted
    iteration = {"grpo": grpo_iteration, "supervised": supervised, "rejection": rejection}.get(method) or ppo(
        policy, seed, settings, with_critic=method == "ppo"
    )
    asks = answers if method in ("ppo", "no_critic", "supervised") else settings.prompts
    learner = (Watched if choice.get("watched") else Learner)(policy, settings.learning_rate)
    span = choice.get("rows", ROWS)
    generator = seed_everything(100 + seed)
    seen: list[dict[str, float]] = []

    def verify(prompts, completions):
        rewards, right = pays(prompts, completions), verify_sorted(prompts, completions)
        sizes = torch.tensor([len(prompt) - 1 for prompt in prompts])
        lengths = torch.tensor([float(len(text)) for text in completions])
        kinds = {"_few": sizes == min(digits), "_many": sizes == max(digits)} if len(digits) > 1 else {}
        told = {"right": right, "characters": lengths, "unended": (lengths >= room).float()}
        of_wrong = {"characters_wrong": lengths[right < 0.5].mean().item()} if (right < 0.5).any() else {}
        seen.append(
            {name: part.mean().item() for name, part in told.items()}
            | of_wrong
            | {name + kind: part[rows].mean().item() for name, part in told.items() for kind, rows in kinds.items() if rows.any()}
        )
        return rewards

    def look(prompts: int, temperature: float = 1.0) -> dict[str, float]:
        found: dict[str, float] = {}
        for number in sorted(set(digits)):
            kind = f"_{number}" if len(digits) > 1 else ""
            drawn = seed_everything(10_000 + seed)
            told = measured(policy, verify_sorted, pass_at_k, drawn, (number,), prompts, room=room, temperature=temperature)
            found |= {f"held_out_{name}{kind}": value for name, value in told.items()}
        return found

    def look_colder(when: str) -> dict[str, float]:
        """The held-out measurements at each lower temperature, such as "before_pass_1_at_0.5"."""
        return {
            f"{when}_{name.removeprefix('held_out_')}_at_{temperature}": value
            for temperature in choice.get("colder", ())
            for name, value in look(96, temperature).items()
        }

    before = look(96)
    colder = look_colder("before")
    rows = [{"iteration": 0, "answers": 0, "seconds": 0.0, **before}]
    if not iterations:
        asked = [prompt for prompt in questions(200, generator, digits) for _ in range(16)]
        right = verify_sorted(asked, policy.generate(asked, room, generator=generator).texts).reshape(-1, 16)
        alike = {
            f"silent_{size}": (parts == parts[..., :1]).all(-1).float().mean().item()
            for size in (2, 4, 8, 16)
            for parts in [right.reshape(200, -1, size)]
        }
        return Result(rows, before | alike | {"right": right.mean().item()})
    seconds, logged = 0.0, []
    for done in range(1, iterations + 1):
        begun = time.process_time()
        prompts = questions(asks, generator, digits)
        logged.append(dict(iteration(learner, prompts, verify, settings, generator)))
        if isinstance(learner, Watched):
            logged[-1]["entropy"] = learner.entropy
        seconds += time.process_time() - begun
        if done % span == 0:
            recent = [one | two for one, two in zip(logged[-span:], seen[-span:] or [{}] * span, strict=True)]
            means = {
                name: float(np.mean([one[name] for one in recent if name in one])) for name in {n for one in recent for n in one}
            }
            rows.append({"iteration": done, "answers": done * answers, "seconds": seconds, **means})
            if done % LOOK == 0:
                rows[-1] |= look(96 if done == iterations else 48)
            report(done, iterations)
    final = {name: value for name, value in rows[-1].items() if name.startswith("held_out")}
    summary = final | {f"before_{name.removeprefix('held_out_')}": value for name, value in before.items()}
    summary |= colder | look_colder("held_out")
    asked = questions(6, seed_everything(20_000 + seed), digits, held_out=True)
    written = policy.generate(asked, room, generator=seed_everything(seed)).texts
    shown = [{"prompt": prompt, "text": text} for prompt, text in zip(asked, written, strict=True)]
    return Result(rows, summary | {"seconds": seconds, "warm_seconds": warm_seconds, "texts": shown})
