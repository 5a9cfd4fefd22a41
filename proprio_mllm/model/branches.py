"""Attention for episodes with branches: a log that everything after it may read, and one branch per decision.

A branch (the block before an answer, and the answer) reads the log up to its own moment and itself; the log reads the log. So
an episode is encoded once for all of its decisions, and what a decision was shown or should have answered is in no other's
view. At run time one branch follows the log as ordinary text, with the same positions, so nothing special is needed there.

Paper: none; it is how the language model is trained.

Rows are padded for attention alone. Everything else of the language model runs over the tokens that are kept, in one line: half
of a padded batch is padding.

Shape letters: B rows, S = M + N * W tokens of a row, M tokens of the log, N branches of W tokens, H heads, D head dimension, T
tokens of all rows without padding, filled up to a multiple of `_LINE` since kernels are prepared anew for every size.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor
from torch.autograd import Function
from torch.nn import functional
from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS

from proprio_mllm.model.batch import Movable

_NAME: Final = "branches"
_LINE: Final = 256


@dataclass(frozen=True, slots=True)
class Branches(Movable):
    """How the rows of a batch are laid out.

    Attributes:
        log: M.
        anchors: (B, N) tokens of the log that each branch sees.
    """

    log: int
    anchors: Tensor


@dataclass(frozen=True, slots=True)
class _Line:
    """Where the tokens of padded rows are in the line of kept ones.

    Attributes:
        layout: of the rows.
        slots: (T,) slot of each token of the line among the B * S; 0 for those that fill it up.
        places: (B * S,) the token of each slot; the line's last one, which fills it up, for padding.
        kept: tokens of the line that are of a row.
    """

    layout: Branches
    slots: Tensor
    places: Tensor
    kept: int

    @staticmethod
    def of(layout: Branches, kept: Tensor) -> _Line:
        """The line of rows whose kept tokens are told by a mask (B, S)."""
        found = kept.flatten().nonzero()[:, 0]
        count = len(found)
        slots = functional.pad(found, (0, _LINE - count % _LINE))  # at least one fills it up
        places = torch.full((kept.numel(),), len(slots) - 1, device=kept.device)
        places[found] = torch.arange(count, device=kept.device)
        return _Line(layout, slots, places, count)

    def rows(self, line: Tensor) -> Tensor:
        """(T, ...) of the line as (B, S, ...) of the rows."""
        taken: Any = _Taken.apply(line, self.places, self.slots, self.kept)
        return taken.unflatten(0, (len(self.layout.anchors), -1))

    def line(self, rows: Tensor) -> Tensor:
        """(B, S, ...) of the rows as (T, ...) of the line."""
        taken: Any = _Taken.apply(rows.flatten(0, 1), self.slots, self.places, len(self.places))
        return taken


class _Taken(Function):
    """Rows of a table by their numbers, where every row that matters is taken once: the gradient is a look-up as well.

    Nothing is read of what pads a row or fills up the line, so their gradients are zero: those behind `kept` are set so, and
    padding looks up the last of them.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, taken: Tensor, inverse: Tensor, kept: int) -> Tensor:
        ctx.save_for_backward(inverse)
        ctx.kept = kept
        return table[taken]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        (inverse,) = ctx.saved_tensors
        grad = grads[0][inverse]
        grad[ctx.kept :] = 0.0
        return grad, None, None, None


def _attention(
    module: Any, query: Tensor, key: Tensor, value: Tensor, attention_mask: _Line, scaling: float, **_: Any
) -> tuple[Tensor, None]:
    """Transformers' attention interface.

    Args:
        module: the attention layer.
        query: (1, H, T, D).
        key: (1, H / groups, T, D).
        value: (1, H / groups, T, D).
        attention_mask: the line; Transformers passes on what it is given per kind of layer.
        scaling: of the scores.

    Returns:
        (1, T, H, D), and no weights.
    """
    line = attention_mask
    groups = query.shape[1] // key.shape[1]
    query, key, value = (
        line.rows(one[0].transpose(0, 1).to(value.dtype)).transpose(1, 2) for one in (query * scaling, key, value)
    )
    if groups > 1:
        key, value = key.repeat_interleave(groups, 1), value.repeat_interleave(groups, 1)
    return line.line(_attend(query, key, value, line.layout.log, line.layout.anchors))[None], None


def _attend(query: Tensor, key: Tensor, value: Tensor, m: int, anchors: Tensor) -> Tensor:
    """Attention of scaled queries (B, H, S, D): (B, S, H, D)."""
    n, device = anchors.shape[1], query.device
    (q_log, q_own), (k_log, k_own), (v_log, v_own) = (
        (rows[:, :, :m], rows[:, :, m:].unflatten(2, (n, -1))) for rows in (query, key, value)
    )
    of_log = torch.softmax(q_log @ k_log.mT + _past(m, query), -1) @ v_log
    # the log's keys are met by all branches of a row at once; a branch meets its own (B, H, N, W, W)
    told = torch.arange(m, device=device) < anchors[..., None]  # (B, N, M)
    unseen = torch.zeros_like(told, dtype=query.dtype).masked_fill(~told, -torch.inf)[:, None, :, None]
    to_log = (q_own.flatten(2, 3) @ k_log.mT).unflatten(2, (n, -1)) + unseen
    to_own = q_own @ k_own.mT + _past(q_own.shape[3], query)
    shares = torch.softmax(torch.cat([to_log, to_own], -1), -1)
    of_branches = shares[..., :m].flatten(2, 3) @ v_log + (shares[..., m:] @ v_own).flatten(2, 3)
    return torch.cat([of_log, of_branches], 2).transpose(1, 2)


def _past(length: int, like: Tensor) -> Tensor:
    """Zero where a token sees, minus infinity where it does not (length, length)."""
    return torch.full((length, length), -torch.inf, dtype=like.dtype, device=like.device).triu(1)


def read_branches(
    model: Any,
    input_ids: Tensor,
    position_ids: Tensor,
    layout: Branches,
    kept: Tensor,
    inputs_embeds: Tensor | None = None,
    **inputs: Any,
) -> Tensor:
    """Last hidden states of rows with branches.

    Args:
        model: a language model of Transformers, or one that sees with a language model in it.
        input_ids: (B, S).
        position_ids: (B, S), or (3, B, S).
        layout: where the branches are.
        kept: (B, S) tokens that are no padding; of each log and each branch, the first ones.
        inputs_embeds: (B, S, hidden) where the embeddings are not those of the tokens alone.
        inputs: what else the model takes.

    Returns:
        (B, S, hidden); what it holds of padding means nothing.
    """
    line = _Line.of(layout, kept)
    if inputs_embeds is not None:
        inputs["inputs_embeds"] = line.line(inputs_embeds)[None]
    with _own_attention(getattr(model, "language_model", model)):
        hidden = model(
            input_ids=input_ids.flatten()[line.slots][None],
            attention_mask={"full_attention": line},
            position_ids=position_ids.flatten(-2)[..., line.slots].unsqueeze(-2),
            use_cache=False,
            **inputs,
        )[0]
    return line.rows(hidden[0])


@contextmanager
def _own_attention(text_model: Any) -> Iterator[None]:
    ALL_ATTENTION_FUNCTIONS.register(_NAME, _attention)
    config, before = text_model.config, text_model.config._attn_implementation
    config._attn_implementation = _NAME
    try:
        yield
    finally:
        config._attn_implementation = before
