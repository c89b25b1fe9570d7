"""GRPO on sorting digits with a model of 100,000 parameters, and what may stand in its place (chapter 101).

Baselines, a critic, supervised learning, difficulty, a verifier with a hole and a silent bug. A run's seed is that of the model, of its
warm-up and of training. Every iteration of every variant asks the verifier about 192 answers; a row stands for ten iterations. In some
of them the policy is measured on prompts whose answers were never asked for in training.
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
PRICE = 1e-3  # of a character, in the silent bug
VARIANTS: dict[str, dict] = {
    "grpo": COMMON,
    "rloo": COMMON | {"baseline": "leave_one_out", "scale": "none"},
    "dr_grpo": COMMON | {"scale": "none", "how": "constant"},
    "ppo": COMMON | {"method": "ppo"},
    "supervised": COMMON | {"method": "supervised"},
    "rejection": COMMON | {"method": "rejection"},
    "lab_suspect": MIXED | {"price": PRICE},
    "lab_repaired": MIXED | {"price": PRICE, "scale": "none"},
    "lab_batch": MIXED | {"price": PRICE, "scale": "batch"},
    "strong": COMMON | {"warm_up": STRONG},
    "hole": COMMON | {"verifier": "ascending"},
    **{f"group_{size}": COMMON | {"prompts": 192 // size, "group_size": size} for size in (2, 4, 16, 32)},
    **{f"digits_{n}": COMMON | {"digits": [n], "room": n + 3, "iterations": 0} for n in (4, 5, 6, 7)},
}
SEEDS = 5
ROWS, LOOK = 10, 30  # iterations that a row stands for, and between two measurements
SETTINGS = ("prompts", "group_size", "baseline", "scale", "how")


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


def ppo(policy: lm.LanguageModel, seed: int, settings: GroupSettings) -> Callable:
    """An iteration with a critic of the policy's size, as in chapter 95, on as many answers, each to a prompt of its own."""
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
            values = critic.model(ids, attention)[:, :-1]
        advantages = masked_gae(rewards, values, mask, 1.0, 1.0)
        returns, advantages = advantages + values, masked_whiten(advantages, mask)
        for rows in minibatches(len(prompts), settings.minibatch, generator):
            logps = per_token_logps(policy.logits(ids[rows], attention[rows]), ids[rows])
            loss = ppo_token_loss(logps, old_logps[rows], advantages[rows], mask[rows])
            errors = critic.model(ids[rows], attention[rows])[:, :-1] - returns[rows]
            policy.step(loss, settings.max_grad_norm)
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
        policy, seed, settings
    )
    asks = answers if method in ("ppo", "supervised") else settings.prompts
    learner = Learner(policy, settings.learning_rate)
    generator = seed_everything(100 + seed)
    seen: list[dict[str, float]] = []

    def verify(prompts, completions):
        rewards, right = pays(prompts, completions), verify_sorted(prompts, completions)
        sizes = torch.tensor([len(prompt) - 1 for prompt in prompts])
        lengths = torch.tensor([float(len(text)) for text in completions])
        kinds = {"_few": sizes == min(digits), "_many": sizes == max(digits)} if len(digits) > 1 else {}
        told = {"right": right, "characters": lengths}
        seen.append(
            {name: part.mean().item() for name, part in told.items()}
            | {name + kind: part[rows].mean().item() for name, part in told.items() for kind, rows in kinds.items() if rows.any()}
        )
        return rewards

    def look(prompts: int) -> dict[str, float]:
        found: dict[str, float] = {}
        for number in sorted(set(digits)):
            kind = f"_{number}" if len(digits) > 1 else ""
            told = measured(policy, verify_sorted, pass_at_k, seed_everything(10_000 + seed), (number,), prompts, room=room)
            found |= {f"held_out_{name}{kind}": value for name, value in told.items()}
        return found

    before = look(96)
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
        logged.append(iteration(learner, prompts, verify, settings, generator))
        seconds += time.process_time() - begun
        if done % ROWS == 0:
            recent = [one | two for one, two in zip(logged[-ROWS:], seen[-ROWS:] or [{}] * ROWS, strict=True)]
            means = {
                name: float(np.mean([one[name] for one in recent if name in one])) for name in {n for one in recent for n in one}
            }
            rows.append({"iteration": done, "answers": done * answers, "seconds": seconds, **means})
            if done % LOOK == 0:
                rows[-1] |= look(96 if done == iterations else 48)
            report(done, iterations)
    final = {name: value for name, value in rows[-1].items() if name.startswith("held_out")}
    summary = final | {f"before_{name.removeprefix('held_out_')}": value for name, value in before.items()}
    asked = questions(6, seed_everything(20_000 + seed), digits, held_out=True)
    written = policy.generate(asked, room, generator=seed_everything(seed)).texts
    shown = [{"prompt": prompt, "text": text} for prompt, text in zip(asked, written, strict=True)]
    return Result(rows, summary | {"seconds": seconds, "warm_seconds": warm_seconds, "texts": shown})
