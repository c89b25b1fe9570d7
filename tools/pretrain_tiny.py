"""Pretrain the course's tiny language model and write course_lib/models/tiny/: weights, tokenizer, configuration, model card.

    python tools/pretrain_tiny.py [--steps N] [--checkpoint FOLDER]

About 40 minutes of one core. It may be killed at any time: the same command goes on from the last checkpoint, and as every step draws
from generators seeded by its own number, the result is the same as without the interruption. The text is that of the snippets (never
their ratings) in the splits "policy" and "reward_model"; "validation" chooses the step that is kept; "test" is read once, at the end.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import os
import time
from pathlib import Path

import safetensors.torch
import torch
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
from torch.nn import functional
from tqdm import tqdm
from transformers import GPT2Config, GPT2LMHeadModel

from autograder.paths import COURSE_LIB
from course_lib.language import lm, preferences
from course_lib.seeding import seed_everything

TARGET = COURSE_LIB / "models" / "tiny"
END = "<|endoftext|>"
VOCABULARY = 2048
CONTEXT = 128
SEED = 0
BATCH = 32  # snippets a step, about 1,200 tokens
CYCLES = ((3000, 1.5e-3), (1600, 7e-4))  # steps and highest learning rate of each descent
WEIGHT_DECAY = 0.1
DROPOUT = 0.1
WARMUP = 150
EVALUATE_EVERY = 100
POOL = 8 * BATCH  # drawn together and sorted by length, so that rows of a batch need little padding


CARD = """\
# The tiny language model

GPT-2's architecture with {parameters:,} parameters: 4 layers, width 192, 6 heads, byte-level BPE of 2,048 tokens, context of 128 tokens.
It writes sentences in the manner of film reviews, most of them ungrammatical: large enough to be fine-tuned from preferences within
minutes on a laptop, too small for anything else.

| | |
|---|---|
| data | texts, without ratings, of the splits `policy` and `reward_model` of `course_lib/data/ratings.parquet`:\
 film reviews, and for breadth Amazon reviews, editorials and tweets |
| never seen | the splits `validation` (it chose the step that was kept), `gold` and `test` |
| held-out loss | **{test_loss:.2f} nats a token** on the film reviews of `test`,\
 {test_nats_per_character:.3f} nats a character, end tokens included |
| training | {steps:,} steps of 32 snippets, of which step {kept_step:,} was kept; AdamW, dropout 0.1, weight decay 0.1, bfloat16 products |
| time | {minutes:.0f} minutes of one thread on a shared two-core virtual machine, torch {torch} |
| command | `python tools/pretrain_tiny.py` (resumes; `training.json` is its log) |
| files | `model.safetensors` in half precision, `config.json`, `tokenizer.json` |
| licence | MIT, as the code and the data |

It repeats the tone, the prejudices and the names of its sources, invents facts, and must not be used to judge or to inform anybody.

Six samples at temperature 1 from the empty prompt, seed 0, not chosen:

{samples}
"""


def train_tokenizer(texts: list[str]) -> Tokenizer:
    """Byte-level byte-pair encoding, as GPT-2's, with one special token that begins, ends and pads."""
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=VOCABULARY,
        special_tokens=[END],
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    tokenizer.train_from_iterator(texts, trainer)
    return tokenizer


def encode(tokenizer: Tokenizer, texts: list[str]) -> list[list[int]]:
    """Each text between end tokens, cut to the context."""
    end = tokenizer.token_to_id(END)
    return [[end, *encoding.ids, end][:CONTEXT] for encoding in tokenizer.encode_batch(texts)]


def padded(rows: list[list[int]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows (B) of tokens as input_ids (B, L) and the mask of what is no padding."""
    width = max(map(len, rows))
    input_ids = torch.tensor([row + [0] * (width - len(row)) for row in rows])
    return input_ids, torch.arange(width) < torch.tensor([len(row) for row in rows])[:, None]


def film_share(step: int) -> float:
    """Share of film reviews among the snippets: half at first, then ever more, after nine tenths of the first cycle all."""
    return min(1.0, max(0.5, 0.5 + step / CYCLES[0][0] - 0.4))


def learning_rate(step: int) -> float:
    """In each cycle a linear warm-up, then half a cosine down to a fiftieth."""
    steps, highest = CYCLES[0]
    if step >= steps:
        step -= steps
        steps, highest = CYCLES[1]
    cosine = 0.5 * (1 + math.cos(math.pi * max(0, step - WARMUP) / (steps - WARMUP)))
    return highest * min(1.0, (step + 1) / WARMUP) * (0.02 + 0.98 * cosine)


def batch(step: int, films: list[list[int]], others: list[list[int]]) -> tuple[torch.Tensor, torch.Tensor]:
    """The snippets of one step: it depends on the step's number and on nothing before it."""
    generator = torch.Generator().manual_seed(1_000_003 * SEED + step)
    num_films = round(film_share(step) * POOL)
    pool = [films[i] for i in torch.randperm(len(films), generator=generator)[:num_films]]
    pool += [others[i] for i in torch.randperm(len(others), generator=generator)[: POOL - num_films]]
    pool.sort(key=len)
    first = BATCH * int(torch.randint(POOL // BATCH, (1,), generator=generator))
    return padded(pool[first : first + BATCH])


def token_losses(model: GPT2LMHeadModel, input_ids: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Negative log-likelihood of every kept token but the first, in nats, in one row."""
    with torch.autocast("cpu", torch.bfloat16):  # twice as fast where the processor has it; parameters stay in single precision
        logits = model(input_ids, attention_mask=mask.long()).logits
    kept = mask[:, 1:]
    return functional.cross_entropy(logits[:, :-1][kept].float(), input_ids[:, 1:][kept], reduction="none")


@torch.no_grad()
def held_out_loss(model: GPT2LMHeadModel, rows: list[list[int]]) -> float:
    """Mean loss in nats per token over all tokens of `rows`, the end token included."""
    model.eval()
    ordered = sorted(rows, key=len)
    losses = [token_losses(model, *padded(ordered[i : i + BATCH])) for i in range(0, len(ordered), BATCH)]
    model.train()
    return torch.cat(losses).double().mean().item()


def save_checkpoint(path: Path, state: dict) -> None:
    part = path.with_suffix(".part")
    torch.save(state, part)
    part.rename(path)


def configuration() -> GPT2Config:
    return GPT2Config(
        vocab_size=VOCABULARY,
        n_positions=CONTEXT,
        n_embd=192,
        n_layer=4,
        n_head=6,
        resid_pdrop=DROPOUT,
        embd_pdrop=DROPOUT,
        attn_pdrop=0.0,
        bos_token_id=0,
        eos_token_id=0,
        pad_token_id=0,
    )


def train(steps: int, folder: Path) -> None:
    torch.set_num_threads(1)
    texts = {
        (kind, split): preferences.load(split, sources).texts
        for kind, sources in (("film", ("film",)), ("other", ("amazon", "news", "tweet")))
        for split in ("policy", "reward_model", "validation", "test")
    }
    films = texts["film", "policy"] + texts["film", "reward_model"]
    others = texts["other", "policy"] + texts["other", "reward_model"]
    tokenizer = train_tokenizer(films + others)
    film_rows, other_rows = encode(tokenizer, films), encode(tokenizer, others)
    validation = encode(tokenizer, texts["film", "validation"])

    torch.manual_seed(SEED)
    model = GPT2LMHeadModel(configuration())
    decayed = [parameter for parameter in model.parameters() if parameter.ndim > 1]
    plain = [parameter for parameter in model.parameters() if parameter.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": WEIGHT_DECAY}, {"params": plain, "weight_decay": 0.0}]
    optimizer = torch.optim.AdamW(groups, betas=(0.9, 0.98), fused=True)
    state = {"step": 0, "seconds": 0.0, "best": math.inf, "best_step": 0, "kept": None, "log": []}
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = folder / "tiny.pt"
    if checkpoint.exists():
        saved = torch.load(checkpoint)
        model.load_state_dict(saved.pop("model"))
        optimizer.load_state_dict(saved.pop("optimizer"))
        state = saved

    model.train()
    begun = time.perf_counter() - state["seconds"]
    for step in tqdm(range(state["step"], steps), initial=state["step"], total=steps, mininterval=20):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(step)
        torch.manual_seed(1_000_003 * (SEED + 1) + step)  # of the dropout
        loss = token_losses(model, *batch(step, film_rows, other_rows)).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        if (step + 1) % EVALUATE_EVERY == 0 or step + 1 == steps:
            validated = held_out_loss(model, validation)
            state["log"].append({"step": step + 1, "loss": loss.item(), "validation_loss": validated})
            tqdm.write(json.dumps(state["log"][-1]))
            if validated < state["best"]:
                state |= {"best": validated, "best_step": step + 1, "kept": copy.deepcopy(model.state_dict())}
            state |= {"step": step + 1, "seconds": time.perf_counter() - begun}
            save_checkpoint(checkpoint, state | {"model": model.state_dict(), "optimizer": optimizer.state_dict()})
    model.load_state_dict(state["kept"])
    write(model, tokenizer, state, texts["film", "test"])


def write(model: GPT2LMHeadModel, tokenizer: Tokenizer, state: dict, test: list[str]) -> None:
    """The model's files and card. Weights in half precision: the tied output matrix is the embedding and is not stored twice."""
    model.half().float()  # what a reader loads is what is measured
    rows = encode(tokenizer, test)
    loss = held_out_loss(model, rows)
    characters = sum(map(len, test))
    predicted = sum(len(row) - 1 for row in rows)
    TARGET.mkdir(parents=True, exist_ok=True)
    weights = {name: value.half().contiguous() for name, value in model.state_dict().items() if name != "lm_head.weight"}
    safetensors.torch.save_file(weights, TARGET / "model.safetensors", metadata={"format": "pt"})
    (TARGET / "model.safetensors").chmod(0o644)
    tokenizer.save(str(TARGET / "tokenizer.json"), pretty=False)
    model.config.architectures = ["GPT2LMHeadModel"]
    model.config.to_json_file(TARGET / "config.json")
    facts = {
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "steps": state["step"],
        "kept_step": state["best_step"],
        "validation_loss": round(state["best"], 4),
        "test_loss": round(loss, 4),
        "test_nats_per_character": round(loss * predicted / characters, 4),
        "minutes": round(state["seconds"] / 60, 1),
        "torch": torch.__version__.split("+")[0],
        "log": state["log"],
    }
    (TARGET / "training.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    samples = "\n".join(f"> {text}\n>" for text in lm.load("tiny").generate([""] * 6, 40, generator=seed_everything(0)).texts)
    (TARGET / "README.md").write_text(CARD.format(samples=samples.removesuffix("\n>"), **facts), encoding="utf-8")
    print(json.dumps(facts | {"log": "…"}, indent=1))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=sum(steps for steps, _ in CYCLES))
    parser.add_argument(
        "--checkpoint", type=Path, default=Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "course"
    )
    arguments = parser.parse_args()
    train(arguments.steps, arguments.checkpoint)
