"""A head of the language model learns to point: from the name of a thing to the visual tokens that show it.

What CSE adds to a visual token is of use only when the language model looks the token up by the thing's name. The released
Qwen2.5-VL has learnt to (it gives boxes and points); a small model that is only asked where things are learns it late. Here one
attention head is shown where to look, by the simulator's segmentation, while questions are learnt: at the last token of a name,
its attention is to lie on the cells that show the thing. In training only; the paper has no such loss.

Shape letters: B rows, S tokens of a row, K names, N visual tokens of an image, D head dimension.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from torch import Tensor, nn
from transformers.models.qwen2_5_vl.modeling_qwen2_5_vl import apply_rotary_pos_emb

from proprio_mllm.model.batch import Batch, Named
from proprio_mllm.model.modeling import ModelOutput, ProprioMLLM

#: The layer that points, and its head; the layers before gather names of several words, those after read what it brings.
LAYER: Final = 2
HEAD: Final = 0


class Pointing:
    """Teaches a model's pointing head beside what a batch teaches.

    Args:
        model: adapters or not.
        weight: of the pointing loss; 0 leaves the head alone.
    """

    def __init__(self, model: ProprioMLLM, weight: float) -> None:
        layers: Any = model.core.model.language_model.layers
        self._layer: Any = layers[min(LAYER, len(layers) - 1)]
        self._weight = weight

    def __call__(self, module: nn.Module, batch: Batch) -> tuple[ModelOutput, Tensor, dict[str, float]]:
        """What the module makes of a batch, the loss with that of pointing, and pointing's metrics.

        Args:
            module: the model, as it is trained.
            batch: a whole one, or a part of one.
        """
        if batch.named is None or not self._weight:
            out = module(batch)
            return out, out.loss, {}
        read: dict[str, Any] = {}

        def keep(_: nn.Module, args: tuple[Any, ...], inputs: dict[str, Any]) -> None:
            read["hidden"] = args[0] if args else inputs["hidden_states"]
            read["cos"], read["sin"] = inputs["position_embeddings"]

        handle = self._layer.register_forward_pre_hook(keep, with_kwargs=True)
        try:
            out = module(batch)
        finally:
            handle.remove()
        loss, right = self._loss(batch.named, **read)
        share = out.supervised / max(batch.out_of or out.supervised, 1)
        metrics = {"point_loss": share * float(loss.detach()), "pointed": share * right}
        return out, out.loss + self._weight * share * loss, metrics

    def _loss(self, named: Named, hidden: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, float]:
        """Cross-entropy of the head's attention at the names to the cells of their things, and how often its peak is on one."""
        hidden, attention = self._layer.input_layernorm(hidden), self._layer.self_attn
        query, key = (
            layer(hidden).unflatten(-1, (-1, attention.head_dim))[:, None, :, HEAD]
            for layer in (attention.q_proj, attention.k_proj)
        )
        query, key = (one[:, 0].float() for one in apply_rotary_pos_emb(query, key, cos, sin))  # (B, S, D)
        scores = torch.einsum("kd,ksd->ks", query[named.row, named.place], key[named.row]) * attention.scaling
        later = torch.arange(scores.shape[1], device=scores.device) > named.place[:, None]
        shares = scores.masked_fill(later, -torch.inf).log_softmax(-1)
        told = shares.gather(1, named.first[:, None] + torch.arange(named.cells.shape[1], device=scores.device))  # (K, N)
        peak = named.cells.gather(1, told.detach().argmax(1, keepdim=True))
        return -(named.cells * told).sum(1).mean(), float((peak > 0).float().mean())
