"""A byte-level BPE tokenizer trained on the project's own text, in Qwen2's format with Qwen's special tokens.

The released Qwen tokenizer has 151 665 entries; a model trained from scratch on a CPU needs about a thousand. Same
pre-tokenisation, same special tokens, same classes: only the merges differ.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from typing import Any

from tokenizers import Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, trainers
from transformers import AddedToken, Qwen2Tokenizer
from transformers.models.qwen2.tokenization_qwen2 import PRETOKENIZE_REGEX

from interface.actions import ACTIONS

#: Qwen's special tokens, in its order.
SPECIAL_TOKENS: tuple[str, ...] = (
    "<|endoftext|>",
    "<|im_start|>",
    "<|im_end|>",
    "<|object_ref_start|>",
    "<|object_ref_end|>",
    "<|box_start|>",
    "<|box_end|>",
    "<|quad_start|>",
    "<|quad_end|>",
    "<|vision_start|>",
    "<|vision_end|>",
    "<|vision_pad|>",
    "<|image_pad|>",
    "<|video_pad|>",
)
#: Endings of object ids such as `Mug_1`, one token each.
ID_SUFFIXES: tuple[str, ...] = tuple(f"_{n}" for n in range(1, 10))
_WORD = re.compile(r"^[A-Za-z0-9_]+$")


def train_tokenizer(texts: Iterable[str], vocab_size: int, whole_words: Sequence[str] = ()) -> Qwen2Tokenizer:
    """Trains a tokenizer.

    Args:
        texts: the text to learn merges from; rendered conversations are fine, special and motion tokens are left out.
        vocab_size: most entries of the result, special tokens and whole words included; at least 256 bytes plus those.
        whole_words: words that are one token wherever they stand, such as object type names: a name then has the same
            embedding after a space, a bracket or another name. The longest match wins. Action names are always among them.

    Raises:
        ValueError: when `vocab_size` is too small, or a whole word is not of letters, digits and underscores.
    """
    words = tuple(dict.fromkeys((*whole_words, *ACTIONS, *ID_SUFFIXES)))
    for word in words:
        if not _WORD.match(word):
            raise ValueError(f"whole word {word!r}: allowed are letters, digits and underscores")
    size = vocab_size - len(SPECIAL_TOKENS) - len(words)
    if size < 256:
        raise ValueError(f"vocab_size {vocab_size} too small; at least {256 + len(SPECIAL_TOKENS) + len(words)} needed")
    fixed = sorted((*words, *SPECIAL_TOKENS), key=len, reverse=True)
    splitter = re.compile("|".join((r"<motion_\w+>", *(re.escape(word) for word in fixed))))
    trained = Tokenizer(models.BPE())
    trained.normalizer = normalizers.NFC()
    trained.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(PRETOKENIZE_REGEX), behavior="isolated", invert=False),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    trained.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=size,
        min_frequency=2,
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    # Merges are learnt on what is left between whole words, as encoding will see it.
    trained.train_from_iterator((piece for text in texts for piece in splitter.split(text) if piece), trainer)
    model = json.loads(trained.to_str())["model"]
    merges: Any = [tuple(merge) for merge in model["merges"]]  # the annotation lags behind what BPE takes
    tokenizer = Qwen2Tokenizer(
        vocab=model["vocab"],
        merges=merges,
        eos_token="<|im_end|>",
        pad_token="<|endoftext|>",
        unk_token="<|endoftext|>",
        additional_special_tokens=list(SPECIAL_TOKENS),
    )
    added: list[str | AddedToken] = [AddedToken(word, normalized=False, special=False) for word in words]
    tokenizer.add_tokens(added)
    return tokenizer
