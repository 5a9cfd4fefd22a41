"""A point-map encoder that also knows what is where: `point_map.encoder=named`.

A planner needs where a thing is, by its name, and a point map of surfaces does not tell: the cells of a mug are mostly table.
So each cell of this encoder holds, beside the surface's point and a token, a key that is compared with rows of the language
model's table of words, and a vote for the centre of the thing that it shows, as VoteNet's points vote for the centres of boxes
(Qi et al., 2019). `cse.NamedPoints` looks centres up by name. Keys are trained like those of language-driven segmentation
(LSeg; Li et al., 2022) by the softmax over all names, which tells things apart, and each name by itself as well, as in
`proprio_mllm.model.dense`: a cosine has to tell whether a thing is in view at all.

Distance in a single picture follows from where things stand on the floor, so the encoder is told how its camera stands: where
each pixel's ray goes, and how far the floor is below, both from the robot's own joints.

It is small, trained on the simulator's truth, and takes CUT3R's place at the tiny size; it is not CUT3R.

Shape letters: I images, H and W image rows and columns, h and w an eighth of them, D hidden size, C types.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from proprio_mllm.model.batch import Movable
from proprio_mllm.model.cse import SHARP
from proprio_mllm.model.point_map import GeoFeatures, Named, confident_loss, pixels, points_and_confidence
from proprio_mllm.model.word_tokens import Tokens
from proprio_mllm.model.wording import Words

#: Rows and columns of pixels of a cell.
STRIDE: Final = 8
#: A cell's weight falls with this power of its thing's size in the picture; sizes of fewer pixels count as so many.
_SIZES, _SMALL = 0.75, 32
#: Heights of a camera above the floor are told from this, metres, and by this factor.
_STANDING_M, _HEIGHTS = 1.0, 2.0
_STEM, _QUARTER, _EIGHTH = 24, 48, 128


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.GroupNorm(8, outputs), nn.ReLU(inplace=True))


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _convolution(width, width)
        self.second = nn.Sequential(nn.Conv2d(width, width, 3, 1, 1, bias=False), nn.GroupNorm(8, width))

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.second(self.first(x)))


class _Block(nn.Module):
    """Attention written out: with 196 tokens it is three times as fast on a CPU as the fused one, backward included."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.heads = width // 32
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.read, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width))

    def forward(self, x: Tensor) -> Tensor:
        query, key, value = self.read(self.norms[0](x)).unflatten(-1, (3, self.heads, 32)).permute(2, 0, 3, 1, 4)
        shares = ((query @ key.mT) * 32**-0.5).softmax(-1).to(value)
        x = x + self.out((shares @ value).transpose(1, 2).flatten(2))
        return x + self.mlp(self.norms[1](x))


class NamedPointMap(nn.Module):
    """Convolutions to an eighth of the image, attention at a sixteenth, and heads for points, centres and keys.

    Args:
        width: channels at a sixteenth, a multiple of 32.
        depth: blocks of attention.
        hidden: D, channels of keys.
        image_size: side of the images, pixels, a multiple of 16.
    """

    token_dim = _EIGHTH

    def __init__(self, width: int, depth: int, hidden: int, image_size: int) -> None:
        super().__init__()
        if width % 32:
            raise ValueError(f"point_map.width {width} must be a multiple of 32")
        if image_size % 16:
            raise ValueError(f"image_size {image_size} must be a multiple of 16 for point_map.encoder 'named'")
        self.stem = _convolution(5, _STEM, 2)
        self.quarter = _convolution(_STEM, _QUARTER, 2)
        self.eighth = nn.Sequential(_convolution(_QUARTER + 4, _EIGHTH, 2), _Residual(_EIGHTH))
        self.sixteenth = _convolution(_EIGHTH, width, 2)
        self.places = nn.Parameter(torch.randn(1, (image_size // 16) ** 2, width) * 0.02)
        self.blocks = nn.ModuleList(_Block(width) for _ in range(depth))
        self.fuse = nn.Sequential(_convolution(width + _EIGHTH, _EIGHTH), _Residual(_EIGHTH))
        self.head = nn.Conv2d(_EIGHTH, 8, 1)
        self.key = nn.Conv2d(_EIGHTH, hidden, 1)
        #: Make scores of cosines in training.
        self.scale = nn.Parameter(torch.tensor(15.0).log())
        self.bias = nn.Parameter(torch.tensor(-5.0))
        with torch.no_grad():
            nn.init.zeros_(self.head.weight)
            bias: Any = self.head.bias
            bias[2] = bias[6] = 1.0  # start 1.7 m ahead
        module: Any = self  # the stubs do not know this overload
        module.to(memory_format=torch.channels_last)  # convolutions are four times as fast on a CPU

    def forward(self, rgb: Tensor, points_m: Tensor | None = None, stance: Tensor | None = None) -> GeoFeatures:
        """Tokens, points, centres and keys of images (I, 3, H, W).

        Args:
            rgb: uint8.
            points_m: not read.
            stance: (I, 3, 4) from `geometry.stance`.

        Raises:
            ValueError: without stances.
        """
        del points_m
        if stance is None:
            raise ValueError("point_map.encoder 'named' needs a camera pose and key bodies for every image")
        x = pixels(rgb)
        rows = torch.linspace(-1, 1, x.shape[2], device=x.device).view(1, 1, -1, 1).expand(len(x), 1, -1, x.shape[3])
        cols = torch.linspace(-1, 1, x.shape[3], device=x.device).view(1, 1, 1, -1).expand(len(x), 1, x.shape[2], -1)
        x = torch.cat([x, rows, cols], dim=1).contiguous(memory_format=torch.channels_last)
        quarter = self.quarter(self.stem(x))  # (I, _QUARTER, H/4, W/4)
        eighth = self.eighth(torch.cat([quarter, _rays(stance, quarter.shape[2:]).to(quarter)], dim=1))
        grid = self.sixteenth(eighth)
        tokens = (grid + self._at(grid.shape[2:])).flatten(2).transpose(1, 2)
        for block in self.blocks:
            tokens = block(tokens)
        up = functional.interpolate(tokens.transpose(1, 2).reshape(grid.shape), size=eighth.shape[2:], mode="nearest")
        fused = self.fuse(torch.cat([up.to(eighth), eighth], dim=1))  # (I, _EIGHTH, h, w)
        raw = self.head(fused).permute(0, 2, 3, 1).float()
        points, conf = points_and_confidence(raw[..., :4])
        centres, trust = points_and_confidence(raw[..., 4:])
        keys = functional.normalize(self.key(fused).permute(0, 2, 3, 1).float(), dim=-1)
        return GeoFeatures(fused, points, conf, Named(keys, centres, trust))

    def _at(self, size: Sequence[int]) -> Tensor:
        """What is learnt of places, for grids of another size between them, (1, width, rows, columns)."""
        side = math.isqrt(self.places.shape[1])
        grid = self.places.transpose(1, 2).unflatten(2, (side, side))
        return grid if tuple(size) == (side, side) else functional.interpolate(grid, size=tuple(size), mode="bilinear")


def _rays(stance: Tensor, size: Sequence[int]) -> Tensor:
    """Unit rays in the pelvis heading frame and the camera's height, (I, 4, rows, columns), for cells of 4 pixels."""
    rows, columns = (4.0 * torch.arange(count, device=stance.device) + 2.0 for count in size)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    rays = torch.einsum("iab,bhw->iahw", stance[:, :, :3], torch.stack([x, y, torch.ones_like(x)]))
    rays = functional.normalize(rays, dim=1)
    heights = _HEIGHTS * (stance[:, 2, 3] - _STANDING_M)
    return torch.cat([rays, heights[:, None, None, None].expand(-1, 1, *rays.shape[2:])], dim=1)


def name_rows(tokens: Tokens, table: Tensor, names: Sequence[Words]) -> Tensor:
    """Unit rows (C, D) of names in the language model's table (V, D), means over their words: what keys are like."""
    rows = torch.stack([table[tokens.tokens(name)].float().mean(0) for name in names])
    return functional.normalize(rows, dim=-1)


def centres_of(named: Named, names: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (I, 3) in the camera frame that a name looks up in each picture, and its cosine (I, h * w) with every cell.

    Args:
        named: of I pictures.
        names: (I, D) unit rows.
        scale: factor of cosines.
    """
    cosine = torch.einsum("ihwd,id->ihw", named.keys, names).flatten(1)
    shares = (SHARP * scale * cosine + named.conf.log().flatten(1)).softmax(1)
    return torch.einsum("in,inp->ip", shares, named.centres_m.flatten(1, 2)), cosine


@dataclass(frozen=True, slots=True)
class NamedTruth(Movable):
    """What `NamedPointMap` learns, in (I, h, w) cells; each cell stands for the pixel of it that shows the smallest thing.

    Attributes:
        points_m: (I, h, w, 3) camera frame, of the surface.
        centres_m: (I, h, w, 3) camera frame, of the thing; NaN where none is shown.
        types: (I, h, w) integer type, -1 for none.
        weights: (I, h, w) less for a thing that is larger in the picture: of a small one there are few cells.
    """

    points_m: Tensor
    centres_m: Tensor
    types: Tensor
    weights: Tensor


def named_truth(
    points_m: NDArray[np.floating],
    segmentation: NDArray[np.integer],
    centres: Sequence[tuple[int, Sequence[int], NDArray[np.floating]]],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
    """The fields of `NamedTruth` for one picture.

    Args:
        points_m: (H, W, 3) camera frame.
        segmentation: (H, W) type of each pixel, -1 for none.
        centres: type, box (left, top, right, bottom) and centre (3,) in the camera frame of each thing; where two of a type
            overlap, the later one counts.
    """
    height, width = segmentation.shape
    owner = np.full((height, width), -1)
    for number, (kind, (left, top, right, bottom), _) in enumerate(centres):
        box = slice(max(top, 0), bottom + 1), slice(max(left, 0), right + 1)
        owner[box][segmentation[box] == kind] = number
    seen = np.bincount(segmentation.ravel() + 1, minlength=1).astype(np.float32)
    seen[0] = np.inf  # none is shown only by cells without any thing
    sizes = seen[segmentation + 1]
    cells = _cells(sizes)
    pick = cells.argmin(-1)

    def picked(values: NDArray[Any]) -> NDArray[Any]:
        rows = _cells(values)
        return np.take_along_axis(rows, pick.reshape(pick.shape + (1,) * (rows.ndim - 2)), axis=2)[:, :, 0]

    whose = picked(owner)
    table = np.array([[np.nan] * 3, *(centre for *_, centre in centres)], dtype=np.float32)
    return (
        picked(points_m).astype(np.float32),
        table[whose + 1],
        picked(segmentation).astype(np.int64),
        (STRIDE**2 / np.maximum(picked(sizes), _SMALL)).astype(np.float32) ** _SIZES,
    )


def _cells(values: NDArray[Any]) -> NDArray[Any]:
    """(H, W, ...) as (h, w, pixels of a cell, ...)."""
    h, w = values.shape[0] // STRIDE, values.shape[1] // STRIDE
    parts = values[: h * STRIDE, : w * STRIDE].reshape(h, STRIDE, w, STRIDE, *values.shape[2:])
    return parts.swapaxes(1, 2).reshape(h, w, STRIDE * STRIDE, *values.shape[2:])


#: Weight of the names in `named_map_loss`, and the least weight of a cell among them: with more, walls and tables outweigh what
#: is small and seldom seen, and an apple right before the camera is not told from the table.
_NAMES, _PLAIN = 1.0, 0.02


def named_map_loss(encoder: NamedPointMap, geo: GeoFeatures, truth: NamedTruth, names: Tensor) -> tuple[Tensor, float]:
    """Loss of points, of centres and of words, and the share of cells with a thing for which its name scores most.

    Args:
        encoder: whose factors of cosines are used.
        geo: what it gave.
        truth: what is there.
        names: (C + M, D) unit rows of the types' names, and of words that name nothing.
    """
    assert geo.named is not None
    shown = truth.types >= 0
    surface = confident_loss(geo.points_m, geo.conf, truth.points_m, 1.0 + shown.float())
    centre = confident_loss(geo.named.centres_m, geo.named.conf, truth.centres_m, truth.weights)
    scores = encoder.scale.exp() * (geo.named.keys @ names.T) + encoder.bias  # (I, h, w, C + M)
    told = functional.one_hot(truth.types + 1, len(names) + 1)[..., 1:].to(scores)
    each = functional.binary_cross_entropy_with_logits(scores, told, reduction="none").sum(-1)
    against = functional.pad(scores, (1, 0)).flatten(0, -2)  # all names at once, 0 for showing none of them
    each = each + functional.cross_entropy(against, (truth.types + 1).flatten(), reduction="none").view_as(each)
    weights = truth.weights.clamp_min(_PLAIN)
    right = ((scores.argmax(-1) == truth.types) & shown).sum() / shown.sum().clamp_min(1)
    return surface + centre + _NAMES * (each * weights).sum() / weights.sum(), float(right)
