"""What the frozen point map makes of an image, computed once: training reads an image many times, and CUT3R is a large network.

Kept is F3D on the merged grid, what CSE reads: half a megabyte for an image of 504 pixels, where points and tokens take four.
Files are in the user's cache folder (`XDG_CACHE_HOME`), named after encoder, image and camera, so several processes share
them, another encoder finds none of its predecessor's, and any of them may be deleted. Values have half precision whether they
were read or just computed, so that a result does not depend on what was there.

The vision tower, frozen too, is not kept: its features would take seven times the room.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import torch
from torch import Tensor, nn

from data.files import read_cached, write_cached
from proprio_mllm.model.batch import ImageBatch
from proprio_mllm.model.cse import CrossSpatialEncoder


class SpatialCache:
    """F3D by image.

    Args:
        encoder: the frozen point map.
        cse: says what of it is read, and in which frame.
    """

    def __init__(self, encoder: nn.Module, cse: CrossSpatialEncoder) -> None:
        digest = hashlib.sha256(f"{cse.cfg.source} {cse.cfg.frame}".encode())
        for name, tensor in sorted(encoder.state_dict().items()):
            digest.update(name.encode())
            digest.update(_content(tensor))
        self._of = digest.hexdigest()[:16]

    def spatial(self, cse: CrossSpatialEncoder, encoder: nn.Module, images: ImageBatch) -> Tensor:
        """(I, N, inputs of Phi); what was not there is computed together and kept."""
        names = list(self._names(images))
        found = [read_cached(name) for name in names]
        missing = [index for index, known in enumerate(found) if known is None]
        fresh: dict[int, Tensor] = {}
        if missing:
            pick = torch.tensor(missing, device=images.rgb.device)
            points, pose = (None if one is None else one[pick] for one in (images.points_m, images.camera_in_pelvis))
            made = cse.spatial(encoder(images.rgb[pick], points), *images.grid, pose).half()
            fresh = dict(zip(missing, made, strict=True))
            for index, one in fresh.items():
                write_cached(names[index], {"spatial": one.cpu().numpy()})
        rows = [
            fresh[index] if known is None else torch.from_numpy(known["spatial"]).to(images.rgb.device)
            for index, known in enumerate(found)
        ]
        return torch.stack(rows)

    def _names(self, images: ImageBatch) -> Iterator[str]:
        for index, image in enumerate(images.rgb):
            digest = hashlib.sha256(str((tuple(image.shape), images.grid)).encode())
            digest.update(_content(image))
            for more in (images.camera_in_pelvis, images.points_m):
                if more is not None:
                    digest.update(_content(more[index]))
            name = digest.hexdigest()
            yield f"spatial/{self._of}/{name[:2]}/{name}"


def _content(tensor: Tensor) -> bytes:
    return (
        tensor.detach().cpu().contiguous().view(torch.uint8).numpy().tobytes() if tensor.ndim else str(tensor.item()).encode()
    )
