"""A vision-language checkpoint that answers chats in this process.

Made for Qwen2.5-VL-7B-Instruct and InternVL2.5-8B (its `-hf` form), from a folder on this machine. Calls from many threads are
answered together (`Batcher`): whenever the model is free it takes what waits, up to `batch`. A row's reply does not depend on
the rows beside it, up to the rounding of sums, which in half precision can tip two tokens that are almost equally likely.

Temperature 0 takes the most likely token, nothing else: the sampling and the repetition penalty that a checkpoint's files
recommend (Qwen2.5-VL: 1.05) are not applied, as they are not by the servers of the other models.

Paper: the local baselines of Table II.
"""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
from collections.abc import Sequence

import torch
from transformers import LogitsProcessorList, StoppingCriteriaList

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.batching import Batcher
from proprio_mllm.backends.checkpoint import Loaded, find_checkpoint, load_checkpoint
from proprio_mllm.backends.decoding import Limits, Rule, Rules
from proprio_mllm.backends.grammar import Grammars, import_xgrammar
from proprio_mllm.backends.identity import identity_of
from proprio_mllm.backends.protocol import BackendError, ChatReply, ChatRequest
from proprio_mllm.backends.rows import Row, collate, encode, seed_of

__all__ = ["LocalChat"]

logger = logging.getLogger(__name__)


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
        revision = cfg.revision or checkpoint.fingerprint()
        self._loaded: Loaded | None = load_checkpoint(checkpoint, cfg)
        model = self._loaded.model
        self._grammars = (
            Grammars(self._loaded.processor.tokenizer, self._loaded.vocabulary, self._loaded.ends) if cfg.constrained else None
        )
        #: Model and revision, as replies name them.
        self.model = f"{checkpoint.folder.resolve().name}@{revision}"
        self.revision = revision
        #: As recorded replies are known: without a revision of the configuration, they belong to this fingerprint.
        self.identity = identity_of(dataclasses.replace(cfg, revision=revision))
        #: Where it runs and with how many tokens of prompt and reply together, for people.
        self.device, self.context = str(model.device), self._loaded.context
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
        if self._grammars is not None and request.schema is not None:
            self._grammars.compiled(request.schema)  # a schema that has no grammar is this request's error, not its batch's
        with self._encoding:
            row = encode(loaded.processor, request, loaded.context)
        reply = self._batcher.ask(row)
        return ChatReply(
            reply.text,
            reply.prompt_tokens,
            reply.completion_tokens,
            time.perf_counter() - started,
            reply.finish_reason,
            self.model,
        )

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
        model, tokenizer = loaded.model, loaded.processor.tokenizer
        batch = collate(rows, loaded.pad, model.device, model.dtype)
        width = batch["input_ids"].shape[1]
        limits = [row.limit for row in rows]
        made = model.generate(
            **batch,
            do_sample=False,
            max_new_tokens=max(limits),
            logits_processor=LogitsProcessorList([Rules([self._rule(row.request) for row in rows])]),
            stopping_criteria=StoppingCriteriaList([Limits(width, limits)]),
        )
        replies: list[ChatReply] = []
        for row, ids in zip(rows, made[:, width:].tolist(), strict=True):
            end = next((index for index, token in enumerate(ids[: row.limit]) if token in loaded.ends), None)
            ids = ids[: row.limit] if end is None else ids[: end + 1]
            text = tokenizer.decode(ids, skip_special_tokens=True)
            replies.append(ChatReply(text, row.prompt, len(ids), finish_reason="length" if end is None else "stop"))
        return replies

    def _rule(self, request: ChatRequest) -> Rule:
        grammars, schema = self._grammars, request.schema
        grammar = grammars.start(schema) if grammars is not None and schema is not None else None
        return Rule(request.temperature, seed_of(request), grammar)
