"""`stage=pointmap`: trains the embedded point-map encoder (F3D of the CSE) on the simulator's depth.

It takes CUT3R's place at the tiny size and is never called CUT3R; its error in metres on held-out views is part of the output.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from proprio_mllm.model.point_map import point_map_loss
from proprio_mllm.training.loop import Objective
from proprio_mllm.training.sources import Views


class PointMapObjective(Objective):
    """Confidence-weighted point regression on views."""

    name = "pointmap"

    def __init__(self, encoder: nn.Module, views: Views, key: str) -> None:
        self.module = encoder
        self.key = key
        self._views = views

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> tuple[Tensor, Tensor]:
        """Images (I, 3, H, W) and true points (I, H, W, 3)."""
        return _stack(self._views, rng.choice(self._views.split.train, size))

    def loss(
        self, module: nn.Module, batch: tuple[Tensor, Tensor], generator: torch.Generator
    ) -> tuple[Tensor, Mapping[str, float]]:
        """CUT3R's loss; nothing is drawn."""
        del generator
        rgb, points = batch
        return point_map_loss(module(rgb), points), {}


def _stack(views: Views, indices: Any) -> tuple[Tensor, Tensor]:
    rows = [views.row(int(i)) for i in indices]
    rgb = torch.from_numpy(np.stack([row.view.image for row in rows])).permute(0, 3, 1, 2).contiguous()
    return rgb, torch.from_numpy(np.stack([row.points_m for row in rows]))


@torch.no_grad()
def point_map_error(encoder: nn.Module, views: Views, limit: int = 200, far_m: float = 20.0) -> dict[str, float]:
    """Median and mean distance (m) of predicted to true points on held-out views, and the median relative to the distance.

    Without held-out views only their number, 0, is returned.
    """
    errors, shares = [], []
    for start in range(0, min(limit, len(views.split.test)), 32):
        rgb, points = _stack(views, views.split.test[start : min(start + 32, limit)])
        device = next(encoder.parameters()).device
        predicted = encoder(rgb.to(device)).points_m.cpu()  # (I, h, w, 3)
        rows = ((torch.arange(predicted.shape[1]) + 0.5) * points.shape[1] / predicted.shape[1]).long()
        cols = ((torch.arange(predicted.shape[2]) + 0.5) * points.shape[2] / predicted.shape[2]).long()
        truth = points[:, rows][:, :, cols]
        valid = torch.isfinite(truth).all(-1) & (truth.norm(dim=-1) < far_m)
        distance = (predicted - truth).norm(dim=-1)[valid]
        errors.append(distance)
        shares.append(distance / truth.norm(dim=-1)[valid].clamp_min(1e-3))
    if not errors:
        return {"views": 0.0}
    error, share = torch.cat(errors), torch.cat(shares)
    return {
        "point_median_m": float(error.median()),
        "point_mean_m": float(error.mean()),
        "point_median_relative": float(share.median()),
        "views": float(min(limit, len(views.split.test))),
    }
