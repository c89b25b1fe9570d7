"""How fast chapter 97's DPO step is beside TRL's DPOTrainer, on the same pairs and weights, one thread each, back to back.

    python tools/bench_dpo.py [--rounds N] [--record FILE.json] [--table FILE.json]

First the two must agree: on fixed log-probabilities (TRL's own loss code is called; --table keeps what it said, for the tests), and on
the tiny language model, gradients included. Then both train it in single precision with fused AdamW, on batches of 16 pairs of 48
tokens, of which each pair shares 16: with the reference asked in every step, and with its answers known beforehand. TRL is spared what
it would do by default and ours doesn't: activation checkpoints, half precision, logs. It trains the network as transformers loads it
("TRL") and as course_lib.language.lm does, with GELU in one kernel ("TRL, our GELU"). Seconds are processor time: the wall clock of a busy
machine says more about its other users. Ratios are taken within a round, between neighbours in time; the table shows medians.
"""

from __future__ import annotations

import argparse
import datetime
import functools
import importlib.metadata
import json
import os
import platform
import statistics
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import torch
import transformers
from datasets import Dataset, disable_progress_bars
from rich.console import Console
from rich.table import Table
from trl import DPOConfig, DPOTrainer

from course_lib.language import lm
from course_lib.language.direct import Pairs, completion_logps, reference_logps, train_step
from solutions.ch97 import dpo_loss, ipo_loss, sequence_logps

PAIRS, LENGTH, PROMPT = 16, 48, 16
WARM_UP, STEPS = 2, 8
BETA, LEARNING_RATE = 0.1, 1e-5


class ReadyTrainer(DPOTrainer):
    """Takes tokens as they are, and remembers the processor time at the end of each step."""

    def _prepare_dataset(self, dataset, *_):
        return dataset


class Stopwatch(transformers.TrainerCallback):
    def on_step_end(self, *_, **__):
        self.ends.append(time.process_time())

    def on_train_begin(self, *_, **__):
        self.ends = []


def batch_of_pairs(vocabulary: int) -> Pairs:
    """Random tokens: what they are makes no difference to the time."""
    generator = torch.Generator().manual_seed(0)
    input_ids = torch.randint(1, vocabulary, (PAIRS, 2, LENGTH), generator=generator)
    input_ids[:, 1, :PROMPT] = input_ids[:, 0, :PROMPT]
    everything = torch.ones_like(input_ids, dtype=torch.bool)
    return Pairs(input_ids, everything, everything & (torch.arange(LENGTH) >= PROMPT))


def trainer(model: lm.LanguageModel, pairs: Pairs, folder: str, **settings) -> ReadyTrainer:
    rows = [
        {"prompt_ids": chosen[:PROMPT], "chosen_ids": chosen[PROMPT:], "rejected_ids": rejected[PROMPT:]}
        for chosen, rejected in pairs.input_ids.tolist()
    ]
    arguments = {
        "per_device_train_batch_size": PAIRS, "max_steps": WARM_UP + STEPS, "learning_rate": LEARNING_RATE, "beta": BETA,
        "optim": "adamw_torch_fused", "lr_scheduler_type": "constant", "max_grad_norm": 1.0,
        "bf16": False, "gradient_checkpointing": False, "use_cpu": True, "seed": 0,
        "logging_strategy": "no", "save_strategy": "no", "report_to": "none", "disable_tqdm": True,
    }  # fmt: skip
    contestant = ReadyTrainer(
        model=model.frozen_copy().requires_grad_(True).network,
        ref_model=model.frozen_copy().network,
        args=DPOConfig(folder, **arguments | settings),
        train_dataset=Dataset.from_list(rows * (WARM_UP + STEPS)),
        processing_class=transformers.PreTrainedTokenizerFast(
            tokenizer_object=model.tokenizer.backend_tokenizer, eos_token=lm.END, pad_token=lm.END
        ),
    )
    contestant.remove_callback(transformers.PrinterCallback)
    return contestant


# ----------------------------------------------------------------------------------------------------------- agreement


def said(per_token_logps: torch.Tensor):
    """A network that answers TRL's loss with these log-probabilities, and with zeros where it asks for things to log."""
    zeros = torch.zeros_like(per_token_logps)
    answer = SimpleNamespace(log_probs=per_token_logps, entropy=zeros, mean_logits=zeros, is_top1=zeros.bool())
    return lambda **_: answer


def cases() -> list[dict]:
    """What TRL's loss makes of fixed log-probabilities of single pairs: hand-picked extremes and random ones."""
    generator = torch.Generator().manual_seed(0)
    extremes = [[-30.0, -30.0, -30.0, -30.0], [-30.0, -50.0, -40.0, -40.0], [-10.0, -400.0, -200.0, -200.0]]
    extremes.append([-400.0, -10.0, -200.0, -200.0])
    drawn = (-60 * torch.rand(8, 4, generator=generator, dtype=torch.float64)).tolist()
    kinds = [("sigmoid", beta, 0.0) for beta in (0.1, 0.5)] + [("aot", 0.1, 0.2), ("aot", 0.5, 0.4), ("ipo", 0.1, 0.0)]
    return [
        {"loss_type": kind, "beta": beta, "label_smoothing": smoothing, "logps": logps, "lengths": [12, 20]}
        for kind, beta, smoothing in kinds
        for logps in extremes + drawn
    ]


def loss_of_trl(judge: ReadyTrainer, case: dict) -> float:
    """TRL's own code on one pair. Conservative DPO is what its "aot" comes to then: "sigmoid" takes no label_smoothing."""
    judge.loss_types, judge.loss_weights = [case["loss_type"]], [1.0]
    judge.beta, judge.label_smoothing = case["beta"], case["label_smoothing"]
    lengths = torch.tensor(case["lengths"])
    mask = (torch.arange(1 + max(lengths)) >= 1) & (torch.arange(1 + max(lengths)) <= lengths[:, None])
    chosen, rejected, ref_chosen, ref_rejected = case["logps"]
    shares = mask[:, 1:] / lengths[:, None].double()
    policy, judge.ref_model = (
        said(shares * torch.tensor(pair, dtype=torch.float64)[:, None])
        for pair in ((chosen, rejected), (ref_chosen, ref_rejected))
    )
    inputs = {"input_ids": mask.long(), "attention_mask": mask.long(), "completion_mask": mask.long()}
    return judge._compute_loss(policy, inputs, return_outputs=False).item()


def our_loss(case: dict) -> float:
    """The same by the course's functions. TRL divides log-probabilities by lengths for IPO; here that is the caller's choice."""
    logps = torch.tensor(case["logps"], dtype=torch.float64)
    if case["loss_type"] == "ipo":
        return ipo_loss(*(logps / torch.tensor(case["lengths"] * 2)).split(1), beta=case["beta"]).item()
    return dpo_loss(*logps.split(1), beta=case["beta"], label_smoothing=case["label_smoothing"])[0].item()


def agree(model: lm.LanguageModel, pairs: Pairs, folder: str) -> list[dict]:
    """Stop if the two losses or their gradients differ; the table of TRL's losses otherwise."""
    judge = trainer(model, pairs, folder)
    policy, theirs = model.frozen_copy().requires_grad_(True), judge.model
    for one, other in zip(policy.network.parameters(), theirs.parameters(), strict=True):
        noise = 0.01 * torch.randn_like(one)
        with torch.no_grad():
            one.add_(noise)
            other.add_(noise)
    flat = [part.transpose(0, 1).flatten(0, 1).long() for part in pairs]
    loss = judge._compute_loss(theirs, dict(zip(("input_ids", "attention_mask", "completion_mask"), flat, strict=True)), False)
    loss.backward()
    ref_logps = reference_logps(model, pairs, sequence_logps)
    ours = dpo_loss(*completion_logps(policy, pairs, sequence_logps).unbind(1), *ref_logps.unbind(1), beta=BETA)[0].mean()
    ours.backward()
    torch.testing.assert_close(ours, loss, rtol=0, atol=1e-5)
    for one, other in zip(policy.network.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(one.grad, other.grad, rtol=1e-3, atol=1e-4)

    table = [case | {"loss": loss_of_trl(judge, case)} for case in cases()]
    for case in table:
        assert abs(our_loss(case) - case["loss"]) < 1e-6, (case, our_loss(case))
    return table


# ---------------------------------------------------------------------------------------------------------------- speed


def as_loaded_by_transformers(tokenizer) -> lm.LanguageModel:
    return lm.LanguageModel(transformers.AutoModelForCausalLM.from_pretrained(lm.FOLDER / "tiny", dtype=torch.float32), tokenizer)


def trl(model: lm.LanguageModel, pairs: Pairs, folder: str, **settings):
    """Rounds of TRL: yields seconds per step."""
    watch = Stopwatch()
    contestant = trainer(model, pairs, folder, **settings)
    contestant.add_callback(watch)
    while True:
        contestant.train()
        yield (watch.ends[-1] - watch.ends[WARM_UP - 1]) / STEPS


def ours(model: lm.LanguageModel, pairs: Pairs, cached: bool):
    """Rounds of the course's step: yields seconds per step."""
    policy, reference = model.frozen_copy().requires_grad_(True), model.frozen_copy()
    optimizer = torch.optim.AdamW(policy.parameters(), lr=LEARNING_RATE, weight_decay=0.0, fused=True)
    loss = functools.partial(dpo_loss, beta=BETA)
    known = reference_logps(reference, pairs, sequence_logps)
    while True:
        for step in range(WARM_UP + STEPS):
            if step == WARM_UP:
                start = time.process_time()
            rows = torch.randperm(PAIRS)
            batch = pairs.of(rows)
            ref_logps = known[rows] if cached else reference_logps(reference, batch, sequence_logps)
            train_step(policy, optimizer, batch, ref_logps, loss, sequence_logps)
        yield (time.process_time() - start) / STEPS


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--record", type=Path, help="also write the result to this JSON file")
    parser.add_argument("--table", type=Path, help="also write TRL's losses on fixed log-probabilities to this JSON file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    disable_progress_bars()
    os.environ["TQDM_DISABLE"] = "1"
    model = lm.load("tiny")
    pairs = batch_of_pairs(model.network.config.vocab_size)
    versions = {name: importlib.metadata.version(name) for name in ("trl", "torch", "transformers", "accelerate", "datasets")}

    with tempfile.TemporaryDirectory() as folder:
        table = agree(model, pairs, folder)
        print(
            f"The losses of TRL {versions['trl']} and of chapter 97 agree: {len(table)} cases, and gradients on the tiny model."
        )
        if arguments.table:
            arguments.table.write_text(json.dumps({"trl": versions["trl"], "cases": table}, indent=1) + "\n")
        networks = {"TRL": as_loaded_by_transformers(model.tokenizer), "TRL, our GELU": model}
        contestants = {}
        for suffix, cached in (("", False), (", cached", True)):
            for name, network in networks.items():
                contestants[name + suffix] = trl(network, pairs, folder, precompute_ref_log_probs=cached)
            contestants["ours" + suffix] = ours(model, pairs, cached)
        rounds = [{name: next(seconds) for name, seconds in contestants.items()} for _ in range(arguments.rounds)]

    shown = Table("", "seconds a step", "TRL takes times as long", "TRL, our GELU")
    for name in contestants:
        seconds = statistics.median(one[name] for one in rounds)
        rivals = [rival + ", cached" * name.endswith("cached") for rival in networks]
        ratios = [[one[rival] / one[name] for one in rounds] for rival in rivals]
        shown.add_row(
            name, f"{seconds:.3f}", *(f"{statistics.median(ratio):.2f} ({min(ratio):.2f} to {max(ratio):.2f})" for ratio in ratios)
        )  # fmt: skip
    Console(width=100).print(shown)
    if arguments.record:
        record = {
            "date": datetime.date.today().isoformat(),
            "machine": f"{platform.machine()}, {os.cpu_count()} cores",
            "versions": versions,
            "settings": {
                "model": "tiny", "pairs": PAIRS, "tokens": LENGTH, "prompt_tokens": PROMPT, "beta": BETA,
                "learning_rate": LEARNING_RATE, "steps": STEPS, "threads": 1,
            },
            "rounds": rounds,
        }  # fmt: skip
        arguments.record.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
