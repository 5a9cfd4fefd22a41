"""Asks a model held-out questions: its greedy replies, and how often they are right."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import torch

from proprio_mllm.model.batch import Collator, Example
from proprio_mllm.model.modeling import ProprioMLLM

_BATCH: Final = 16
#: Tokens of the longest planning step.
LONGEST_STEP: Final = 40
#: Longest answer of a word, a number or one action, tokens.
_SHORT: Final = 10


@torch.no_grad()
def replies(
    model: ProprioMLLM, asked: Sequence[Example], longest: int, allowed: Sequence[Sequence[str]] | None = None
) -> list[str]:
    """Greedy replies to open conversations, stripped.

    Args:
        model: in evaluation mode.
        asked: conversations without an answer.
        longest: tokens of a reply.
        allowed: the replies among which each has to choose; None leaves them free.
    """
    collator = Collator(model.processor, model.cfg)
    found: list[str] = []
    for start in range(0, len(asked), _BATCH):
        rows = slice(start, start + _BATCH)
        batch = collator(asked[rows], generation=True).to(model.device)
        found += [reply.strip() for reply in model.reply(batch, longest, allowed=allowed and allowed[rows])]
    return found


def answer_shares(model: ProprioMLLM, name: str, asked: Sequence[Example], answers: Sequence[str]) -> dict[str, float]:
    """`<name>_accuracy`, the share of short answers that are right, and `<name>_majority`, that of the commonest answer."""
    right = sum(reply == answer.strip() for reply, answer in zip(replies(model, asked, _SHORT), answers, strict=True))
    commonest = max(Counter(answers).values(), default=0)
    count = max(len(answers), 1)
    return {f"{name}_accuracy": right / count, f"{name}_majority": commonest / count}
