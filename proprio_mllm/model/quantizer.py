"""Quantisers of the motion tokenizer (paper: stage 1, Eq. 1-2), on vector-quantize-pytorch's.

`vq` is the paper's: one codebook, kept by moving averages of the encodings (`ema`, as in MotionGPT and T2M-GPT; the codebook
loss has no gradient then and is logged only) or by the gradient of the codebook loss as printed (`grad`). Beyond the paper:
`rvq`, several codebooks of which each quantises what the one before left over, and `fsq`, no codebook but a rounded grid.

A step of an encoding becomes one token, with `rvq` one per codebook; tokens of the later codebooks are counted on, so that a
token says which codebook it belongs to. The library's defaults differ from the paper's rules (decay, dead codes, rotation
trick) and are set here; its draws follow the caller's generator. Codebooks, counts and sums are buffers of the state dict.

Shape letters: B batch, N steps, D code width, C codes, Q codebooks (1 but for `rvq`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional
from vector_quantize_pytorch import FSQ, ResidualVQ, VectorQuantize

from configs.schema.model import MotionTokenizerConfig


@dataclass(frozen=True, slots=True)
class Quantised:
    """Result of a quantisation.

    Attributes:
        vectors: (B, N, D) chosen codes with the straight-through gradient.
        tokens: (B, N, Q) indices in [0, Q C).
        codebook_loss: mean squared distance of codes to fixed encodings, summed over codebooks; 0 without a codebook.
        commitment_loss: mean squared distance of encodings to fixed codes, likewise.
        perplexity: exp of the entropy of the batch's token use, in [1, Q C].
    """

    vectors: Tensor
    tokens: Tensor
    codebook_loss: Tensor
    commitment_loss: Tensor
    perplexity: Tensor


class MotionQuantizer(nn.Module):
    """Turns encodings into tokens and back.

    Args:
        cfg: sizes and rules.
    """

    def __init__(self, cfg: MotionTokenizerConfig) -> None:
        super().__init__()
        self.cfg = cfg
        learned = cfg.update == "grad"
        rules = {
            "codebook_size": cfg.codes,
            "decay": cfg.ema_decay,
            "threshold_ema_dead_code": cfg.reset_below,
            "commitment_weight": 1.0,
            "rotation_trick": False,
            "kmeans_init": True,
            "ema_update": not learned,
            "learnable_codebook": learned,
        }
        if cfg.quantizer == "vq":
            self.inner: nn.Module = VectorQuantize(cfg.code_dim, **rules)
        elif cfg.quantizer == "rvq":
            self.inner = ResidualVQ(dim=cfg.code_dim, num_quantizers=cfg.stages, **rules)
        else:
            self.inner = FSQ(list(cfg.levels), dim=cfg.code_dim)

    def tokens(self, vectors: Tensor) -> Tensor:
        """Tokens (B, N, Q) of encodings (B, N, D); changes nothing."""
        training = self.inner.training
        self.inner.eval()
        try:
            indices = self.inner(vectors)[1]
        finally:
            self.inner.train(training)
        return self._counted(indices)

    def lookup(self, tokens: Tensor) -> Tensor:
        """Codes (B, N, D) of tokens (B, N, Q).

        Raises:
            ValueError: on a token outside the vocabulary, or of another codebook than its place says.
        """
        cfg = self.cfg
        first = torch.arange(tokens.shape[-1], device=tokens.device) * cfg.codes
        indices = tokens - first
        wrong = (indices < 0) | (indices >= cfg.codes)
        if bool(wrong.any()):
            *_, place = wrong.nonzero()[0].tolist()
            raise ValueError(
                f"motion token {int(tokens[wrong][0])} outside the codebook [{place * cfg.codes}, {(place + 1) * cfg.codes})"
            )
        return self._codes(indices if cfg.quantizer == "rvq" else indices[..., 0])

    def forward(self, vectors: Tensor, generator: torch.Generator | None = None) -> Quantised:
        """Quantises encodings (B, N, D); in training mode it also updates the codebooks.

        Args:
            vectors: encodings.
            generator: draws the first codes and the vectors that replace unused ones.
        """
        with _own_draws(generator):
            through, indices, *losses = self.inner(vectors)
        codebook_loss = commitment_loss = vectors.new_zeros(())
        if self.cfg.quantizer == "vq":
            chosen = self._codes(indices) if self.cfg.update == "grad" else through.detach()
            codebook_loss = functional.mse_loss(chosen, vectors.detach())
            commitment_loss = functional.mse_loss(vectors, chosen.detach())
        elif self.cfg.quantizer == "rvq" and self.training:
            commitment_loss = losses[0].sum()
            codebook_loss = commitment_loss.detach()
        if self.cfg.quantizer != "fsq":  # once for all codebooks: the library's would count every one
            through = vectors + (through - vectors).detach()
        tokens = self._counted(indices)
        share = torch.bincount(tokens.flatten(), minlength=self.cfg.vocabulary).to(vectors.dtype) / tokens.numel()
        perplexity = torch.exp(-(share * (share + 1e-10).log()).sum())
        return Quantised(through, tokens, codebook_loss, commitment_loss, perplexity)

    def _codes(self, indices: Tensor) -> Tensor:
        inner = self.inner
        return inner.indices_to_codes(indices) if isinstance(inner, FSQ) else inner.get_output_from_indices(indices)  # type: ignore[operator]

    def _counted(self, indices: Tensor) -> Tensor:
        """Library's indices (B, N) or (B, N, Q) as tokens (B, N, Q)."""
        indices = (indices if self.cfg.quantizer == "rvq" else indices[..., None]).long()
        return indices + torch.arange(indices.shape[-1], device=indices.device) * self.cfg.codes


@contextmanager
def _own_draws(generator: torch.Generator | None) -> Iterator[None]:
    """Within it torch's global draws follow from `generator` alone, and are as before afterwards."""
    if generator is None:
        yield
        return
    with torch.random.fork_rng():
        torch.manual_seed(int(torch.randint(2**62, (), generator=generator)))
        yield
