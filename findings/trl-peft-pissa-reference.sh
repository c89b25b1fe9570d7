#!/usr/bin/env bash
# DPO of TRL 1.16.0 with a LoRA of PEFT 0.21.2 has the wrong reference, or trains the wrong model, once the adapter is made by
# `init_lora_weights="pissa"` or "olora", and says nothing. Policy and reference ought to be one model in the first step, which makes its
# loss log 2 = 0.693 whatever the texts.
#
# Why: these two take the adapter out of the model's own weights and leave the rest in them. With the adapter switched off, which is TRL's
# reference where it is given a `peft_config`, the rest alone answers. Where it is given a model that has its adapter, TRL adds a second for
# the reference by the same settings, which takes its part out of the rest once more: both are then one model, another than the one given.
#
# Seen in November 2026, a Llama of two layers with weights drawn at random, adapters of rank 8 at all linear layers, learning rate 0; the
# largest change in a token's log-probability against the model before TRL had it:
#   adapter by default, both ways    policy 0.00  reference 0.00  loss 0.693
#   pissa, as peft_config            policy 0.00  reference 4.58  loss 0.452
#   pissa, with its adapter already  policy 3.83  reference 3.83  loss 0.693
#   olora, as peft_config            policy 0.00  reference 4.61  loss 0.666
#   olora, with its adapter already  policy 3.13  reference 3.13  loss 0.693
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check torch==2.13.0 transformers==5.24.0 trl==1.16.0 peft==0.21.2 \
    datasets==5.2.0 accelerate==1.15.0
cd "$folder"
HF_HUB_OFFLINE=1 HF_DATASETS_DISABLE_PROGRESS_BARS=1 TQDM_DISABLE=1 venv/bin/python - <<'PYTHON'
import contextlib
import io
import logging
import math
import warnings

import torch
from datasets import Dataset
from peft import LoraConfig, get_peft_model
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast, PrinterCallback
from trl import DPOConfig, DPOTrainer

words = {word: number for number, word in enumerate(["<pad>", "<eos>", "<unk>", "the", "film", "is", "good", "bad"])}
raw = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
raw.pre_tokenizer = pre_tokenizers.Whitespace()
tokenizer = PreTrainedTokenizerFast(tokenizer_object=raw, pad_token="<pad>", eos_token="<eos>", unk_token="<unk>")
pair = Dataset.from_dict({"prompt": ["the film is"], "chosen": [" good"], "rejected": [" bad"]})
text = torch.tensor([[words[word] for word in ("the", "film", "is", "good")]])


def drawn():
    torch.manual_seed(0)
    sizes = dict(vocab_size=len(words), hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=2)
    return LlamaForCausalLM(LlamaConfig(**sizes, max_position_embeddings=16, initializer_range=0.3, eos_token_id=1))


def log_probabilities(model):
    with torch.no_grad():
        return model.eval()(input_ids=text).logits.log_softmax(-1)


before = log_probabilities(drawn())


def change(model):
    return (log_probabilities(model) - before).abs().max().item()


@contextlib.contextmanager
def as_reference(model):
    """The model as DPOTrainer asks it for the reference's log-probabilities: the adapter "ref" where there is one, else no adapter."""
    if "ref" not in model.peft_config:
        with model.disable_adapter():
            yield model
    else:
        model.set_adapter("ref")
        yield model
        model.set_adapter("default")


def first_step(init, with_adapter):
    lora = LoraConfig(r=8, lora_alpha=16, target_modules="all-linear", init_lora_weights=init)
    options = dict(per_device_train_batch_size=1, max_steps=1, logging_steps=1, report_to=[], use_cpu=True, bf16=False, disable_tqdm=True)
    config = DPOConfig("out", learning_rate=0.0, **options)
    model = drawn()
    if with_adapter:
        model = get_peft_model(model, lora)
        assert change(model) < 1e-4  # the model is still what it was
    given = {} if with_adapter else {"peft_config": lora}
    trainer = DPOTrainer(model, args=config, train_dataset=pair, processing_class=tokenizer, **given)
    policy = change(trainer.model)
    with as_reference(trainer.model) as reference:
        other = change(reference)
    trainer.remove_callback(PrinterCallback)
    trainer.train()
    return policy, other, next(row["loss"] for row in trainer.state.log_history if "loss" in row)


said = io.StringIO()
for name in ("", "trl", "peft", "transformers", "accelerate"):
    logging.getLogger(name).addHandler(logging.StreamHandler(said))
found = {}
with warnings.catch_warnings(record=True) as warned:
    warnings.simplefilter("always")
    for init in (True, "pissa", "olora"):
        for with_adapter in (False, True):
            found[init, with_adapter] = first_step(init, with_adapter)
for (init, with_adapter), (policy, reference, loss) in found.items():
    name = ("default" if init is True else init) + (", with its adapter already" if with_adapter else ", as peft_config")
    print(f"{name:35s} policy {policy:.2f}  reference {reference:.2f}  loss {loss:.3f}")
told = [str(one.message) for one in warned] + said.getvalue().splitlines()
told = [line for line in told if any(word in line.lower() for word in ("pissa", "olora", "adapter", "reference"))]
print("warnings about it:", told or "none")
for with_adapter in (False, True):
    policy, reference, loss = found[True, with_adapter]
    assert max(policy, reference) < 1e-4 and abs(loss - math.log(2)) < 1e-4
for init in ("pissa", "olora"):
    policy, reference, loss = found[init, False]
    assert policy < 1e-4 and reference > 1 and abs(loss - math.log(2)) > 0.01, "this is no longer so"
    policy, reference, loss = found[init, True]
    assert policy == reference > 1 and abs(loss - math.log(2)) < 1e-4, "this is no longer so"
assert not told
PYTHON
