"""Qwen2.5-VL backbones: small ones that are trained from scratch, the released ones' shapes, and how patches are embedded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from torch import Tensor, nn
from torch.nn import functional
from transformers import Qwen2_5_VLConfig

from configs.schema.model import ModelConfig
from proprio_mllm.model.processor import ProprioProcessor

#: Language models of the released weights (their config.json): width, inner width, layers, heads, their pairs, rows, tied rows.
PUBLISHED: Final[Mapping[str, tuple[int, int, int, int, int, int, bool]]] = {
    "Qwen/Qwen2.5-VL-3B-Instruct": (2048, 11008, 36, 16, 2, 151936, True),
    "Qwen/Qwen2.5-VL-7B-Instruct": (3584, 18944, 28, 28, 4, 152064, False),
}


def given_config(weights: str, **text: Any) -> Qwen2_5_VLConfig:
    """Configuration of weights that are given, without reading any: a folder's, or that of a released name.

    Args:
        weights: folder with a config.json, or a name of `PUBLISHED`.
        text: fields of the language model that are to be others, such as `num_hidden_layers`.

    Raises:
        ValueError: when it is neither.
    """
    if (Path(weights) / "config.json").is_file():
        config = Qwen2_5_VLConfig.from_pretrained(weights)
        for name, value in text.items():
            setattr(config.text_config, name, value)
        return config
    if weights not in PUBLISHED:
        raise ValueError(f"no config.json in {weights!r}; names whose shape is known: {', '.join(PUBLISHED)}")
    hidden, inner, layers, heads, pairs, rows, tied = PUBLISHED[weights]
    shape = {
        "vocab_size": rows,
        "hidden_size": hidden,
        "intermediate_size": inner,
        "num_hidden_layers": layers,
        "num_attention_heads": heads,
        "num_key_value_heads": pairs,
        "rope_parameters": {"rope_type": "default", "rope_theta": 1e6, "mrope_section": [16, 24, 24]},
        "tie_word_embeddings": tied,
    }
    vision = {"depth": 32, "hidden_size": 1280, "num_heads": 16, "intermediate_size": 3420, "out_hidden_size": hidden}
    return Qwen2_5_VLConfig(text_config=shape | text, vision_config=vision, tie_word_embeddings=tied)


def backbone_config(cfg: ModelConfig, processor: ProprioProcessor) -> Qwen2_5_VLConfig:
    """Configuration of a backbone from scratch; every token id comes from the tokenizer."""
    tokenizer, text, vision = processor.tokenizer, cfg.text, cfg.vision

    def token(name: str) -> int:
        return int(tokenizer.convert_tokens_to_ids(name))

    eighth = text.hidden // text.heads // 16  # halves of the head split 2:3:3 between time, row and column, as in the 7B
    return Qwen2_5_VLConfig(
        text_config={
            "vocab_size": -(-len(tokenizer) // 64) * 64,
            "hidden_size": text.hidden,
            "intermediate_size": text.intermediate,
            "num_hidden_layers": text.layers,
            "num_attention_heads": text.heads,
            "num_key_value_heads": text.kv_heads,
            "max_position_embeddings": text.max_positions,
            "rope_parameters": {
                "rope_type": "default",
                "rope_theta": text.rope_theta,
                "mrope_section": [2 * eighth, 3 * eighth, 3 * eighth],
            },
            "bos_token_id": token("<|endoftext|>"),
            "eos_token_id": token("<|im_end|>"),
            "pad_token_id": token("<|endoftext|>"),
            "tie_word_embeddings": True,
        },
        vision_config={
            "depth": vision.depth,
            "hidden_size": vision.hidden,
            "num_heads": vision.heads,
            "intermediate_size": vision.intermediate,
            "out_hidden_size": text.hidden,
            "fullatt_block_indexes": list(range(vision.depth)),
        },
        image_token_id=token("<|image_pad|>"),
        video_token_id=token("<|video_pad|>"),
        vision_start_token_id=token("<|vision_start|>"),
        vision_end_token_id=token("<|vision_end|>"),
        tie_word_embeddings=True,
    )


class PatchEmbedding(nn.Module):
    """Qwen's patch embedding as the matrix product that it is, under the same name of its weights.

    A convolution whose kernel and stride are a patch took 70 % of the small tower's time on two cores.

    Args:
        proj: Qwen's convolution.
    """

    def __init__(self, proj: nn.Conv3d) -> None:
        super().__init__()
        self.proj = proj

    def forward(self, hidden_states: Tensor) -> Tensor:
        """Embeddings (P, D) of patches (P, 1176), as Qwen's image processor gives them."""
        weight = self.proj.weight
        return functional.linear(hidden_states.to(weight.dtype), weight.flatten(1))
