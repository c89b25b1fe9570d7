#!/usr/bin/env bash
# TRL's DPOConfig takes `label_smoothing`; with the default loss type ("sigmoid") the trainer ignores it, without a warning.
#
# Conservative DPO (Mitchell, 2023, https://ericmitchell.ai/cdpo.pdf) is that loss with smoothed labels, so that this pair of settings
# reads as a request for it. What trains is ordinary DPO.
#
# Seen in November 2026 with TRL 1.16.0: one step on one pair of texts, with a reference that is another model, logs the same loss for
# label_smoothing 0 and 0.4; loss_type "robust" logs two different ones, so that the setting does arrive. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check torch==2.13.0 transformers==5.23.0 trl==1.16.0 datasets==5.2.0 accelerate==1.15.0
cd "$folder"
HF_HUB_OFFLINE=1 HF_DATASETS_DISABLE_PROGRESS_BARS=1 TQDM_DISABLE=1 venv/bin/python - <<'PYTHON'
import warnings

import torch
from datasets import Dataset
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import GPT2Config, GPT2LMHeadModel, PreTrainedTokenizerFast, PrinterCallback
from trl import DPOConfig, DPOTrainer

words = {word: number for number, word in enumerate(["<pad>", "<eos>", "<unk>", "the", "film", "is", "good", "bad"])}
raw = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
raw.pre_tokenizer = pre_tokenizers.Whitespace()
tokenizer = PreTrainedTokenizerFast(tokenizer_object=raw, pad_token="<pad>", eos_token="<eos>", unk_token="<unk>")
pair = Dataset.from_dict({"prompt": ["the film is"], "chosen": [" good"], "rejected": [" bad"]})


def model(seed):
    torch.manual_seed(seed)
    sizes = dict(vocab_size=len(words), n_positions=16, n_embd=16, n_layer=1, n_head=2, bos_token_id=1, eos_token_id=1)
    drawn = GPT2LMHeadModel(GPT2Config(**sizes, resid_pdrop=0.0, embd_pdrop=0.0, attn_pdrop=0.0))
    with torch.no_grad():
        for weights in drawn.parameters():
            weights.mul_(5)  # so that the two models differ by more than a rounding
    return drawn


def first_loss(loss_type, label_smoothing):
    options = dict(per_device_train_batch_size=1, max_steps=1, logging_steps=1, report_to=[], use_cpu=True, bf16=False, beta=1.0)
    config = DPOConfig("out", loss_type=[loss_type], label_smoothing=label_smoothing, disable_tqdm=True, **options)
    trainer = DPOTrainer(model(0), ref_model=model(1), args=config, train_dataset=pair, processing_class=tokenizer)
    trainer.remove_callback(PrinterCallback)
    trainer.train()
    return next(row["loss"] for row in trainer.state.log_history if "loss" in row)


with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    losses = {(kind, amount): first_loss(kind, amount) for kind in ("sigmoid", "robust") for amount in (0.0, 0.4)}
for (kind, amount), loss in losses.items():
    print(f"loss_type {kind:8s} label_smoothing {amount}: first loss {loss}")
told = [str(one.message) for one in said if "smoothing" in str(one.message)]
print("warnings about it:", told or "none")
assert losses["sigmoid", 0.0] == losses["sigmoid", 0.4] and not told, "this is no longer so"
assert losses["robust", 0.0] != losses["robust", 0.4]
PYTHON
