"""Motion VQ-VAE: windows of motion features to discrete tokens and back (paper: stage 1, motion tokenizer).

A 1-D convolutional encoder halves the frame rate `down` times, a quantiser (`quantizer.py`) turns each step into tokens, a
mirrored decoder rebuilds the features. Loss, as in the paper: reconstruction + alpha * codebook + beta * commitment, and
optionally a smooth-L1 term on frame differences (MotionGPT's "velocity" term, here true finite differences in metres per
frame). D(z) means D(e) with the straight-through gradient. Features are normalised by the mean and deviation stored with the
weights.

Every window is padded with copies of its own first and last frame only, so a window encodes to the same tokens
online and from a shard.

Shape letters: B batch, T frames, F features, N = T / stride steps, C channels.
"""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from configs.schema.model import MotionTokenizerConfig
from configs.validate import build
from data.files import read_json, write_text
from proprio_mllm.model.quantizer import MotionQuantizer
from proprio_mllm.model.tensors import read_tensors, write_tensors

_FORMAT = 2


@dataclass(frozen=True, slots=True)
class TokenizerLoss:
    """Loss terms of one batch; `total` is what is minimised. `reconstruction` is the normalised smooth-L1 error."""

    total: Tensor
    reconstruction: Tensor
    velocity: Tensor
    codebook: Tensor
    commitment: Tensor
    perplexity: Tensor


class _Residual(nn.Module):
    """Dilated residual block, x + conv1(relu(conv3(relu(x))))."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.ReLU(),
            nn.Conv1d(width, width, 3, padding=dilation, dilation=dilation, padding_mode="replicate"),
            nn.ReLU(),
            nn.Conv1d(width, width, 1),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


def _stack(width: int, depth: int, growth: int, reverse: bool) -> list[nn.Module]:
    dilations = [growth**i for i in range(depth)]
    return [_Residual(width, d) for d in (reversed(dilations) if reverse else dilations)]


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Conv1d:
    padding = 1 if kernel > 1 else 0
    return nn.Conv1d(inputs, outputs, kernel, stride, padding, padding_mode="replicate")


class MotionTokenizer(nn.Module):
    """VQ-VAE over motion features.

    Args:
        cfg: sizes and loss weights.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, cfg: MotionTokenizerConfig) -> None:
        super().__init__()
        self.cfg = cfg
        width = cfg.width
        encoder: list[nn.Module] = [_conv(cfg.features, width), nn.ReLU()]
        for _ in range(cfg.down):
            encoder += [_conv(width, width, 4, 2), *_stack(width, cfg.depth, cfg.dilation, reverse=False)]
        self.encoder = nn.Sequential(*encoder, _conv(width, cfg.code_dim))
        decoder: list[nn.Module] = [_conv(cfg.code_dim, width), nn.ReLU()]
        for _ in range(cfg.down):
            decoder += [*_stack(width, cfg.depth, cfg.dilation, reverse=True), nn.Upsample(scale_factor=2), _conv(width, width)]
        self.decoder = nn.Sequential(*decoder, _conv(width, width), nn.ReLU(), _conv(width, cfg.features))
        self.quantizer = MotionQuantizer(cfg)
        self.register_buffer("mean", torch.zeros(cfg.features))
        self.register_buffer("std", torch.ones(cfg.features))

    def set_normalisation(self, mean: NDArray[np.floating], std: NDArray[np.floating]) -> None:
        """Stores the features' mean and deviation (F,); constant features keep a deviation of 1e-2 so that they stay bounded.

        Raises:
            ValueError: on a wrong shape or values that are not finite.
        """
        for name, value in (("mean", mean), ("std", std)):
            if np.shape(value) != (self.cfg.features,) or not np.isfinite(value).all():
                raise ValueError(f"{name}: expected {self.cfg.features} finite numbers, got shape {np.shape(value)}")
        self.mean.copy_(torch.as_tensor(np.asarray(mean, dtype=np.float32)))
        self.std.copy_(torch.as_tensor(np.maximum(np.asarray(std, dtype=np.float32), 1e-2)))

    def _check(self, motion: Tensor) -> None:
        if motion.ndim != 3 or motion.shape[2] != self.cfg.features or motion.shape[1] % self.cfg.stride or not motion.shape[1]:
            raise ValueError(
                f"motion: expected (batch, frames, {self.cfg.features}) with frames a multiple of {self.cfg.stride}, "
                f"got {tuple(motion.shape)}"
            )

    def _encode(self, motion: Tensor) -> Tensor:
        self._check(motion)
        x = (motion - self.mean) / self.std
        return self.encoder(x.transpose(1, 2)).transpose(1, 2)  # (B, N, D)

    def _decode(self, vectors: Tensor) -> Tensor:
        """Normalised features (B, T, F) of code vectors (B, N, D)."""
        return self.decoder(vectors.transpose(1, 2)).transpose(1, 2)

    def forward(self, motion: Tensor, generator: torch.Generator | None = None) -> TokenizerLoss:
        """Loss on motion (B, T, F) in raw units; updates the codebook in training mode.

        Raises:
            ValueError: on a wrong shape.
        """
        quantised = self.quantizer(self._encode(motion), generator)
        target = (motion - self.mean) / self.std
        rebuilt = self._decode(quantised.vectors)
        reconstruction = functional.smooth_l1_loss(rebuilt, target)
        velocity = functional.smooth_l1_loss(rebuilt.diff(dim=1), target.diff(dim=1))
        total = (
            reconstruction
            + self.cfg.velocity_weight * velocity
            + self.cfg.alpha * quantised.codebook_loss
            + self.cfg.beta * quantised.commitment_loss
        )
        return TokenizerLoss(
            total, reconstruction, velocity, quantised.codebook_loss, quantised.commitment_loss, quantised.perplexity
        )

    @torch.no_grad()
    def encode(self, motion: Tensor) -> Tensor:
        """Tokens (B, T / stride * codebooks) of motion (B, T, F) in raw units on any device, those of one step together."""
        return self.quantizer.tokens(self._encode(motion.to(self.mean.device))).flatten(1)

    @torch.no_grad()
    def decode(self, ids: Tensor) -> Tensor:
        """Motion (B, T, F) in raw units of tokens (B, T / stride * codebooks).

        Raises:
            ValueError: on tokens outside the vocabulary, or not whole steps of them.
        """
        if ids.shape[1] % self.cfg.codebooks:
            raise ValueError(f"motion: {ids.shape[1]} tokens; expected a multiple of {self.cfg.codebooks}")
        return self._decode(self.quantizer.lookup(ids.unflatten(1, (-1, self.cfg.codebooks)))) * self.std + self.mean

    def encode_window(self, motion: NDArray[np.floating]) -> tuple[int, ...]:
        """Token ids of one window (T, F): the newest `cfg.window` frames; a shorter one is padded with its first frame.

        Raises:
            ValueError: on an empty window or a wrong number of features.
        """
        frames = np.asarray(motion, dtype=np.float32)
        if frames.ndim != 2 or not len(frames):
            raise ValueError(f"motion window: expected (frames, {self.cfg.features}), got {frames.shape}")
        frames = frames[-self.cfg.window :]
        missing = self.cfg.window - len(frames)
        if missing:
            frames = np.concatenate([np.repeat(frames[:1], missing, axis=0), frames])
        return tuple(self.encode(torch.from_numpy(frames)[None])[0].tolist())

    def save(self, folder: str | Path) -> None:
        """Writes `config.json` and `model.safetensors`, each atomically."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"format": _FORMAT, "config": dataclasses.asdict(self.cfg)}, indent=2)
        write_tensors({k: v.contiguous() for k, v in self.state_dict().items()}, folder / "model.safetensors.tmp")
        os.replace(folder / "model.safetensors.tmp", folder / "model.safetensors")
        write_text(folder / "config.json", text + "\n")

    @staticmethod
    def load(folder: str | Path) -> MotionTokenizer:
        """Reads what `save` wrote, in evaluation mode.

        Raises:
            ValueError: on an unknown format.
        """
        folder = Path(folder)
        stored = read_json(folder / "config.json")
        if stored.get("format") != _FORMAT:
            raise ValueError(f"{folder}: motion tokenizer format {stored.get('format')!r}; this version reads {_FORMAT}")
        tokenizer = MotionTokenizer(build(MotionTokenizerConfig, stored["config"], "motion"))
        tokenizer.load_state_dict(read_tensors(folder / "model.safetensors"))
        return tokenizer.eval()
