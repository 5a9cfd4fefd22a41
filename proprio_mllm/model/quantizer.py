"""Vector quantiser with a moving-average codebook (paper: stage 1, Eq. 1-2).

The codebook, its moving counts and sums are buffers, so that a resumed run continues with the codebook it had. Two update
rules: `ema`, moving averages as in MotionGPT and T2M-GPT (the codebook loss has no gradient then and is logged only), and
`grad`, the codebook loss as printed.

Shape letters: N vectors, D code width, C codes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["Quantised", "VectorQuantizer"]


@dataclass(frozen=True, slots=True)
class Quantised:
    """Result of a quantisation.

    Attributes:
        vectors: (..., D) chosen codes with the straight-through gradient.
        ids: (...) indices.
        codebook_loss: mean squared distance of codes to fixed encodings.
        commitment_loss: mean squared distance of encodings to fixed codes.
        perplexity: exp of the entropy of the batch's code use, in [1, C].
    """

    vectors: Tensor
    ids: Tensor
    codebook_loss: Tensor
    commitment_loss: Tensor
    perplexity: Tensor


class VectorQuantizer(nn.Module):
    """Nearest-code quantiser.

    Args:
        codes: number of codes C.
        dim: width of a code D.
        update: `ema` or `grad`.
        decay: decay of the moving averages.
        reset_below: a code whose moving count is below this is replaced by a random vector of the batch.
    """

    codebook: Tensor
    counts: Tensor
    sums: Tensor
    initialised: Tensor

    def __init__(
        self, codes: int, dim: int, update: Literal["ema", "grad"] = "ema", decay: float = 0.99, reset_below: float = 1.0
    ) -> None:
        super().__init__()
        if update not in ("ema", "grad"):
            raise ValueError(f"update {update!r} is not allowed; allowed: ema, grad")
        self.codes, self.dim, self.update, self.decay, self.reset_below = codes, dim, update, decay, reset_below
        start = torch.zeros(codes, dim)
        if update == "grad":
            self.codebook = nn.Parameter(start)
        else:
            self.register_buffer("codebook", start)
        self.register_buffer("counts", torch.zeros(codes))
        self.register_buffer("sums", torch.zeros(codes, dim))
        self.register_buffer("initialised", torch.zeros((), dtype=torch.bool))

    def nearest(self, vectors: Tensor) -> Tensor:
        """Index (...) of the code nearest to each vector (..., D)."""
        flat = vectors.reshape(-1, self.dim)
        distance = self.codebook.pow(2).sum(1) - 2 * flat @ self.codebook.T  # (N, C), up to a term equal for all codes
        return distance.argmin(dim=1).reshape(vectors.shape[:-1])

    def lookup(self, ids: Tensor) -> Tensor:
        """Codes (..., D) of indices (...).

        Raises:
            ValueError: on an index outside the codebook.
        """
        if ids.numel() and (int(ids.min()) < 0 or int(ids.max()) >= self.codes):
            raise ValueError(f"code {int(ids.min())}..{int(ids.max())} outside the codebook [0, {self.codes})")
        return self.codebook[ids]

    def forward(self, vectors: Tensor, generator: torch.Generator | None = None) -> Quantised:
        """Quantises encodings (..., D); in training mode it also updates the codebook.

        Args:
            vectors: encodings.
            generator: draws the vectors that replace unused codes.
        """
        flat = vectors.reshape(-1, self.dim)
        if self.training and not bool(self.initialised):
            self._initialise(flat.detach(), generator)
        ids = self.nearest(flat.detach())
        chosen = self.codebook[ids]
        codebook_loss = functional.mse_loss(chosen, flat.detach())
        commitment_loss = functional.mse_loss(flat, chosen.detach())
        through = flat + (chosen - flat).detach()
        used = functional.one_hot(ids, self.codes).to(flat.dtype)
        share = used.mean(0)
        perplexity = torch.exp(-(share * (share + 1e-10).log()).sum())
        if self.training:
            self._update(flat.detach(), used, generator)
        shape = vectors.shape
        return Quantised(through.reshape(shape), ids.reshape(shape[:-1]), codebook_loss, commitment_loss, perplexity)

    def _draw(self, flat: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
        """`count` vectors of the batch, with a little noise when the batch has fewer."""
        picked = torch.randint(len(flat), (count,), generator=generator)
        if len(flat) >= count:
            picked = torch.randperm(len(flat), generator=generator)[:count]
        drawn = flat[picked.to(flat.device)]
        if len(flat) < count:
            drawn = drawn + torch.randn(drawn.shape, generator=generator).to(drawn) * 0.01 / self.dim**0.5
        return drawn

    @torch.no_grad()
    def _initialise(self, flat: Tensor, generator: torch.Generator | None) -> None:
        self.codebook.copy_(self._draw(flat, self.codes, generator))
        self.sums.copy_(self.codebook)
        self.counts.fill_(1.0)
        self.initialised.fill_(True)

    @torch.no_grad()
    def _update(self, flat: Tensor, used: Tensor, generator: torch.Generator | None) -> None:
        counts, sums = used.sum(0), used.T @ flat  # (C,), (C, D)
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(counts)
            torch.distributed.all_reduce(sums)
        self.counts.mul_(self.decay).add_(counts, alpha=1 - self.decay)
        self.sums.mul_(self.decay).add_(sums, alpha=1 - self.decay)
        # Counts start at 1 and decay towards the mean use; a code of use u per batch settles at u.
        dead = self.counts < self.reset_below
        if self.update == "ema":
            alive = ~dead
            self.codebook[alive] = self.sums[alive] / self.counts[alive].unsqueeze(1)
        if bool(dead.any()):
            fresh = self._draw(flat, int(dead.sum()), generator)
            self.codebook[dead] = fresh
            self.sums[dead] = fresh
            self.counts[dead] = 1.0
