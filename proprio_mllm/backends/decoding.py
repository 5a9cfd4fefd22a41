"""How the rows of one batch are decoded, each by its own rules: grammar, temperature and seed, longest reply.

The model's `generate` decodes greedily. A row that samples gets Gumbel noise on its scores, drawn from a generator of its own:
the largest of log p_i / T + g_i is distributed as softmax(log p / T) (Gumbel-max), so its draws depend on its seed and not on
the rows beside it, as draws from the one global generator that `generate` itself would use do.

A row with a JSON schema is held to it by xgrammar (extra `constrained`): tokens that would break it cannot be chosen. The JSON
comes on one line, with `, ` and `: ` between its parts. A reply that is cut off at its longest length is not whole JSON.

Shape letters: B rows, L tokens so far, V vocabulary. Paper: none; its baselines are free to answer anything.
"""

from __future__ import annotations

import importlib
import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from pydantic import BaseModel
from torch import Tensor
from transformers import LogitsProcessor, StoppingCriteria

from proprio_mllm.backends.protocol import BackendSetupError, RequestError


class GrammarState:
    """How far one reply has come in its grammar, an xgrammar `GrammarMatcher`."""

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

    def start(self, schema: type[BaseModel]) -> GrammarState:
        """The state before the first token of a reply, whose fields come in the schema's order.

        Raises:
            RequestError: when xgrammar cannot make a grammar of the schema.
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
            return GrammarState(self._xgrammar.GrammarMatcher(self._compiled[text]), self._vocabulary)


@dataclass(frozen=True, slots=True)
class Rule:
    """What holds for one row.

    Attributes:
        temperature: 0 takes the most likely token.
        seed: of the row's draws.
        grammar: what the reply has to keep to; None for free text.
    """

    temperature: float = 0.0
    seed: int = 0
    grammar: GrammarState | None = None


class Rules(LogitsProcessor):
    """Applies each row's rule to its scores; made anew for every batch."""

    def __init__(self, rules: Sequence[Rule]) -> None:
        self._rules = tuple(rules)
        self._generators = [torch.Generator().manual_seed(rule.seed) for rule in rules]
        self._started = False

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:
        """Scores to take the largest of: ids (B, L), scores (B, V) in float32."""
        scores = scores.clone()
        for index, (rule, generator) in enumerate(zip(self._rules, self._generators, strict=True)):
            if rule.grammar is not None:
                if self._started:
                    rule.grammar.accept(int(input_ids[index, -1]))
                rule.grammar.mask(scores[index])
            if rule.temperature > 0.0:
                gumbel = -torch.empty(scores.shape[1]).exponential_(generator=generator).log()  # (V,)
                scores[index] = scores[index] / rule.temperature + gumbel.to(scores.device)
        self._started = True
        return scores


class Limits(StoppingCriteria):
    """Ends each row at its own longest reply, `limits` tokens after a padded prompt of `prompt` tokens."""

    def __init__(self, prompt: int, limits: Sequence[int]) -> None:
        self._prompt = prompt
        self._limits = torch.tensor(list(limits))

    def __call__(self, input_ids: Tensor, scores: object, **kwargs: object) -> Any:
        """Which rows are done: (B,) of bool."""
        return (input_ids.shape[1] - self._prompt >= self._limits).to(input_ids.device)


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
