"""Dense, name-tied supervision of visual tokens, for training a backbone from scratch.

Released vision-language weights come with words bound to image regions; a small model trained on questions alone does not learn
that binding. Here each merged visual token says which object types its cell shows, scored by the cosine with the language
model's own embedding of the type's name, and where its cell lies in space. Uses simulator truth, in training only; the paper
has no such stage, it stands in for the backbone's pretraining.

Shape letters: I images, h and w rows and columns of the merged grid, N = h * w, D hidden size, C types.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from proprio_mllm.model.batch import Movable
from proprio_mllm.model.modeling import ProprioMLLM


@dataclass(frozen=True, slots=True)
class DenseTargets(Movable):
    """Truth per cell.

    Attributes:
        types: (I, N, C) share of the cell's pixels that show each type, in [0, 1].
        points_m: (I, N, 3) mean point of the cell, camera frame, metres.
        valid: (I, N) whether the cell has a point.
    """

    types: Tensor
    points_m: Tensor
    valid: Tensor


@dataclass(frozen=True, slots=True)
class DenseLoss:
    """Loss terms and two measures: recall of shown types, and the mean point error in metres."""

    total: Tensor
    types: Tensor
    points: Tensor
    recall: float
    point_error_m: float


def dense_targets(
    segmentation: Tensor, points_m: Tensor, grid: tuple[int, int], types: int, far_m: float = 10.0
) -> DenseTargets:
    """Truth per cell of the merged grid.

    Args:
        segmentation: (I, H, W) integer type index, -1 for none.
        points_m: (I, H, W, 3) points in the camera frame; pixels that are not finite or beyond `far_m` are left out.
        grid: (h, w); H and W must be multiples.
        types: number of types C.
        far_m: farthest point.

    Raises:
        ValueError: when the image is not a multiple of the grid or a type is out of range.
    """
    images, height, width = segmentation.shape
    h, w = grid
    if height % h or width % w:
        raise ValueError(f"image {height} x {width} is not a multiple of the grid {h} x {w}")
    if int(segmentation.max()) >= types or int(segmentation.min()) < -1:
        raise ValueError(f"type index {int(segmentation.max())} outside [-1, {types})")

    def cells(x: Tensor) -> Tensor:  # (I, H, W, ...) to (I, N, pixels per cell, ...)
        x = x.unflatten(1, (h, height // h)).unflatten(3, (w, width // w)).transpose(2, 3)
        return x.flatten(3, 4).flatten(1, 2)

    labels = cells(segmentation.long() + 1)  # (I, N, P)
    counts = torch.zeros(images, h * w, types + 1, device=labels.device)
    counts.scatter_add_(2, labels, torch.ones_like(labels, dtype=counts.dtype))
    valid = torch.isfinite(points_m).all(-1)
    clean = torch.where(valid[..., None], points_m.float(), 0.0)
    valid &= clean.norm(dim=-1) < far_m
    shown = cells(valid).float()  # (I, N, P)
    total = (cells(clean) * shown[..., None]).sum(2)  # (I, N, 3)
    return DenseTargets(counts[..., 1:] / labels.shape[2], total / shown.sum(2).clamp_min(1)[..., None], shown.sum(2) > 0)


class DenseHead(nn.Module):
    """Scores object names and regresses points from visual tokens.

    Args:
        model: gives the hidden size and the tokenizer.
        type_names: the C names, in the order of the segmentation's indices.
        min_share: smallest share of a cell's pixels that counts as showing a type.
    """

    name_ids: Tensor
    name_mask: Tensor

    def __init__(self, model: ProprioMLLM, type_names: Sequence[str], min_share: float = 0.03) -> None:
        super().__init__()
        if not type_names:
            raise ValueError("type_names is empty")
        hidden = model.hidden_size
        rows = model.processor.tokenizer(list(type_names), add_special_tokens=False)["input_ids"]
        longest = max(len(row) for row in rows)
        self.register_buffer("name_ids", torch.tensor([row + [0] * (longest - len(row)) for row in rows]), persistent=False)
        mask = torch.tensor([[1.0] * len(row) + [0.0] * (longest - len(row)) for row in rows])
        self.register_buffer("name_mask", mask, persistent=False)
        self.min_share = min_share
        self.scale = nn.Parameter(torch.tensor(10.0).log())
        self.bias = nn.Parameter(torch.tensor(-4.0))
        self.point = nn.Linear(hidden, 3)

    def names(self, table: Tensor) -> Tensor:
        """Embeddings (C, D) of the names: the mean over each name's tokens in the language model's table (V, D)."""
        vectors = table[self.name_ids] * self.name_mask[..., None]
        return vectors.sum(1) / self.name_mask.sum(1, keepdim=True)

    def scores(self, visual: Tensor, table: Tensor) -> Tensor:
        """Logits (I, N, C) that a cell shows each type."""
        cosine = functional.normalize(visual.float(), dim=-1) @ functional.normalize(self.names(table).float(), dim=-1).T
        return cosine * self.scale.exp() + self.bias

    def forward(self, visual: Tensor, table: Tensor, targets: DenseTargets) -> DenseLoss:
        """Loss of visual tokens (I, N, D).

        Args:
            visual: `ProprioMLLM.visual_tokens` or `ModelOutput.visual`.
            table: the language model's input embeddings, `model.table`.
            targets: from `dense_targets`.
        """
        logits = self.scores(visual, table)
        shown = (targets.types >= self.min_share).to(logits.dtype)
        types = functional.binary_cross_entropy_with_logits(logits, shown, reduction="none").sum(-1).mean()
        points = self.point(visual.float())
        error = (points - targets.points_m).norm(dim=-1)  # (I, N)
        valid = targets.valid.to(error.dtype)
        point_loss = (error * valid).sum() / valid.sum().clamp_min(1)
        recall = float(((logits > 0) & (shown > 0)).sum() / (shown > 0).sum().clamp_min(1))
        return DenseLoss(types + point_loss, types.detach(), point_loss.detach(), recall, float(point_loss.detach()))
