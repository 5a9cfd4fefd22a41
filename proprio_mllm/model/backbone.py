"""Configuration of a Qwen2.5-VL backbone that is trained from scratch: the released architecture with small numbers."""

from __future__ import annotations

from transformers import Qwen2_5_VLConfig

from configs.schema.model import ModelConfig
from proprio_mllm.model.processor import ProprioProcessor


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
