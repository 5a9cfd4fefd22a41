"""Tiny random checkpoints of both architectures, stored as the released ones are, and requests for them."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tokenizers.processors import TemplateProcessing
from transformers import (
    InternVLForConditionalGeneration,
    LlamaTokenizer,
    PreTrainedTokenizerBase,
    Qwen2_5_VLForConditionalGeneration,
)
from transformers.models.internvl.configuration_internvl import InternVLConfig
from transformers.models.qwen2_5_vl.configuration_qwen2_5_vl import Qwen2_5_VLConfig

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.local import LocalChat
from proprio_mllm.backends.protocol import ChatImage, ChatMessage, ChatRequest
from proprio_mllm.model.processor import CHAT_TEMPLATE
from proprio_mllm.model.tokenizer import train_tokenizer

CONTEXT = 1024
#: As the conversion of InternVL writes it: no default system line, a line end after each picture.
INTERNVL_TEMPLATE = (
    "{% for message in messages %}{{'<|im_start|>' + message['role'] + '\n'}}"
    "{% if message['content'] is string %}{{ message['content'] }}{% else %}{% for content in message['content'] %}"
    "{% if content['type'] == 'image' %}{{ '<IMG_CONTEXT>\n' }}{% elif content['type'] == 'text' %}{{ content['text'] }}"
    "{% endif %}{% endfor %}{% endif %}{{'<|im_end|>\n'}}{% endfor %}"
    "{% if add_generation_prompt %}{{'<|im_start|>assistant\n' }}{% endif %}"
)
_PICTURES = {"start_image_token": "<img>", "end_image_token": "</img>", "context_image_token": "<IMG_CONTEXT>"}
_TEXTS = ['pick the mug with the left arm {"arm": "left"}', "open the fridge and look", "what do you see"] * 4
_TEXT_SIZES = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def _text_config(tokenizer: PreTrainedTokenizerBase, model_type: str) -> dict[str, Any]:
    return {
        **_TEXT_SIZES,
        "model_type": model_type,
        "num_key_value_heads": 1,
        "vocab_size": len(tokenizer) + 7,  # released matrices have spare rows
        "max_position_embeddings": CONTEXT,
        "eos_token_id": tokenizer.eos_token_id,
        "bos_token_id": tokenizer.bos_token_id,
        "pad_token_id": tokenizer.pad_token_id,
        "tie_word_embeddings": False,
    }


def _store(model: Any, tokenizer: PreTrainedTokenizerBase, folder: Path) -> None:
    """Weights large enough that a reply depends on what was asked; special tokens are never the likeliest."""
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.dim() > 1:
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 1.5 / parameter[0].numel() ** 0.5)
        model.lm_head.weight[tokenizer.all_special_ids] = 0.0
    model.save_pretrained(folder)


def _write(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content), encoding="utf-8")


@pytest.fixture(scope="session")
def qwen_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Qwen2.5-VL in the layout of its release: legacy image processor and template files."""
    folder = tmp_path_factory.mktemp("checkpoints") / "tiny-qwen"
    tokenizer = train_tokenizer(_TEXTS, 340)
    ids = tokenizer.get_vocab()
    text = _text_config(tokenizer, "qwen2_5_vl_text")
    rope = {"rope_type": "default", "mrope_section": [1, 1, 2], "rope_theta": 10000.0}
    config = Qwen2_5_VLConfig(
        text_config={**text, "rope_parameters": rope},
        vision_config={
            "depth": 2,
            "hidden_size": 16,
            "intermediate_size": 24,
            "num_heads": 2,
            "out_hidden_size": 16,
            "fullatt_block_indexes": [1],
            "window_size": 112,
        },
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
        tie_word_embeddings=False,
    )
    _store(Qwen2_5_VLForConditionalGeneration(config), tokenizer, folder)
    tokenizer.save_pretrained(folder)
    _write(
        folder / "preprocessor_config.json",
        {
            "image_processor_type": "Qwen2VLImageProcessor",
            "processor_class": "Qwen2_5_VLProcessor",
            "min_pixels": 3136,
            "max_pixels": 12845056,
            "patch_size": 14,
            "temporal_patch_size": 2,
            "merge_size": 2,
        },
    )
    _write(folder / "chat_template.json", {"chat_template": CHAT_TEMPLATE})
    # What Qwen2.5-VL's files recommend; requests say what they want themselves.
    ends = [tokenizer.eos_token_id, tokenizer.pad_token_id]
    recommended = {"do_sample": True, "repetition_penalty": 1.05, "temperature": 0.000001, "eos_token_id": ends}
    _write(folder / "generation_config.json", recommended)
    return folder


@pytest.fixture(scope="session")
def internvl_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """InternVL in its `-hf` form as InternVL2.5-8B is: Llama's text model and tokenizer, whose own end is not a turn's.

    One token per letter, tiles of 224 pixels.
    """
    folder = tmp_path_factory.mktemp("checkpoints") / "tiny-internvl"
    letters = ["<unk>", "<s>", "</s>", *(f"<0x{byte:02X}>" for byte in range(256)), "▁", *map(chr, range(33, 127))]
    tokenizer = LlamaTokenizer({letter: index for index, letter in enumerate(letters)}, [], add_prefix_space=False)
    special = ["<|im_start|>", "<|im_end|>", *_PICTURES.values()]
    tokenizer.add_special_tokens({"pad_token": "</s>", "extra_special_tokens": special})
    ids = tokenizer.get_vocab()
    tokenizer.backend_tokenizer.post_processor = TemplateProcessing(single="<s> $A", special_tokens=[("<s>", ids["<s>"])])
    config = InternVLConfig(
        text_config=_text_config(tokenizer, "llama"),
        vision_config={
            **_TEXT_SIZES,
            "image_size": [224, 224],
            "patch_size": [28, 28],
        },
        image_token_id=ids["<IMG_CONTEXT>"],
        image_seq_length=16,
        tie_word_embeddings=False,
    )
    _store(InternVLForConditionalGeneration(config), tokenizer, folder)
    tokenizer.save_pretrained(folder)
    stored = json.loads((folder / "tokenizer_config.json").read_text(encoding="utf-8"))
    _write(
        folder / "tokenizer_config.json", stored | {"extra_special_tokens": _PICTURES, "processor_class": "InternVLProcessor"}
    )
    _write(
        folder / "preprocessor_config.json",
        {
            "image_processor_type": "GotOcr2ImageProcessorFast",
            "processor_class": "InternVLProcessor",
            "size": {"height": 224, "width": 224},
            "image_mean": [0.485, 0.456, 0.406],
            "image_std": [0.229, 0.224, 0.225],
        },
    )
    _write(folder / "processor_config.json", {"processor_class": "InternVLProcessor", "image_seq_length": 16})
    _write(folder / "generation_config.json", {"eos_token_id": ids["<|im_end|>"]})
    (folder / "chat_template.jinja").write_text(INTERNVL_TEMPLATE, encoding="utf-8")
    return folder


@pytest.fixture(params=["qwen", "internvl"])
def folder(request: pytest.FixtureRequest) -> Path:
    """Each checkpoint in turn."""
    return request.getfixturevalue(f"{request.param}_folder")


def local_config(folder: Path, **fields: Any) -> BackendConfig:
    values: dict[str, Any] = {"batch": 4} | fields
    return BackendConfig("local", "test", model=str(folder), device="cpu", **values)


@pytest.fixture
def open_chat() -> Any:
    """Opens checkpoints, and closes them after the test."""
    opened: list[LocalChat] = []

    def make(folder: Path, **fields: Any) -> LocalChat:
        opened.append(LocalChat(local_config(folder, **fields)))
        return opened[-1]

    yield make
    for chat in opened:
        chat.close()


def picture(seed: int, side: int = 500, kind: str = "png") -> ChatImage:
    noise = np.random.default_rng(seed).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    data = io.BytesIO()
    Image.fromarray(noise).resize((side, side)).save(data, kind)
    return ChatImage(data.getvalue(), "image/jpeg" if kind == "jpeg" else "image/png")


def question(*content: str | ChatImage, **fields: Any) -> ChatRequest:
    messages = (ChatMessage("system", ("plan",)), ChatMessage("user", content))
    values: dict[str, Any] = {"max_tokens": 10} | fields
    return ChatRequest(messages, **values)


@pytest.fixture
def ask() -> Callable[..., ChatRequest]:
    return question


@pytest.fixture
def view() -> Callable[..., ChatImage]:
    return picture
