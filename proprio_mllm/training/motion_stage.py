"""`stage=tokenizer` (paper, stage 1): the motion VQ-VAE, on retargeted clips and on the simulator's proprioception windows.

The windows are what a planner encodes at run time; training on clips alone would leave them out of distribution. One tokenizer
serves both robots.

Of a frame's 48 numbers 42 are key bodies, so that a loss that weighs all alike gives up the two hand openings, which tell what
the robot holds. `FEATURE_BIAS` lets single features count more, as the feature bias of HumanML3D's own normalisation does for
the root and the foot contacts; the paper does not say how it normalises. `VARIED` of the windows of clips are shown in another
posture (`posture.py`), because people move in more ways than the generated corpus does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from configs.schema.model import MotionTokenizerConfig
from data.motion import FPS, HAND_OPENING, KEY_BODY_COUNT, N_FEATURES, OPEN_HAND, PELVIS_HEIGHT
from interface.bodies import KEY_BODIES
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.loop import Objective
from proprio_mllm.training.posture import in_other_postures
from proprio_mllm.training.sources import Clips, held_out

#: Factor on each normalised feature (F,).
FEATURE_BIAS = np.ones(N_FEATURES, dtype=np.float32)
FEATURE_BIAS[PELVIS_HEIGHT] = 1.5
FEATURE_BIAS[HAND_OPENING] = 3.0
#: Share of the training windows of clips that are put in another posture.
VARIED = 0.6
_HANDS = [i for i, name in enumerate(KEY_BODIES) if name.endswith("hand")]
_FEET = [i for i, name in enumerate(KEY_BODIES) if name.endswith("ankle")]


class MotionWindows:
    """Windows of clips and of recorded proprioception, with a held-out part of each."""

    def __init__(self, clips: Clips, recorded: Sequence[NDArray[np.float32]], frames: int, clip_share: float = 0.5) -> None:
        self.clips, self.frames, self.clip_share = clips, frames, clip_share
        rows = np.concatenate([part for part in recorded if len(part)]) if any(len(part) for part in recorded) else None
        if rows is None:
            self.train = self.test = np.zeros((0, frames, clips.motions[0].shape[1]), dtype=np.float32)
        else:
            mask = np.array([held_out(f"window {i // 64}") for i in range(len(rows))], dtype=bool)
            self.train, self.test = rows[~mask], rows[mask]

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.float32]:
        """Training windows (size, frames, F) as they are."""
        return self._draw(rng, size)[0]

    def draw_varied(self, rng: np.random.Generator, size: int) -> NDArray[np.float32]:
        """Training windows (size, frames, F), `VARIED` of those of clips in another posture."""
        windows, of_clip = self._draw(rng, size)
        varied = of_clip & (rng.random(size) < VARIED)
        if varied.any():
            windows[varied] = in_other_postures(windows[varied], rng)
        return windows

    def _draw(self, rng: np.random.Generator, size: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Windows (size, frames, F), and which of them are of clips."""
        of_clip = np.array([len(self.train) == 0 or rng.random() < self.clip_share for _ in range(size)], dtype=bool)
        windows = [
            self.clips.window(int(rng.choice(self.clips.split.train)), self.frames, rng)
            if clip
            else self.train[int(rng.integers(len(self.train)))]
            for clip in of_clip
        ]
        return np.stack(windows), of_clip

    def statistics(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean and scale (F,) of all training frames, clips and windows weighted alike.

        The scale is the deviation over `FEATURE_BIAS`, for the coordinates of the key bodies their common one: a millimetre
        counts the same everywhere, and a coordinate that hardly moves here does not drown the others in clips where it does.
        """
        clips = np.concatenate([self.clips.motions[int(i)] for i in self.clips.split.train])
        parts = [clips] if len(self.train) == 0 else [clips, self.train.reshape(-1, clips.shape[1])]
        mean = np.mean([part.mean(axis=0) for part in parts], axis=0)
        square = np.mean([((part - mean) ** 2).mean(axis=0) for part in parts], axis=0)
        bodies = slice(0, 3 * KEY_BODY_COUNT)
        square[bodies] = square[bodies].mean()
        return mean.astype(np.float32), (np.sqrt(square) / FEATURE_BIAS).astype(np.float32)


class MotionObjective(Objective):
    """Reconstruction, codebook and commitment loss (paper, Eq. 2)."""

    name = "tokenizer"

    def __init__(self, tokenizer: MotionTokenizer, windows: MotionWindows, key: str) -> None:
        self.module = tokenizer
        self.key = key
        self._windows = windows

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> Tensor:
        """Windows (B, T, F)."""
        return torch.from_numpy(self._windows.draw_varied(rng, size))

    def loss(self, module: nn.Module, batch: Tensor, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        """The paper's loss; dead codes are replaced by vectors drawn with `generator`."""
        out = module(batch, generator)
        return out.total, {
            "reconstruction": float(out.reconstruction.detach()),
            "velocity": float(out.velocity.detach()),
            "commitment": float(out.commitment.detach()),
            "perplexity": float(out.perplexity),
        }


@torch.no_grad()
def reconstruction_metrics(tokenizer: MotionTokenizer, rows: NDArray[np.float32]) -> dict[str, float]:
    """What tokens keep of windows (N, T, F) in raw units.

    Returns:
        `mpjpe_mm`, mean distance of the 14 key bodies; `hands_mm` and `feet_mm`, of hands and ankles alone; `velocity_mm_s`,
        mean difference of the key bodies' velocities; `height_mm` of the pelvis; `hand_state`, share of hands whose state at
        the end, open or not, survives; `count` of windows.
    """
    truth = torch.from_numpy(rows)
    rebuilt = torch.cat([tokenizer.decode(tokenizer.encode(part)).cpu() for part in truth.split(256)])
    keys = 3 * KEY_BODY_COUNT
    away = (rebuilt[..., :keys] - truth[..., :keys]).unflatten(-1, (KEY_BODY_COUNT, 3))  # (N, T, K, 3)
    error, speed = away.norm(dim=-1), away.diff(dim=1).norm(dim=-1) * FPS
    hands = (rebuilt[:, -1, HAND_OPENING] >= OPEN_HAND) == (truth[:, -1, HAND_OPENING] >= OPEN_HAND)
    return {
        "mpjpe_mm": 1000.0 * float(error.mean()),
        "hands_mm": 1000.0 * float(error[..., _HANDS].mean()),
        "feet_mm": 1000.0 * float(error[..., _FEET].mean()),
        "velocity_mm_s": 1000.0 * float(speed.mean()),
        "height_mm": 1000.0 * float((rebuilt[..., keys] - truth[..., keys]).abs().mean()),
        "hand_state": float(hands.double().mean()),
        "count": float(len(rows)),
    }


@torch.no_grad()
def codebook_use(tokenizer: MotionTokenizer, rows: NDArray[np.float32]) -> NDArray[np.int64]:
    """How often each token occurs (vocabulary,) in windows (N, T, F)."""
    parts = torch.from_numpy(rows).split(256)
    counts = sum(torch.bincount(tokenizer.encode(part).flatten(), minlength=tokenizer.cfg.vocabulary) for part in parts)
    assert isinstance(counts, torch.Tensor)
    return counts.cpu().numpy()


def perplexity(counts: NDArray[np.int64]) -> float:
    """Exponential of the entropy of token counts (vocabulary,)."""
    share = counts[counts > 0] / counts.sum()
    return float(np.exp(-np.sum(share * np.log(share))))


def bits_per_s(cfg: MotionTokenizerConfig) -> float:
    """What the tokens of a second can tell at most."""
    return FPS / cfg.stride * cfg.codebooks * float(np.log2(cfg.codes))


def tokenizer_metrics(tokenizer: MotionTokenizer, windows: MotionWindows, seed: int = 0) -> dict[str, float]:
    """Reconstruction of held-out clips and windows, `clips_…` and `windows_…`, and the use of the codes.

    `codes_used` is the share of codes that occur in 512 training windows, `perplexity` the exponential of the entropy of their
    use, both over the whole vocabulary; `bits_per_s` what the tokens of a second can tell at most.
    """
    rng = np.random.default_rng(seed)
    clips = [windows.clips.window(int(i), windows.frames, rng) for i in windows.clips.split.test for _ in range(4)]
    result: dict[str, float] = {}
    for name, rows in (("clips", np.stack(clips) if clips else windows.test[:0]), ("windows", windows.test[:512])):
        if len(rows):
            result |= {f"{name}_{key}": value for key, value in reconstruction_metrics(tokenizer, rows).items()}
    counts = codebook_use(tokenizer, windows.draw(rng, 512))
    return result | {
        "codes_used": float((counts > 0).mean()),
        "perplexity": perplexity(counts),
        "bits_per_s": bits_per_s(tokenizer.cfg),
    }
