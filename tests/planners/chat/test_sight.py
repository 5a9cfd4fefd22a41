"""Features of pictures: from this project's vision tower, and from a checkpoint of one's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from transformers import BertConfig, BertModel, CLIPConfig, CLIPModel
from transformers.models.clip import CLIPImageProcessorPil

from proprio_mllm.planners.chat.sight import SightError, image_encoder, weights_digest

TOWER = "weights/tiny/base"


def picture(seed: int, side: int = 112) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 255, (4, 4, 3), dtype=np.uint8)
    return np.kron(coarse, np.ones((side // 4, side // 4, 1), np.uint8))


def test_the_tower_tells_pictures_apart_at_any_size() -> None:
    encoder = image_encoder(TOWER)
    assert encoder is image_encoder(TOWER)
    vectors = encoder.encode([picture(0), picture(1), picture(0, 500)])
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-5)
    assert vectors[0] @ vectors[2] > 0.999 and vectors[0] @ vectors[1] < 0.98
    np.testing.assert_array_equal(encoder.encode([picture(1)])[0], vectors[1])


def test_a_checkpoint_of_ones_own(tmp_path: Path) -> None:
    small = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    text = small | {"vocab_size": 9, "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0}
    config = CLIPConfig(text_config=text, vision_config=small | {"image_size": 32, "patch_size": 16}, projection_dim=16)
    CLIPModel(config).save_pretrained(tmp_path)
    side = {"height": 32, "width": 32}
    CLIPImageProcessorPil(size={"shortest_edge": 32}, crop_size=side).save_pretrained(tmp_path)
    vectors = image_encoder(str(tmp_path)).encode([picture(0), picture(1)])
    assert vectors.shape == (2, 16)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-5)
    assert weights_digest(str(tmp_path)) != weights_digest(TOWER)


def test_what_is_no_encoder_is_named(tmp_path: Path) -> None:
    with pytest.raises(SightError, match=r"no image encoder at .*: it has no config\.json"):
        image_encoder(str(tmp_path / "nothing"))
    with pytest.raises(SightError, match=r"no image encoder at .*: it has no \.safetensors file"):
        weights_digest(str(tmp_path))
    CLIPImageProcessorPil().save_pretrained(tmp_path)
    small = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    BertModel(BertConfig(vocab_size=9, **small)).save_pretrained(tmp_path)
    with pytest.raises(SightError, match="BertModel has no get_image_features"):
        image_encoder(str(tmp_path))
