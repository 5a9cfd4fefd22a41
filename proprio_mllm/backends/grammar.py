"""Replies held to a JSON schema, by xgrammar (extra `constrained`): tokens that would break it cannot be chosen.

The JSON comes on one line, with `, ` and `: ` between its parts. A reply that is cut off at its longest length is not whole
JSON, grammar or not.

Paper: none; its baselines are free to answer anything.
"""

from __future__ import annotations

import importlib
import json
import threading
from typing import Any

import torch
from pydantic import BaseModel
from torch import Tensor

from proprio_mllm.backends.protocol import BackendSetupError
from proprio_mllm.backends.rows import RequestError

__all__ = ["GrammarState", "Grammars", "import_xgrammar"]


def import_xgrammar() -> Any:
    """The module `xgrammar`.

    Raises:
        BackendSetupError: when it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module("xgrammar")
    except ImportError as error:
        raise BackendSetupError(
            f"constrained=true needs xgrammar, which is not installed ({error}): pip install 'proprio-mllm[constrained]'"
        ) from error


class GrammarState:
    """How far one reply has come in its grammar.

    Args:
        matcher: xgrammar's `GrammarMatcher`.
        vocabulary: entries of the logits.
    """

    def __init__(self, matcher: Any, vocabulary: int) -> None:
        self._matcher = matcher
        self._allowed = torch.zeros(1, (vocabulary + 31) // 32, dtype=torch.int32)
        self._ended = False

    def accept(self, token: int) -> None:
        """Takes the token that was chosen; what comes after the end, such as padding, is ignored."""
        self._ended = self._ended or self._matcher.is_terminated() or not self._matcher.accept_token(token)

    def mask(self, scores: Tensor) -> None:
        """Sets the scores (V,) of tokens that cannot come next to minus infinity, in place."""
        if self._ended or self._matcher.is_terminated():
            return
        self._matcher.fill_next_token_bitmask(self._allowed)
        bits = (self._allowed[0, :, None] >> torch.arange(32, dtype=torch.int32)) & 1  # (V / 32, 32), lowest bit first
        scores.masked_fill_(bits.flatten()[: scores.shape[0]].to(scores.device) == 0, -torch.inf)


class Grammars:
    """Compiles the grammars of one model, each schema once.

    Args:
        tokenizer: the model's.
        vocabulary: entries of the logits, which may be more than the tokenizer's.
        ends: ids of the tokens that end a reply.

    Raises:
        BackendSetupError: when xgrammar is not installed.
    """

    def __init__(self, tokenizer: Any, vocabulary: int, ends: tuple[int, ...]) -> None:
        self._xgrammar = import_xgrammar()
        info = self._xgrammar.TokenizerInfo.from_huggingface(tokenizer, vocab_size=vocabulary, stop_token_ids=list(ends))
        self._compiler = self._xgrammar.GrammarCompiler(info)
        self._vocabulary = vocabulary
        self._compiled: dict[str, Any] = {}
        self._compiling = threading.Lock()

    def compiled(self, schema: type[BaseModel]) -> Any:
        """The grammar of a schema, its fields in the schema's order.

        Raises:
            RequestError: when xgrammar cannot make a grammar of it.
        """
        text = json.dumps(schema.model_json_schema())
        with self._compiling:
            if text not in self._compiled:
                try:
                    self._compiled[text] = self._compiler.compile_json_schema(text, any_whitespace=False)
                except RuntimeError as error:
                    raise RequestError(
                        f"no grammar can be made of the schema {schema.__name__!r}: {str(error).strip()}"
                    ) from error
            return self._compiled[text]

    def start(self, schema: type[BaseModel]) -> GrammarState:
        """The state before the first token of a reply."""
        return GrammarState(self._xgrammar.GrammarMatcher(self.compiled(schema)), self._vocabulary)
