"""Point-map encoders: from an RGB image to 3-D features (paper: CSE, "point-map based features" F3D).

`SimPointMap` is a small network trained on the simulator's depth; it does not claim to equal CUT3R, whose adapter is in
`proprio_mllm.model.cut3r`. `NamedPointMap` (`proprio_mllm.model.named_map`) also knows what is where. `OraclePointMap` hands
through true points, an upper bound. All are called with the image, true points or None, and how the camera stands or None.

All points are in the camera frame (x right, y down, z forward), metres. Shape letters: I images, H and W image rows and
columns, h and w rows and columns of the tokens, C token channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

#: Reward of confidence in `confident_loss`.
CONFIDENCE: Final = 0.2
#: Largest distance that is learnt, metres.
FAR_M: Final = 20.0


@dataclass(frozen=True, slots=True)
class Named:
    """What is where.

    Attributes:
        keys: (I, h, w, D) unit vectors, like the rows of the names of what each cell shows.
        centres_m: (I, h, w, 3) camera frame, of the thing that each cell shows.
        conf: (I, h, w), at least 1.
    """

    keys: Tensor
    centres_m: Tensor
    conf: Tensor


@dataclass(frozen=True, slots=True)
class GeoFeatures:
    """What a point-map encoder gives.

    Attributes:
        tokens: (I, C, h, w), or None for encoders without tokens.
        points_m: (I, H, W, 3) camera frame; rows and columns may be coarser than the image's.
        conf: (I, H, W), at least 1; 0 marks pixels without a point.
        named: what is where, or None for encoders that do not know.
    """

    tokens: Tensor | None
    points_m: Tensor
    conf: Tensor
    named: Named | None = None


def pixels(rgb: Tensor) -> Tensor:
    if rgb.ndim != 4 or rgb.shape[1] != 3:
        raise ValueError(f"rgb: expected (images, 3, rows, columns), got {tuple(rgb.shape)}")
    return rgb.float() / 127.5 - 1.0


def points_and_confidence(raw: Tensor) -> tuple[Tensor, Tensor]:
    """Points (..., 3), metres, and their confidence (...), from what a head gives (..., 4).

    Direction times exp(norm) - 1, as CUT3R's head: the error grows with distance, as depth errors do.
    """
    norm = (raw[..., :3].square().sum(-1, keepdim=True) + 1e-12).sqrt()
    return raw[..., :3] / norm * torch.expm1(norm.clamp(max=5.0)), 1.0 + raw[..., 3].clamp(max=8.0).exp()


def _convolution(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1), nn.GroupNorm(8, outputs), nn.GELU())


class SimPointMap(nn.Module):
    """Small convolutional and attention encoder with a point and confidence head.

    Tokens are at an eighth of the image's resolution, points at a quarter.

    Args:
        width: token channels, a multiple of 32.
        depth: transformer blocks over the tokens.
    """

    def __init__(self, width: int = 96, depth: int = 2) -> None:
        super().__init__()
        if width % 32:
            raise ValueError(f"point_map.width {width} must be a multiple of 32")
        self.token_dim = width
        self.stem = _convolution(5, 32, 2)
        self.quarter = _convolution(32, 48, 2)
        self.eighth = _convolution(48, width, 2)
        self.blocks = nn.ModuleList(
            nn.TransformerEncoderLayer(width, width // 32, 2 * width, 0.0, "gelu", batch_first=True, norm_first=True)
            for _ in range(depth)
        )
        self.fuse = nn.Sequential(nn.Conv2d(width + 48, 48, 1), nn.GELU(), _convolution(48, 48, 1))
        self.head = nn.Conv2d(48, 4, 1)
        with torch.no_grad():
            nn.init.zeros_(self.head.weight)
            bias: Any = self.head.bias
            bias[2] = 1.0  # start 1.7 m ahead

    def forward(self, rgb: Tensor, points_m: Tensor | None = None, stance: Tensor | None = None) -> GeoFeatures:
        """Tokens, points and confidence of images (I, 3, H, W)."""
        del points_m, stance
        x = pixels(rgb)
        rows = torch.linspace(-1, 1, x.shape[2], device=x.device).view(1, 1, -1, 1).expand(len(x), 1, -1, x.shape[3])
        cols = torch.linspace(-1, 1, x.shape[3], device=x.device).view(1, 1, 1, -1).expand(len(x), 1, x.shape[2], -1)
        quarter = self.quarter(self.stem(torch.cat([x, rows, cols], dim=1)))  # (I, 48, H/4, W/4)
        grid = self.eighth(quarter)  # (I, C, H/8, W/8)
        tokens = grid.flatten(2).transpose(1, 2)  # (I, h w, C)
        for block in self.blocks:
            tokens = block(tokens)
        grid = tokens.transpose(1, 2).reshape(grid.shape)
        up = functional.interpolate(grid, size=quarter.shape[2:], mode="bilinear")
        raw = self.head(self.fuse(torch.cat([up, quarter], dim=1))).permute(0, 2, 3, 1)  # (I, H/4, W/4, 4)
        return GeoFeatures(grid, *points_and_confidence(raw))


class OraclePointMap(nn.Module):
    """Hands through the true points; pixels that are not finite get confidence 0."""

    token_dim = 0

    def forward(self, rgb: Tensor, points_m: Tensor | None = None, stance: Tensor | None = None) -> GeoFeatures:
        """Confidence 1 wherever the true point is finite.

        Raises:
            ValueError: without true points.
        """
        del stance
        if points_m is None:
            raise ValueError("point_map.encoder 'oracle' needs true points, but the batch has none")
        valid = torch.isfinite(points_m).all(dim=-1)
        return GeoFeatures(None, torch.where(valid[..., None], points_m, 0.0), valid.to(points_m.dtype))


def read_at_centres(values: Tensor, shape: Sequence[int]) -> Tensor:
    """Of (I, H, W, ...) those at the centres of the pixels of a coarser picture (I, h, w, ...)."""
    rows, cols = (((torch.arange(shape[axis]) + 0.5) * (values.shape[axis] / shape[axis])).long() for axis in (1, 2))
    return values[:, rows][:, :, cols]


def confident_loss(points_m: Tensor, conf: Tensor, truth_m: Tensor, weights: Tensor | None = None) -> Tensor:
    """CUT3R's confidence-weighted loss, mean of conf * |p - p_true| - `CONFIDENCE` * log(conf), in metres.

    Args:
        points_m: (..., 3) prediction.
        conf: (...) its confidence.
        truth_m: (..., 3); points that are not finite or farther than `FAR_M` are left out.
        weights: (...) of the mean, by default all alike.
    """
    valid = torch.isfinite(truth_m).all(dim=-1)
    truth = torch.where(valid[..., None], truth_m, 0.0).to(points_m)
    kept = (valid & (truth.square().sum(-1) < FAR_M**2)).to(conf)
    kept = kept if weights is None else kept * weights
    error = ((points_m - truth).square().sum(-1) + 1e-12).sqrt()
    return ((conf * error - CONFIDENCE * conf.log()) * kept).sum() / kept.sum().clamp_min(1)


def point_map_loss(geo: GeoFeatures, points_m: Tensor) -> Tensor:
    """`confident_loss` of predicted points against true ones (I, H, W, 3), read at the centres of the prediction's pixels."""
    return confident_loss(geo.points_m, geo.conf, read_at_centres(points_m, geo.points_m.shape).to(geo.points_m))
