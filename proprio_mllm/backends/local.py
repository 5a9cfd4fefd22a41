"""A vision-language checkpoint that answers chats in this process.

Made for Qwen2.5-VL-7B-Instruct and InternVL2.5-8B (its `-hf` form), from a folder on this machine. Calls from many threads are
answered together (`Batcher`): whenever the model is free it takes what waits, up to `batch`. A row's reply does not depend on
the rows beside it, up to the rounding of sums, which in half precision can tip two tokens that are almost equally likely.

Temperature 0 takes the most likely token, nothing else: the sampling and the repetition penalty that a checkpoint's files
recommend (Qwen2.5-VL: 1.05) are not applied, as they are not by the servers of the other models.

Shape letters: B rows, L tokens of the longest prompt. Paper: the local baselines of Table II.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import logging
import threading
import time
from collections.abc import Sequence
from typing import Any, Final

import torch
from jinja2.exceptions import TemplateError
from PIL import Image, UnidentifiedImageError
from torch import Tensor
from transformers import LogitsProcessorList, StoppingCriteriaList

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.batching import Batcher
from proprio_mllm.backends.checkpoint import Loaded, find_checkpoint, load_checkpoint
from proprio_mllm.backends.decoding import Grammars, GrammarState, Limits, Rule, Rules, import_xgrammar
from proprio_mllm.backends.identity import identity_of
from proprio_mllm.backends.protocol import BackendError, ChatImage, ChatMessage, ChatReply, ChatRequest, RequestError

#: Longest side of a picture, in pixels.
_LARGEST_SIDE: Final = 4096

logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, slots=True)
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


class LocalChat:
    """A model in this process that answers chats; any number of threads may ask.

    Args:
        cfg: `model` is the checkpoint's folder; `revision`, `device`, `dtype`, `batch` and `constrained` are used too. Without
            a revision the checkpoint's fingerprint stands in for it.

    Raises:
        BackendSetupError: when the folder is no checkpoint that can answer, the device is not there, or `constrained` is asked
            for and xgrammar is not installed.
    """

    def __init__(self, cfg: BackendConfig) -> None:
        if cfg.constrained:
            import_xgrammar()  # a missing extra stops here, before weights load
        checkpoint = find_checkpoint(cfg.model)
        loaded = load_checkpoint(checkpoint, cfg)
        self._loaded: Loaded | None = loaded
        self._grammars = Grammars(loaded.processor.tokenizer, loaded.vocabulary, loaded.ends) if cfg.constrained else None
        self.revision = cfg.revision or checkpoint.fingerprint()
        #: Model and revision, as replies name them.
        self.model = f"{checkpoint.folder.resolve().name}@{self.revision}"
        #: As recorded replies are known: without a revision of the configuration, they belong to this fingerprint.
        self.identity = identity_of(dataclasses.replace(cfg, revision=self.revision))
        #: Where it runs and with how many tokens of prompt and reply together, for people.
        self.device, self.context = str(loaded.model.device), loaded.context
        self._encoding = threading.Lock()  # tokenizers are not made for several threads at once
        self._batcher: Batcher[Row, ChatReply] = Batcher(self._answer, cfg.batch)

    @property
    def batches(self) -> int:
        """Batches that the model has answered so far."""
        return self._batcher.batches

    def complete(self, request: ChatRequest) -> ChatReply:
        """The reply to a request; the latency counts the wait for the model too.

        Raises:
            BackendError: when there is none; a `RequestError` when the request itself is the reason.
        """
        started = time.perf_counter()
        loaded = self._open()
        self._grammar(request)  # a schema that has no grammar is this request's error, not its batch's
        with self._encoding:
            row = encode(loaded.processor, request, loaded.context)
        reply = self._batcher.ask(row)
        return dataclasses.replace(reply, latency_s=time.perf_counter() - started, model=self.model)

    def close(self) -> None:
        """Frees the model once the batch under way is answered; calls that wait, and later ones, get an error."""
        self._batcher.close()
        self._loaded = self._grammars = None
        if torch.cuda.is_available():
            torch.cuda.empty_cache()

    def _open(self) -> Loaded:
        if self._loaded is None:
            raise BackendError(f"{self.model} is closed")
        return self._loaded

    def _grammar(self, request: ChatRequest) -> GrammarState | None:
        grammars, schema = self._grammars, request.schema
        return None if grammars is None or schema is None else grammars.start(schema)

    def _answer(self, rows: Sequence[Row]) -> list[ChatReply | Exception]:
        """One reply per row, or its error; a batch that does not fit the GPU's memory is halved until it does."""
        try:
            return list(self._generate(self._open(), rows))
        except torch.OutOfMemoryError as error:
            cause = str(error).splitlines()[0]
        torch.cuda.empty_cache()  # outside the handler: the error keeps the failed batch's tensors alive
        if len(rows) == 1:
            return [BackendError(f"{self.model}: prompt of {rows[0].prompt} tokens: out of memory on {self.device}: {cause}")]
        logger.warning("%s: a batch of %d does not fit the memory of %s; halved", self.model, len(rows), self.device)
        half = len(rows) // 2
        return self._answer(rows[:half]) + self._answer(rows[half:])

    def _generate(self, loaded: Loaded, rows: Sequence[Row]) -> list[ChatReply]:
        """Replies to one batch; latency and model are filled in by the caller."""
        batch = _collate(rows, loaded.pad, loaded.model.device, loaded.model.dtype)
        width = batch["input_ids"].shape[1]
        limits = [row.limit for row in rows]
        asked = [row.request for row in rows]
        rules = [Rule(request.temperature, _seed(request), self._grammar(request)) for request in asked]
        made = loaded.model.generate(
            **batch,
            do_sample=False,
            max_new_tokens=max(limits),
            logits_processor=LogitsProcessorList([Rules(rules)]),
            stopping_criteria=StoppingCriteriaList([Limits(width, limits)]),
        )
        replies: list[ChatReply] = []
        for row, ids in zip(rows, made[:, width:].tolist(), strict=True):
            end = next((index for index, token in enumerate(ids[: row.limit]) if token in loaded.ends), None)
            ids = ids[: row.limit] if end is None else ids[: end + 1]
            text = loaded.processor.tokenizer.decode(ids, skip_special_tokens=True)
            replies.append(ChatReply(text, row.prompt, len(ids), finish_reason="length" if end is None else "stop"))
        return replies


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


def open_picture(image: ChatImage) -> Image.Image:
    """The decoded picture, in RGB.

    Raises:
        RequestError: when it cannot be read, or has a side above 4096 pixels.
    """
    try:
        opened = Image.open(io.BytesIO(image.data), formats=("PNG", "JPEG"))
        if max(opened.size) > _LARGEST_SIDE:
            raise RequestError(f"picture of {opened.width} x {opened.height} pixels; allowed: sides up to {_LARGEST_SIDE}")
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


def _seed(request: ChatRequest) -> int:
    """Seed of a request's draws, from its words, pictures and sample index alone."""
    digest = hashlib.sha256()
    for message in request.messages:
        digest.update(f"\0{message.role}".encode())
        for part in message.content:
            digest.update(f"\0{part if isinstance(part, str) else part.digest}".encode())
    digest.update(f"\0{request.sample}".encode())
    return int.from_bytes(digest.digest()[:7], "big")


def _collate(rows: Sequence[Row], pad: int, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
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
        joined = torch.cat(parts)  # (B, L), or (pictures, ...)
        batch[name] = joined.to(device, dtype if joined.is_floating_point() else None)
    return batch
