"""Features of pictures, by which RAP finds moments that looked alike.

The vision tower of the released base model (`weights/tiny/base`), mean over the visual tokens, stands in for the CLIP features
of the paper's RAP, which have to be downloaded; a folder with a checkpoint of one's own whose model has `get_image_features`,
as CLIP and SigLIP have, takes its place. On 600 views of the demonstrations the view that this tower finds most alike, out of
another episode, shares 62 % of the types in view (intersection over union), a random one 8.5 % (`benchmarks/retrieval.py`).

Paper: baseline RAP. Shape letters: N pictures, D features, H and W rows and columns.
"""

from __future__ import annotations

import functools
import hashlib
import json
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

import configs
from data.files import file_hash
from proprio_mllm.planners.bars import without_bar

_ROOT: Final = Path(configs.__file__).resolve().parent.parent


class SightError(ValueError):
    """An image encoder that is not there or is no image encoder; the message names its folder."""


class ImageEncoder(Protocol):
    """Turns pictures into vectors whose inner product is their likeness."""

    def encode(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Unit vectors (N, D) of pictures (H, W, 3), at least one; they may differ in size."""
        ...


def weights_digest(folder: str) -> str:
    """Short hash of an encoder's weights.

    Raises:
        SightError: when the folder has none.
    """
    files = sorted(_found(folder).rglob("*.safetensors"))
    if not files:
        raise SightError(f"no image encoder at {folder}: it has no .safetensors file")
    return hashlib.sha256("".join(file_hash(file) for file in files).encode()).hexdigest()[:16]


@functools.cache
def image_encoder(folder: str) -> ImageEncoder:
    """The encoder of a folder, once per process: on the CPU, may be shared by threads.

    Args:
        folder: as given, or relative to the project: a model of this project, or a checkpoint that transformers can load.

    Raises:
        SightError: when there is none.
    """
    path = _found(folder)
    if not (path / "config.json").is_file():
        raise SightError(f"no image encoder at {folder}: it has no config.json")
    ours = "format" in json.loads((path / "config.json").read_text(encoding="utf-8"))
    return _Encoder(_tower(path) if ours else _checkpoint(path))


def _found(folder: str) -> Path:
    here = Path(folder)
    return here if here.exists() or here.is_absolute() else _ROOT / here


class _Encoder:
    """Brings what a function makes of one picture, a tensor (D,), to unit length."""

    def __init__(self, features: Callable[[NDArray[np.uint8]], Any]) -> None:
        self._features = features
        self._lock = threading.Lock()

    def encode(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """See `ImageEncoder`; one by one, so that a picture's features do not depend on its company."""
        import torch

        with self._lock, torch.inference_mode():
            vectors = np.stack([self._features(image).float().cpu().numpy() for image in images])  # (N, D)
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        return (vectors / np.maximum(lengths, 1e-12)).astype(np.float32)


def _tower(path: Path) -> Callable[[NDArray[np.uint8]], Any]:
    """The vision tower of a model of this project."""
    from proprio_mllm.model.batch import Collator, View
    from proprio_mllm.model.building import load_model

    model = load_model(path)
    collator = Collator(model.processor, model.cfg)
    return lambda image: model.visual_tokens(collator.images([View(image)]))[0].mean(0)


def _checkpoint(path: Path) -> Callable[[NDArray[np.uint8]], Any]:
    """A checkpoint of transformers with image features."""
    from transformers import AutoImageProcessor, AutoModel

    processor: Any = AutoImageProcessor.from_pretrained(str(path), local_files_only=True)
    with without_bar():
        model: Any = AutoModel.from_pretrained(str(path), local_files_only=True).eval()
    if not hasattr(model, "get_image_features"):
        raise SightError(f"{path}: {type(model).__name__} has no get_image_features; allowed: CLIP, SigLIP and their like")
    return lambda image: model.get_image_features(**processor(images=[image], return_tensors="pt")).pooler_output[0]
