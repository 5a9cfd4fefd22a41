"""Conversations as ChatML text and as token ids with a loss mask.

A conversation is a sequence of `Message`s. The assistant's texts are supervised, closing token included, and those spans of a
user's text that repeat earlier answers. Several question and answer pairs about one image are consecutive turns of one
conversation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from transformers import PreTrainedTokenizerBase

IMAGE = "<|vision_start|><|image_pad|><|vision_end|>"
Role = Literal["system", "user", "assistant"]


@dataclass(frozen=True, slots=True)
class Message:
    """One turn.

    Attributes:
        role: who speaks.
        text: what is said.
        images: number of images that stand before the text.
        supervised: whether an assistant's text is learnt; context turns are not.
    """

    role: Role
    text: str
    images: int = 0
    supervised: bool = True

    def __post_init__(self) -> None:
        if self.role not in ("system", "user", "assistant"):
            raise ValueError(f"role {self.role!r} is not allowed; allowed: system, user, assistant")
        if self.images and self.role != "user":
            raise ValueError(f"only user messages carry images, got {self.images} in a {self.role} message")


@dataclass(frozen=True, slots=True)
class Encoded:
    """Token ids of a conversation and, for each, whether it is a target. One image pad per image, not yet expanded."""

    ids: tuple[int, ...]
    targets: tuple[bool, ...]


def _opening(role: str) -> str:
    return f"<|im_start|>{role}\n"


def render(messages: Sequence[Message], generation: bool = False) -> str:
    """The conversation as the chat template writes it, with one pad per image.

    Args:
        messages: the turns.
        generation: whether the assistant's opening follows.
    """
    text = "".join(f"{_opening(m.role)}{IMAGE * m.images}{m.text}<|im_end|>\n" for m in messages)
    return text + (_opening("assistant") if generation else "")


def to_chat(messages: Sequence[Message]) -> list[dict[str, object]]:
    """The conversation as the dictionaries that `apply_chat_template` takes."""
    return [
        {"role": m.role, "content": [*({"type": "image"} for _ in range(m.images)), {"type": "text", "text": m.text}]}
        for m in messages
    ]


def encode(tokenizer: PreTrainedTokenizerBase, messages: Sequence[Message], generation: bool = False) -> Encoded:
    """Token ids and targets of a conversation.

    The pieces are cut at special tokens, line ends and before spaces, so that encoding them one by one equals encoding the
    whole text.
    """
    pieces: list[tuple[str, bool]] = []
    for m in messages:
        pieces.append((f"{_opening(m.role)}{IMAGE * m.images}", False))
        pieces.append((f"{m.text}<|im_end|>", m.role == "assistant" and m.supervised))
        pieces.append(("\n", False))
    if generation:
        pieces.append((_opening("assistant"), False))
    merged: list[tuple[str, bool]] = []
    for text, target in pieces:  # fewer tokenizer calls
        if merged and merged[-1][1] == target:
            merged[-1] = (merged[-1][0] + text, target)
        else:
            merged.append((text, target))
    rows = tokenizer([text for text, _ in merged], add_special_tokens=False)["input_ids"]
    ids: list[int] = []
    targets: list[bool] = []
    for row, (_, target) in zip(rows, merged, strict=True):
        ids.extend(row)
        targets.extend([target] * len(row))
    return Encoded(tuple(ids), tuple(targets))
