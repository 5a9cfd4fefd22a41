"""Dense, name-tied supervision of visual tokens, for training a backbone from scratch.

Released vision-language weights come with words bound to image regions; a small model trained on questions alone does not learn
that binding. Here each merged visual token says which object types its cell shows, scored by the cosine with the language
model's own embedding of the type's name. Uses simulator truth, in training only; the paper has no such stage, it stands in for
the backbone's pretraining. Where a cell lies in space is left to the point map: metric space is what CSE brings.

Shape letters: I images, h and w rows and columns of the merged grid, N = h * w, D hidden size, C types.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional


def shown_shares(segmentation: Tensor, grid: tuple[int, int], types: int) -> Tensor:
    """Share (I, N, C) of each cell's pixels that show each type, in [0, 1].

    Args:
        segmentation: (I, H, W) integer type index, -1 for none.
        grid: (h, w) of the merged grid; H and W must be multiples.
        types: number of types C.

    Raises:
        ValueError: when the image is not a multiple of the grid or a type is out of range.
    """
    images, height, width = segmentation.shape
    h, w = grid
    if height % h or width % w:
        raise ValueError(f"image {height} x {width} is not a multiple of the grid {h} x {w}")
    if int(segmentation.max()) >= types or int(segmentation.min()) < -1:
        raise ValueError(f"type index {int(segmentation.max())} outside [-1, {types})")
    cells = (segmentation.long() + 1).unflatten(1, (h, height // h)).unflatten(3, (w, width // w)).transpose(2, 3)
    labels = cells.flatten(3, 4).flatten(1, 2)  # (I, N, pixels per cell)
    counts = torch.zeros(images, h * w, types + 1, device=labels.device)
    counts.scatter_add_(2, labels, torch.ones_like(labels, dtype=counts.dtype))
    return counts[..., 1:] / labels.shape[2]


class DenseHead(nn.Module):
    """Scores object names from visual tokens.

    Args:
        names: tokens of the C types' names, in the order of the segmentation's indices.
        min_share: smallest share of a cell's pixels that counts as showing a type.
    """

    name_ids: Tensor
    name_mask: Tensor

    def __init__(self, names: Sequence[Sequence[int]], min_share: float = 0.03) -> None:
        super().__init__()
        if not names:
            raise ValueError("names is empty")
        rows = [list(name) for name in names]
        longest = max(len(row) for row in rows)
        self.register_buffer("name_ids", torch.tensor([row + [0] * (longest - len(row)) for row in rows]), persistent=False)
        mask = torch.tensor([[1.0] * len(row) + [0.0] * (longest - len(row)) for row in rows])
        self.register_buffer("name_mask", mask, persistent=False)
        self.min_share = min_share
        self.scale = nn.Parameter(torch.tensor(10.0).log())
        self.bias = nn.Parameter(torch.tensor(-4.0))

    def names(self, table: Tensor) -> Tensor:
        """Embeddings (C, D) of the names: the mean over each name's tokens in the language model's table (V, D)."""
        vectors = table[self.name_ids] * self.name_mask[..., None]
        return vectors.sum(1) / self.name_mask.sum(1, keepdim=True)

    def scores(self, visual: Tensor, table: Tensor) -> Tensor:
        """Logits (I, N, C) that a cell shows each type."""
        cosine = functional.normalize(visual.float(), dim=-1) @ functional.normalize(self.names(table).float(), dim=-1).T
        return cosine * self.scale.exp() + self.bias

    def forward(self, visual: Tensor, table: Tensor, shares: Tensor) -> tuple[Tensor, float]:
        """Loss of visual tokens (I, N, D), and the recall of shown types.

        Args:
            visual: `ProprioMLLM.visual_tokens` or `ModelOutput.visual`.
            table: the language model's input embeddings, `model.table`.
            shares: from `shown_shares`.
        """
        logits = self.scores(visual, table)
        shown = (shares >= self.min_share).to(logits.dtype)
        loss = functional.binary_cross_entropy_with_logits(logits, shown, reduction="none").sum(-1).mean()
        return loss, float(((logits > 0) & (shown > 0)).sum() / (shown > 0).sum().clamp_min(1))
