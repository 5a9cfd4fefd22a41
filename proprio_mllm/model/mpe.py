"""Motion-based position embedding (paper: MPE).

For a visual token at (x, y) in an image in which the robot stands at (x_r, y_r), the paper replaces M-RoPE's (t, h, w) by

    [t, sign(y - y_r), sign(x - x_r)].

The paper leaves open the offset between text and image, what is compared, and whether "added to visual tokens" means a learned
embedding. Fixed here: a token's place is its centre on the merged grid; within a quarter of a cell of the robot's place it is
level with it (sign 0), beyond that offsets dy and dx count cells, rounded away from zero. The band keeps the signs steady when
the robot's place falls on the border between two cells, as it does for a robot that looks straight ahead. Ids are offset as
M-RoPE's are. With s the first free position:

| mode              | ids of the visual token in row i, column j      | next text position |
|-------------------|-------------------------------------------------|--------------------|
| `mrope`           | s + [0, i, j]                                   | s + max(h, w)      |
| `rope_sign`       | s + [0, 1 + sign(dy), 1 + sign(dx)]             | s + 3              |
| `rope_sign_raw`   | [s, sign(dy), sign(dx)]                         | s + 1              |
| `rope_radial`     | s + [0, dy, dx]                                 | s + max(h, w)      |
| `embed_sign`      | as `mrope`, and an embedding of the two signs   | s + max(h, w)      |
| `rope_sign+embed` | as `rope_sign`, and the embedding               | s + 3              |

`rope_sign` is the default: the equation is a triple of ids that contains t. Its offset keeps the distance between text and
image from growing with the prompt, which raw ids do not; differences among visual tokens are the same. The nine cells lose the
order of tokens inside a quadrant; the vision tower's own two-dimensional embedding keeps it. An image without a known robot
position (a photograph from elsewhere) keeps M-RoPE's ids. The embedding starts at zero.

Shape letters: S sequence, h and w rows and columns of the merged grid, N = h * w, D hidden size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from configs.schema.model import MpeMode

MPE_MODES: tuple[MpeMode, ...] = ("mrope", "rope_sign", "rope_sign_raw", "rope_radial", "embed_sign", "rope_sign+embed")
Centroid = tuple[float, float]
#: Share of a cell within which a token is level with the robot.
LEVEL = 0.25


def relative_cells(h: int, w: int, centroid: Centroid) -> Tensor:
    """Rows and columns of the tokens relative to the robot (dy, dx), (2, N) long, raster order.

    Args:
        h: rows of the merged grid.
        w: columns.
        centroid: the robot's (x / W, y / H); may lie outside [0, 1]. Held within one image size around the image, so that a
            point far outside does not give ids without bound.
    """
    x, y = centroid
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError(f"centroid must be finite, got {centroid}")
    rows = _offsets(h, y).repeat_interleave(w)  # (N,)
    cols = _offsets(w, x).repeat(h)  # (N,)
    return torch.stack([rows, cols])


def _offsets(cells: int, place: float) -> Tensor:
    """Signed offsets of a line of cells from a place given as a fraction of the line."""
    delta = torch.arange(cells, dtype=torch.float64) + 0.5 - min(max(place, -1.0), 2.0) * cells
    return (delta.sign() * (delta.abs() - LEVEL).ceil().clamp_min(0)).long()


def visual_positions(mode: MpeMode, start: int, h: int, w: int, centroid: Centroid | None) -> tuple[Tensor, int]:
    """Ids (3, N) of an image's tokens and the next text position, see the table above.

    Raises:
        ValueError: on an unknown mode.
    """
    if mode not in MPE_MODES:
        raise ValueError(f"mpe.mode {mode!r} is not allowed; allowed: {', '.join(MPE_MODES)}")
    if mode in ("mrope", "embed_sign") or centroid is None:
        zeros = torch.zeros(h * w, dtype=torch.long)
        ids = torch.stack([zeros, torch.arange(h).repeat_interleave(w), torch.arange(w).repeat(h)])
        return start + ids, start + max(h, w)
    cells = relative_cells(h, w, centroid)
    times = torch.full((1, h * w), start)
    if mode == "rope_radial":
        return torch.cat([times, start + cells]), start + max(h, w)
    if mode == "rope_sign_raw":
        return torch.cat([times, cells.sign()]), start + 1
    return torch.cat([times, start + 1 + cells.sign()]), start + 3


def position_ids(
    input_ids: Sequence[int],
    image_token: int,
    grids: Sequence[tuple[int, int]],
    centroids: Sequence[Centroid | None],
    mode: MpeMode,
    start: int = 0,
) -> Tensor:
    """Ids (3, S) of one unpadded sequence.

    Args:
        input_ids: S token ids with each image's pad repeated h * w times.
        image_token: id of the pad.
        grids: (h, w) of each image, in order.
        centroids: the robot's place in each image, or None.
        mode: one of `MPE_MODES`.
        start: position of the first token.

    Raises:
        ValueError: when pads and grids do not match.
    """
    parts: list[Tensor] = []
    index, image, size = 0, 0, len(input_ids)
    while index < size:
        end = index
        if input_ids[index] == image_token:
            if image >= len(grids):
                raise ValueError(f"more image tokens than the {len(grids)} images account for")
            h, w = grids[image]
            end = index + h * w
            if end > size or any(token != image_token for token in input_ids[index:end]):
                raise ValueError(f"image {image}: expected {h * w} image tokens at position {index}")
            ids, start = visual_positions(mode, start, h, w, centroids[image])
            image += 1
        else:
            while end < size and input_ids[end] != image_token:
                end += 1
            ids = (torch.arange(end - index) + start).expand(3, -1)
            start += end - index
        parts.append(ids)
        index = end
    if image != len(grids):
        raise ValueError(f"{len(grids)} images but image tokens of {image}")
    return torch.cat(parts, dim=1) if parts else torch.zeros(3, 0, dtype=torch.long)


class SignEmbedding(nn.Module):
    """The additive reading: one learned vector for each of the nine sign pairs, zero at the start."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.zeros(9, hidden))

    def forward(self, h: int, w: int, centroid: Centroid | None) -> Tensor:
        """The vectors (N, D) of an image's tokens; zeros without a known robot position."""
        if centroid is None:
            return self.table.new_zeros(h * w, self.table.shape[1])
        signs = relative_cells(h, w, centroid).sign() + 1  # (2, N)
        return self.table[(signs[0] * 3 + signs[1]).to(self.table.device)]
