"""How fast an iteration of chapter 101 is beside TRL's GRPOTrainer: the same model, groups and lengths, one thread each, back to back.

    python tools/bench_grpo.py [--rounds N] [--record FILE.json]

An iteration asks 24 prompts of five digits 8 times each, verifies 192 answers of at most 8 tokens, keeps their log-probabilities and
takes three steps on 64 of them, for both with the bounds 0.2 and 0.28, the mean over tokens, no divergence and AdamW, which is fused
for TRL alone. TRL is spared what it would do by default and ours doesn't: activation checkpoints, half precision, logs; it answers with
a cache of keys and values, and gets the same network, with GELU in one kernel. Tokenizers of both are kept from starting threads.
Seconds are processor time, as in bench_dpo.py; ratios are taken within a round, and the table shows medians.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
import transformers
from bench_dpo import Stopwatch
from datasets import Dataset, disable_progress_bars
from rich.console import Console
from rich.table import Table
from trl import GRPOConfig, GRPOTrainer

from course_lib.language import lm, verifiable
from course_lib.language.verifiable import GroupSettings, Learner, questions
from course_lib.seeding import seed_everything
from solutions.ch101 import grpo_iteration, verify_sorted

WARM_UP, ITERATIONS = 2, 5
SETTINGS = GroupSettings()
ANSWERS = SETTINGS.prompts * SETTINGS.group_size
STEPS = ANSWERS // SETTINGS.minibatch  # of an iteration


def started() -> lm.LanguageModel:
    """The policy that chapter 101 begins with."""
    policy = verifiable.fresh(seed=0)
    for _ in verifiable.warm_up(policy, steps=100, seed=0):
        pass
    return policy


def reward(prompts, completions, **_) -> list[float]:
    return verify_sorted(prompts, completions).tolist()


def trl(policy: lm.LanguageModel, folder: str) -> Iterator[float]:
    """Rounds of TRL, each from the same policy: yields seconds of an iteration."""
    generator = seed_everything(1)
    prompts = [{"prompt": text} for text in questions(SETTINGS.prompts * (WARM_UP + ITERATIONS), generator)]
    tokenizer = transformers.PreTrainedTokenizerFast(
        tokenizer_object=policy.tokenizer.backend_tokenizer, eos_token=lm.END, pad_token=lm.END, padding_side="left"
    )
    arguments = GRPOConfig(
        folder, per_device_train_batch_size=SETTINGS.minibatch, steps_per_generation=STEPS, num_generations=SETTINGS.group_size,
        max_completion_length=SETTINGS.new_tokens, max_steps=STEPS * (WARM_UP + ITERATIONS), learning_rate=SETTINGS.learning_rate,
        epsilon=SETTINGS.clip_low, epsilon_high=SETTINGS.clip_high, beta=0.0, loss_type="dapo", scale_rewards="group",
        max_grad_norm=SETTINGS.max_grad_norm, lr_scheduler_type="constant", weight_decay=0.0, temperature=1.0, top_k=0, top_p=1.0,
        bf16=False, gradient_checkpointing=False, use_cpu=True, seed=0, optim="adamw_torch_fused",
        logging_strategy="no", save_strategy="no", report_to="none", disable_tqdm=True,
    )  # fmt: skip
    while True:
        watch = Stopwatch()
        network = policy.frozen_copy().requires_grad_(True).network
        contestant = GRPOTrainer(network, reward, arguments, Dataset.from_list(prompts), processing_class=tokenizer)
        contestant.remove_callback(transformers.PrinterCallback)
        contestant.add_callback(watch)
        contestant.train()
        yield (watch.ends[-1] - watch.ends[WARM_UP * STEPS - 1]) / ITERATIONS


def ours(policy: lm.LanguageModel) -> Iterator[float]:
    """Rounds of the chapter's iteration, each from the same policy: yields seconds of an iteration."""
    while True:
        generator = seed_everything(1)
        learner = Learner(policy.frozen_copy().requires_grad_(True), SETTINGS.learning_rate)
        for number in range(WARM_UP + ITERATIONS):
            if number == WARM_UP:
                begun = time.process_time()
            grpo_iteration(learner, questions(SETTINGS.prompts, generator), verify_sorted, SETTINGS, generator)
        yield (time.process_time() - begun) / ITERATIONS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--record", type=Path, help="also write the result to this JSON file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    disable_progress_bars()
    os.environ |= {"TQDM_DISABLE": "1", "TOKENIZERS_PARALLELISM": "false"}
    transformers.logging.set_verbosity_error()
    policy = started()
    with tempfile.TemporaryDirectory() as folder:
        contestants = {"TRL": trl(policy, folder), "ours": ours(policy)}
        rounds = [{name: next(seconds) for name, seconds in contestants.items()} for _ in range(arguments.rounds)]
    versions = {name: importlib.metadata.version(name) for name in ("trl", "torch", "transformers", "accelerate")}
    ratios = [one["TRL"] / one["ours"] for one in rounds]
    shown = Table("", "processor seconds an iteration", title=f"TRL {versions['trl']}, {ANSWERS} answers an iteration")
    for name in contestants:
        shown.add_row(name, f"{statistics.median(one[name] for one in rounds):.3f}")
    Console(width=100).print(shown)
    print(f"TRL takes {statistics.median(ratios):.2f} times as long ({min(ratios):.2f} to {max(ratios):.2f})")
    if arguments.record:
        record = {
            "date": datetime.date.today().isoformat(),
            "machine": f"{platform.machine()}, {os.cpu_count()} cores",
            "versions": versions,
            "rounds": rounds,
        }
        arguments.record.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
