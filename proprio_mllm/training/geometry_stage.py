"""`stage=pointmap`: trains an embedded point-map encoder (F3D of the CSE) on the simulator's depth, and on what is where.

It takes CUT3R's place at the tiny size and is never called CUT3R; its error in metres on held-out views is part of the output.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from proprio_mllm.model.batch import Movable
from proprio_mllm.model.geometry import stance, to_camera
from proprio_mllm.model.named_map import NamedPointMap, NamedTruth, centres_of, named_map_loss, named_truth
from proprio_mllm.model.point_map import FAR_M, GeoFeatures, point_map_loss, read_at_centres
from proprio_mllm.training.loop import Objective
from proprio_mllm.training.sources import ViewRow, Views


class PointMapObjective(Objective):
    """Confidence-weighted point regression on views."""

    name = "pointmap"

    def __init__(self, encoder: nn.Module, views: Views, key: str) -> None:
        self.module = encoder
        self.key = key
        self._views = views

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> tuple[Tensor, Tensor]:
        """Images (I, 3, H, W) and true points (I, H, W, 3)."""
        rows = self._views.draw(rng, size)
        return _pictures(rows), _points(rows)

    def loss(
        self, module: nn.Module, batch: tuple[Tensor, Tensor], generator: torch.Generator
    ) -> tuple[Tensor, Mapping[str, float]]:
        """CUT3R's loss; nothing is drawn."""
        del generator
        rgb, points = batch
        return point_map_loss(module(rgb), points), {}


class NamedMapObjective(Objective):
    """Points, names and centres of things on views.

    Args:
        encoder: is trained.
        views: posed views.
        names: (C + M, D) unit rows of the names of the views' types, and of words that name nothing.
        key: of the checkpoint.
    """

    name = "pointmap"

    def __init__(self, encoder: NamedPointMap, views: Views, names: Tensor, key: str) -> None:
        self.module = self._encoder = encoder
        self.key = key
        self._views, self._names = views, names

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> NamedBatch:
        """Views with what is where."""
        return named_batch(self._views, self._views.draw(rng, size))

    def loss(self, module: nn.Module, batch: NamedBatch, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        """`named_map_loss`; nothing is drawn."""
        del generator
        geo, names = module(batch.rgb, None, batch.stance), self._names.to(batch.rgb.device)
        loss, right = named_map_loss(self._encoder, geo, batch.truth, names)
        return loss, {"names": right}


@dataclass(frozen=True, slots=True)
class NamedBatch(Movable):
    """Views: images (I, 3, H, W), how their cameras stand (I, 3, 4), and what is where."""

    rgb: Tensor
    stance: Tensor
    truth: NamedTruth


def named_batch(views: Views, rows: Sequence[ViewRow]) -> NamedBatch:
    """Views as `NamedPointMap` learns from them."""
    fields, stances = [], []
    for row in rows:
        camera, bodies = row.view.camera, row.view.key_bodies
        assert camera is not None and bodies is not None
        things = sorted(row.objects, key=lambda one: -int(one["pixels"]))  # a small one stands before a large one
        centres = [
            (
                views.type_names.index(str(one["id"]).rpartition("_")[0]),
                tuple(int(edge) for edge in one["bbox"]),
                to_camera(camera, np.asarray(one["center_in_pelvis"])),
            )
            for one in things
        ]
        fields.append(named_truth(row.points_m, row.segmentation, centres))
        stances.append(stance(camera, bodies))
    truth = NamedTruth(*(torch.from_numpy(np.stack(one)) for one in zip(*fields, strict=True)))
    return NamedBatch(_pictures(rows), torch.from_numpy(np.stack(stances)).float(), truth)


def _pictures(rows: Sequence[ViewRow]) -> Tensor:
    return torch.from_numpy(np.stack([row.view.image for row in rows])).permute(0, 3, 1, 2).contiguous()


def _points(rows: Sequence[ViewRow]) -> Tensor:
    return torch.from_numpy(np.stack([row.points_m for row in rows]))


@torch.no_grad()
def point_map_error(
    encoder: nn.Module, views: Views, names: Tensor | None = None, limit: int = 200, near_m: float = 2.0
) -> dict[str, float]:
    """Median and mean distance (m) of predicted to true points on held-out views, and the median relative to the distance.

    Of an encoder that knows what is where also, for things within `near_m` whose name is in the picture once: how often the
    cell that is most like the name shows it, and the median distance (m) of the centre that is looked up to the true one.
    Without held-out views only their number, 0, is returned.
    """
    errors, shares, found = list[Tensor](), list[Tensor](), list[tuple[bool, float]]()
    device = next(encoder.parameters()).device
    chosen = views.split.test[:limit]
    for start in range(0, len(chosen), 32):
        rows = [views.row(int(i)) for i in chosen[start : start + 32]]
        if isinstance(encoder, NamedPointMap):
            assert names is not None
            batch = named_batch(views, rows)
            geo = encoder(batch.rgb.to(device), None, batch.stance.to(device))
            found += _looked_up(encoder, geo, batch.truth, names, near_m)
        else:
            geo = encoder(_pictures(rows).to(device))
        predicted = geo.points_m.cpu()  # (I, h, w, 3)
        truth = read_at_centres(_points(rows), predicted.shape)
        valid = torch.isfinite(truth).all(-1) & (truth.norm(dim=-1) < FAR_M)
        distance = (predicted - truth).norm(dim=-1)[valid]
        errors.append(distance)
        shares.append(distance / truth.norm(dim=-1)[valid].clamp_min(1e-3))
    if not errors:
        return {"views": 0.0}
    error, share = torch.cat(errors), torch.cat(shares)
    result = {
        "point_median_m": float(error.median()),
        "point_mean_m": float(error.mean()),
        "point_median_relative": float(share.median()),
        "views": float(len(chosen)),
    }
    if found:
        hits, distances = zip(*found, strict=True)
        result |= {
            "names_accuracy": float(np.mean(hits)),
            "centre_median_m": float(np.median(distances)),
            "names": float(len(hits)),
        }
    return result


def _looked_up(
    encoder: NamedPointMap, geo: GeoFeatures, truth: NamedTruth, names: Tensor, near_m: float
) -> Iterator[tuple[bool, float]]:
    """Whether the likest cell shows what a name names, and how far the centre looked up is from the true one, metres."""
    named = geo.named
    assert named is not None
    device = named.keys.device
    for kind in truth.types.unique().tolist():
        centres, cosine = centres_of(named, names[kind].to(device).expand(len(truth.types), -1), encoder.scale.exp())
        for types, true, place, likeness in zip(truth.types, truth.centres_m, centres.cpu(), cosine.cpu(), strict=True):
            shows = types == kind
            if kind < 0 or not bool(shows.any()):
                continue
            centre = true[shows][0]
            if bool((true[shows] == centre).all()) and float(centre.norm()) < near_m:  # one of a name, and not far away
                yield bool(shows.flatten()[int(likeness.argmax())]), float((place - centre).norm())
