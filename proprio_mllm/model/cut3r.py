"""Adapter to the user's own CUT3R (paper: CSE's point-map encoder).

CUT3R's code and weights are CC BY-NC-SA 4.0, so nothing of it is kept here: the adapter imports the user's checkout and reads
the user's weights. Two things its own loader does are not done: it never evaluates text from the checkpoint (sizes are stated
below), and it does not unpickle a file unasked. A `.safetensors` file is read as it is; a `.pth` file needs the expected
sha256, is read with PyTorch's restricted unpickler where that suffices, and otherwise only when `trust_checkpoint` is set.

CUT3R gives the pose token the position -1, which its PyTorch rotary embedding cannot look up; the adapter puts in
`FloatRope2d`, which computes the angles instead and is equal where both work.

Points come in CUT3R's own camera frame (x right, y down, z forward) and scale. Shape letters: I images, H and W rows and
columns of the resized image, h and w of its patches.
"""

from __future__ import annotations

import argparse
import importlib
import math
import pickle
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from configs.schema.model import PointMapConfig
from data.files import file_hash
from proprio_mllm.model.point_map import GeoFeatures

#: Sizes of the released 512-pixel DPT model, as in its training configuration.
CUT3R_512: Mapping[str, Any] = {
    "freeze": "none",
    "state_size": 768,
    "state_pe": "2d",
    "pos_embed": "RoPE100",
    "rgb_head": True,
    "pose_head": True,
    "patch_embed_cls": "PatchEmbedDust3R",
    "img_size": (512, 512),
    "head_type": "dpt",
    "output_mode": "pts3d+pose",
    "depth_mode": ("exp", -math.inf, math.inf),
    "conf_mode": ("exp", 1, math.inf),
    "pose_mode": ("exp", -math.inf, math.inf),
    "enc_embed_dim": 1024,
    "enc_depth": 24,
    "enc_num_heads": 16,
    "dec_embed_dim": 768,
    "dec_depth": 12,
    "dec_num_heads": 12,
    "landscape_only": False,
}
PATCH = 16


class FloatRope2d(nn.Module):
    """Rotary embedding over rows and columns for any position, negative ones included.

    Args:
        base: base of the wavelengths.
    """

    def __init__(self, base: float = 100.0) -> None:
        super().__init__()
        self.base = base

    def forward(self, tokens: Tensor, positions: Tensor) -> Tensor:
        """Rotated tokens.

        Args:
            tokens: (I, heads, N, D), D a multiple of 4; the first half follows rows, the second columns.
            positions: (I, N, 2) row and column.
        """
        half = tokens.shape[-1] // 2
        inverse = self.base ** (-torch.arange(0, half, 2, device=tokens.device, dtype=torch.float32) / half)
        parts = []
        for part, place in zip(tokens.chunk(2, dim=-1), positions.float().unbind(-1), strict=True):
            angle = place[:, None, :, None] * inverse  # (I, 1, N, half / 2)
            cos, sin = angle.cos().to(tokens), angle.sin().to(tokens)
            first, second = part.chunk(2, dim=-1)
            parts += [first * cos - second * sin, second * cos + first * sin]
        return torch.cat(parts, dim=-1)


def read_checkpoint(path: str | Path, sha256: str | None, trust: bool = False) -> dict[str, Tensor]:
    """Weights of a CUT3R checkpoint.

    Args:
        path: `.safetensors`, or a PyTorch file with the weights under `model`.
        sha256: the expected checksum; needed for PyTorch files.
        trust: allows unpickling arbitrary objects from a PyTorch file whose checksum matched.

    Raises:
        ValueError: on a missing or wrong checksum, an untrusted pickle, or a file without weights.
    """
    path = Path(path)
    if sha256 is not None and (found := file_hash(path)) != sha256.lower():
        raise ValueError(f"{path}: sha256 is {found}, expected {sha256}")
    if path.suffix == ".safetensors":
        return load_file(path)
    if sha256 is None:
        raise ValueError(f"{path}: point_map.sha256 is needed to read a PyTorch checkpoint")
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            stored = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        if not trust:
            raise ValueError(
                f"{path} holds objects beyond tensors; convert it to safetensors, or set point_map.trust_checkpoint=true "
                "if you trust its origin"
            ) from error
        # The user named this very file by its checksum and vouches for it.
        stored = torch.load(path, map_location="cpu", weights_only=False)
    weights = stored.get("model") if isinstance(stored, dict) else None
    if not isinstance(weights, dict) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise ValueError(f"{path}: expected a dictionary of tensors under 'model'")
    return {str(key).removeprefix("module."): value for key, value in weights.items()}


class Cut3rPointMap(nn.Module):
    """CUT3R on single images, frozen.

    Args:
        network: the checkout's `ARCroco3DStereo`.
        token_dim: width of its decoder.
        size: side to which images are resized, pixels, a multiple of 16.
    """

    def __init__(self, network: nn.Module, token_dim: int, size: int) -> None:
        super().__init__()
        if size % PATCH:
            raise ValueError(f"point_map.size {size} must be a multiple of {PATCH}")
        self.network = network.eval().requires_grad_(False)
        self.token_dim = token_dim
        self.size = size
        self._tokens: list[Tensor] = []
        for module in network.modules():
            if isinstance(getattr(module, "rope", None), nn.Module):
                module.rope = FloatRope2d(100.0)
        norm = network.get_submodule("dec_norm")
        norm.register_forward_hook(self._keep)

    def _keep(self, module: nn.Module, inputs: Any, output: Any) -> None:
        del module, inputs
        self._tokens.append(output)

    @staticmethod
    def from_config(cfg: PointMapConfig, sizes: Mapping[str, Any] = CUT3R_512) -> Cut3rPointMap:
        """CUT3R from the configured checkout and checkpoint.

        Args:
            cfg: paths, checksum and image size.
            sizes: arguments of the checkout's configuration class.

        Raises:
            ValueError: on missing paths, a checkout without the expected module, or weights that do not fit.
        """
        if cfg.checkout is None or cfg.checkpoint is None:
            raise ValueError("point_map.encoder 'cut3r' needs point_map.checkout and point_map.checkpoint")
        source = Path(cfg.checkout) / "src"
        if not (source / "dust3r" / "model.py").is_file():
            raise ValueError(f"point_map.checkout {cfg.checkout!r} is no CUT3R checkout: src/dust3r/model.py is missing")
        if str(source) not in sys.path:
            sys.path.insert(0, str(source))
        module = importlib.import_module("dust3r.model")
        network: nn.Module = module.ARCroco3DStereo(module.ARCroco3DStereoConfig(**sizes))
        weights = read_checkpoint(cfg.checkpoint, cfg.sha256, cfg.trust_checkpoint)
        missing = sorted(set(network.state_dict()) - set(weights))
        if missing:
            raise ValueError(f"{cfg.checkpoint}: {len(missing)} weights are missing, among them {missing[:3]}")
        # The class's own method would skip weights that do not fit without a word.
        nn.Module.load_state_dict(network, weights, strict=False)
        return Cut3rPointMap(network, int(sizes["dec_embed_dim"]), cfg.size)

    def train(self, mode: bool = True) -> Cut3rPointMap:
        """Stays in evaluation mode: the encoder is frozen."""
        del mode
        return super().train(False)

    @torch.no_grad()
    def forward(self, rgb: Tensor, points_m: Tensor | None = None, stance: Tensor | None = None) -> GeoFeatures:
        """Decoder tokens, points and confidence of images (I, 3, rows, columns) in [0, 255]."""
        del points_m, stance
        images = functional.interpolate(rgb.float(), size=(self.size, self.size), mode="bilinear", antialias=True)
        images = images / 127.5 - 1.0
        count, device = len(images), images.device
        view = {
            "img": images,
            # Read only where `ray_mask` is set.
            "ray_map": torch.full((count, self.size, self.size, 6), torch.nan, device=device),
            "true_shape": torch.full((count, 2), self.size, dtype=torch.int32, device=device),
            "img_mask": torch.ones(count, dtype=torch.bool, device=device),
            "ray_mask": torch.zeros(count, dtype=torch.bool, device=device),
            "update": torch.ones(count, dtype=torch.bool, device=device),
            "reset": torch.zeros(count, dtype=torch.bool, device=device),
        }
        self._tokens.clear()
        network: Any = self.network
        results = network.forward_recurrent([view], device)[0]
        side = self.size // PATCH
        tokens = self._tokens.pop()[:, 1:].transpose(1, 2).reshape(count, -1, side, side)  # the first is the pose token
        self._tokens.clear()
        return GeoFeatures(tokens, results[0]["pts3d_in_self_view"], results[0]["conf_self"])
