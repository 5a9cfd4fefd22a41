"""Attention for episodes with branches: a log that everything after it may read, and one branch per decision.

A branch (the block before an answer, and the answer) reads the log up to its own moment and itself; the log reads the log. So
an episode is encoded once for all of its decisions, and what a decision was shown or should have answered is in no other's
view. At run time one branch follows the log as ordinary text, with the same positions, so nothing special is needed there.

Paper: none; it is how the language model is trained.

Shape letters: B rows, S = M + N * W tokens of a row, M tokens of the log, N branches of W tokens, H heads, D head dimension.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS

from proprio_mllm.model.batch import Movable

__all__ = ["Branches", "branch_attention", "with_branches"]

_NAME = "branches"


@dataclass(frozen=True, slots=True)
class Branches(Movable):
    """How the rows of a batch are laid out.

    Attributes:
        log: M.
        anchors: (B, N) tokens of the log that each branch sees.
    """

    log: int
    anchors: Tensor


def branch_attention(
    module: Any, query: Tensor, key: Tensor, value: Tensor, attention_mask: Branches, scaling: float, **_: Any
) -> tuple[Tensor, None]:
    """Transformers' attention interface.

    Args:
        module: the attention layer.
        query: (B, H, S, D).
        key: (B, H / groups, S, D).
        value: (B, H / groups, S, D).
        attention_mask: the layout; Transformers passes on what it is given per kind of layer.
        scaling: of the scores.

    Returns:
        (B, S, H, D), and no weights.
    """
    groups = query.shape[1] // key.shape[1]
    if groups > 1:
        key, value = key.repeat_interleave(groups, 1), value.repeat_interleave(groups, 1)
    query, key = query.to(value.dtype), key.to(value.dtype)  # rotation leaves them wider
    return _attend(query * scaling, key, value, attention_mask.log, attention_mask.anchors), None


def _attend(query: Tensor, key: Tensor, value: Tensor, m: int, anchors: Tensor) -> Tensor:
    """Attention of scaled queries (B, H, S, D): (B, S, H, D)."""
    rows, heads, size, dim = query.shape
    n = anchors.shape[1]
    w = (size - m) // n
    log_key, log_value = key[:, :, :m], value[:, :, :m]
    scores = query[:, :, :m] @ log_key.mT  # (B, H, M, M)
    future = torch.ones(m, m, dtype=torch.bool, device=query.device).triu(1)
    out_log = _softmax(scores.masked_fill(future, -torch.inf)) @ log_value  # (B, H, M, D)

    own_query = query[:, :, m:]  # (B, H, N * W, D)
    behind = own_query @ log_key.mT  # (B, H, N * W, M)
    unseen = torch.arange(m, device=query.device) >= anchors[:, :, None]  # (B, N, M)
    behind = behind.unflatten(2, (n, w)).masked_fill(unseen[:, None, :, None], -torch.inf)  # (B, H, N, W, M)
    folded = (rows, heads, n, w, dim)
    own_key, own_value = key[:, :, m:].reshape(folded), value[:, :, m:].reshape(folded)
    own = own_query.reshape(folded) @ own_key.mT  # (B, H, N, W, W)
    own = own.masked_fill(torch.ones(w, w, dtype=torch.bool, device=query.device).triu(1), -torch.inf)
    weights = _softmax(torch.cat([behind, own], -1))  # (B, H, N, W, M + W)
    out = weights[..., :m].flatten(2, 3) @ log_value + (weights[..., m:] @ own_value).flatten(2, 3)  # (B, H, N * W, D)
    return torch.cat([out_log, out], 2).transpose(1, 2)


def _softmax(scores: Tensor) -> Tensor:
    return torch.softmax(scores, -1, dtype=torch.float32).to(scores.dtype)


@contextmanager
def with_branches(text_model: Any) -> Iterator[None]:
    """Lets a language model attend along branches; inside, `attention_mask` is `{"full_attention": Branches}`."""
    ALL_ATTENTION_FUNCTIONS.register(_NAME, branch_attention)
    config, before = text_model.config, text_model.config._attn_implementation
    config._attn_implementation = _NAME
    try:
        yield
    finally:
        config._attn_implementation = before
