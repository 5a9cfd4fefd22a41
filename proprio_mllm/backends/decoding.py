"""How the rows of one batch are decoded, each by its own rules: grammar, temperature and seed, longest reply.

The model's `generate` decodes greedily. A row that samples gets Gumbel noise on its scores, drawn from a generator of its own:
the largest of log p_i / T + g_i is distributed as softmax(log p / T) (Gumbel-max), so its draws depend on its seed and not on
the rows beside it, as draws from the one global generator that `generate` itself would use do.

Shape letters: B rows, L tokens so far, V vocabulary.

Paper: none (engineering).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from transformers import LogitsProcessor, StoppingCriteria

from proprio_mllm.backends.grammar import GrammarState

__all__ = ["Limits", "Rule", "Rules"]


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
    """Applies each row's rule to its scores; made anew for every batch.

    Args:
        rules: one for each row.
    """

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
    """Ends each row at its own longest reply.

    Args:
        prompt: tokens before the reply, padding included.
        limits: most tokens of each row's reply.
    """

    def __init__(self, prompt: int, limits: Sequence[int]) -> None:
        self._prompt = prompt
        self._limits = torch.tensor(list(limits))

    def __call__(self, input_ids: Tensor, scores: object, **kwargs: object) -> Any:
        """Which rows are done: (B,) of bool."""
        return (input_ids.shape[1] - self._prompt >= self._limits).to(input_ids.device)
