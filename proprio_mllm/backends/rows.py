"""Requests as tensors: one becomes a row, several rows become one batch, padded on the left.

Shape letters: B rows, L tokens of the longest prompt.

Paper: none (engineering).
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from jinja2.exceptions import TemplateError
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from proprio_mllm.backends.protocol import BackendError, ChatImage, ChatMessage, ChatRequest

__all__ = ["LARGEST_SIDE", "RequestError", "Row", "collate", "encode", "open_picture", "seed_of"]

#: Longest side of a picture, in pixels.
LARGEST_SIDE: Final = 4096


class RequestError(BackendError):
    """A request that this model cannot take, however often it is asked: too long, or a picture that cannot be read."""


@dataclass(frozen=True, slots=True)
class Row:
    """A request, ready for the model.

    Attributes:
        request: the question.
        inputs: the processor's tensors, a batch of one.
        prompt: tokens of the prompt.
        limit: most tokens of the reply: `max_tokens`, or what the model's context leaves.
    """

    request: ChatRequest
    inputs: dict[str, Tensor]
    prompt: int
    limit: int


def seed_of(request: ChatRequest) -> int:
    """Seed of a request's draws, from its words, pictures and sample index alone."""
    digest = hashlib.sha256()
    for message in request.messages:
        digest.update(f"\0{message.role}".encode())
        for part in message.content:
            digest.update(f"\0{part if isinstance(part, str) else part.digest}".encode())
    digest.update(f"\0{request.sample}".encode())
    return int.from_bytes(digest.digest()[:7], "big")


def open_picture(image: ChatImage) -> Image.Image:
    """The decoded picture, in RGB.

    Raises:
        RequestError: when it cannot be read, or has a side above `LARGEST_SIDE`.
    """
    try:
        opened = Image.open(io.BytesIO(image.data), formats=("PNG", "JPEG"))
        if max(opened.size) > LARGEST_SIDE:
            raise RequestError(f"picture of {opened.width} x {opened.height} pixels; allowed: sides up to {LARGEST_SIDE}")
        return opened.convert("RGB")
    except UnidentifiedImageError as error:
        raise RequestError(f"picture of {len(image.data)} bytes is neither PNG nor JPEG") from error
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise RequestError(f"picture of {len(image.data)} bytes cannot be read: {error}") from error


def _turn(message: ChatMessage) -> dict[str, Any]:
    """A message as chat templates take it; a blank line stands between texts that follow each other."""
    parts: list[dict[str, Any]] = []
    for part in message.content:
        if isinstance(part, ChatImage):
            parts.append({"type": "image", "image": open_picture(part)})
        elif parts and parts[-1]["type"] == "text":
            parts[-1]["text"] += f"\n\n{part}"
        else:
            parts.append({"type": "text", "text": part})
    return {"role": message.role, "content": parts}


def encode(processor: Any, request: ChatRequest, context: int) -> Row:
    """A request as the model reads it. Control tokens in its texts, such as those that end a turn, are read as plain letters.

    Args:
        processor: the checkpoint's.
        request: the question.
        context: most tokens of prompt and reply together.

    Raises:
        RequestError: when the prompt leaves no room for a reply, or the processor cannot take it.
    """
    chat = [_turn(message) for message in request.messages]
    try:
        made = processor.apply_chat_template(
            chat,
            add_generation_prompt=True,
            tokenize=True,
            return_dict=True,
            sanitize_control_tokens=True,
            processor_kwargs={"return_tensors": "pt"},
        )
    except (ValueError, TemplateError) as error:
        raise RequestError(f"the model's processor cannot take the request: {error}") from error
    inputs: dict[str, Tensor] = dict(made)
    prompt = inputs["input_ids"].shape[1]
    if prompt >= context:
        raise RequestError(f"prompt of {prompt} tokens; the model's context of {context} leaves no room for a reply")
    return Row(request, inputs, prompt, min(request.max_tokens, context - prompt))


def collate(rows: Sequence[Row], pad: int, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    """One batch of several rows.

    What has one entry per token is padded on the left, ids with `pad` and the rest with 0; what has one entry per picture, tile
    or patch is put one after another.
    """
    longest = max(row.prompt for row in rows)
    batch: dict[str, Tensor] = {}
    for name in dict.fromkeys(name for row in rows for name in row.inputs):
        parts = [row.inputs[name] for row in rows if name in row.inputs]
        if name in ("input_ids", "attention_mask", "mm_token_type_ids"):
            fill = pad if name == "input_ids" else 0
            parts = [torch.nn.functional.pad(part, (longest - part.shape[1], 0), value=fill) for part in parts]  # (1, L)
        batch[name] = torch.cat(parts)  # (B, L), or (pictures, ...)
        batch[name] = batch[name].to(device, dtype if batch[name].is_floating_point() else None)
    return batch
