"""Folders that can answer and those that cannot, and how a checkpoint is named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from tokenizers import Tokenizer
from tokenizers.processors import TemplateProcessing

from configs.schema.backend import BackendConfig
from proprio_mllm.backends import checkpoint
from proprio_mllm.backends.checkpoint import InternVLImages, QwenImages, find_checkpoint, load_checkpoint
from proprio_mllm.backends.protocol import BackendSetupError

TINY = Path(__file__).parents[2] / "weights" / "tiny"


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """A copy of a checkpoint, to break."""
    return shutil.copytree(folder, tmp_path / "copy")


def load(folder: Path, **fields: Any) -> checkpoint.Loaded:
    return load_checkpoint(find_checkpoint(str(folder)), BackendConfig("local", "test", model=str(folder), **fields))


def change(path: Path, **fields: Any) -> None:
    content = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({k: v for k, v in (content | fields).items() if v is not None}), encoding="utf-8")


def test_both_architectures_are_read_as_released(qwen_folder: Path, internvl_folder: Path) -> None:
    qwen, internvl = load(qwen_folder, device="cpu"), load(internvl_folder, device="cpu")
    assert isinstance(qwen.processor, QwenImages)
    assert isinstance(internvl.processor, InternVLImages)
    assert len(qwen.ends) == 2, "the ends of generation_config.json"
    tokenizer = internvl.processor.tokenizer
    assert tokenizer.convert_ids_to_tokens(internvl.ends) == ["<|im_end|>", "</s>"]
    for loaded in (qwen, internvl):
        assert type(loaded.processor.image_processor).__name__.endswith("Pil")
        assert loaded.context == 1024
        assert loaded.vocabulary == loaded.model.lm_head.weight.shape[0]
        assert loaded.model.dtype == torch.float32
        assert not loaded.model.training
    assert internvl.processor.image_seq_length == 16


def test_a_folder_that_is_no_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        BackendSetupError, match=r"nowhere: not a checkpoint: .*FileNotFoundError.*expected a folder with config"
    ):
        find_checkpoint(str(tmp_path / "nowhere"))
    (tmp_path / "config.json").write_text("[", encoding="utf-8")
    with pytest.raises(BackendSetupError, match="JSONDecodeError"):
        find_checkpoint(str(tmp_path))
    (tmp_path / "config.json").write_text("[]", encoding="utf-8")
    with pytest.raises(BackendSetupError, match="is not a JSON object"):
        find_checkpoint(str(tmp_path))


@pytest.mark.parametrize(("found", "hint"), [("llama", "$"), ("internvl_chat", "the -hf form of this checkpoint can")])
def test_another_architecture_is_refused(tmp_path: Path, found: str, hint: str) -> None:
    content = {"model_type": found, "auto_map": {"AutoModel": "modeling.Model"}}
    (tmp_path / "config.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(BackendSetupError, match=rf"model type '{found}' cannot answer; allowed: qwen2_5_vl, internvl.*{hint}"):
        find_checkpoint(str(tmp_path))


def test_pickles_are_not_read(copy: Path) -> None:
    state = load_file(copy / "model.safetensors")
    (copy / "model.safetensors").unlink()
    torch.save(state, copy / "pytorch_model.bin")
    with pytest.raises(BackendSetupError, match=r"no weights there; expected \*\.safetensors"):
        find_checkpoint(str(copy))


def test_weights_that_lack_tensors_are_refused(copy: Path) -> None:
    state = load_file(copy / "model.safetensors")
    del state[next(name for name in state if name.endswith("lm_head.weight"))]
    save_file(state, copy / "model.safetensors", {"format": "pt"})
    with pytest.raises(BackendSetupError, match=r"weights lack \['lm_head.weight'\]"):
        load(copy, device="cpu")


def test_broken_weights_are_refused(copy: Path) -> None:
    (copy / "model.safetensors").write_bytes(b"\0" * 100)
    with pytest.raises(BackendSetupError, match=r"copy: cannot be read as (qwen2_5_vl|internvl)"):
        load(copy, device="cpu")


def test_a_chat_template_is_required(copy: Path) -> None:
    for name in ("chat_template.json", "chat_template.jinja"):
        (copy / name).unlink(missing_ok=True)
    with pytest.raises(BackendSetupError, match=r"cannot be read as .* no chat template"):
        load(copy, device="cpu")


def test_a_template_kept_with_the_tokenizer_counts(copy: Path) -> None:
    for name in ("chat_template.json", "chat_template.jinja"):
        (copy / name).unlink(missing_ok=True)
    change(copy / "tokenizer_config.json", chat_template="{{ messages[0]['role'] }}")
    assert load(copy, device="cpu").processor.chat_template.endswith("{{ messages[0]['role'] }}")


def test_a_chat_template_that_fails_is_refused(copy: Path) -> None:
    for name in ("chat_template.json", "chat_template.jinja"):
        (copy / name).unlink(missing_ok=True)
    (copy / "chat_template.jinja").write_text("{{ raise_exception('never') }}", encoding="utf-8")
    with pytest.raises(BackendSetupError, match="its chat template cannot write a question: never"):
        load(copy, device="cpu")


def test_a_tokenizer_may_start_a_text_and_add_nothing_else(internvl_folder: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(internvl_folder, tmp_path / "copy")
    stored = Tokenizer.from_file(str(copy / "tokenizer.json"))
    stored.post_processor = TemplateProcessing(single="<s> $A </s>", special_tokens=[("<s>", 1), ("</s>", 2)])
    stored.save(str(copy / "tokenizer.json"))
    with pytest.raises(BackendSetupError, match=r"adds \['<s>', '</s>'\] to every text; allowed: a start token"):
        load(copy, device="cpu")


def test_internvl_names_its_picture_tokens(internvl_folder: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(internvl_folder, tmp_path / "copy")
    change(copy / "tokenizer_config.json", extra_special_tokens=["<img>"])
    with pytest.raises(BackendSetupError, match="does not name start_image_token, end_image_token, context_image_token"):
        load(copy, device="cpu")


def test_a_reply_needs_a_token_that_ends_it(internvl_folder: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(internvl_folder, tmp_path / "copy")
    change(copy / "tokenizer_config.json", eos_token=None, pad_token=None, tokenizer_class="PreTrainedTokenizerFast")
    config = json.loads((copy / "config.json").read_text(encoding="utf-8"))
    change(copy / "config.json", text_config=config["text_config"] | {"eos_token_id": None, "pad_token_id": None})
    (copy / "generation_config.json").unlink()
    with pytest.raises(BackendSetupError, match="names no token that ends a reply"):
        load(copy, device="cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_a_device_that_is_not_there_is_refused(folder: Path) -> None:
    with pytest.raises(BackendSetupError, match="device 'cuda:1': no CUDA device here; allowed: auto, cpu"):
        load(folder, device="cuda:1")
    assert str(load(folder).model.device) == "cpu"


def test_the_base_model_of_this_project_can_answer_and_the_others_cannot(tmp_path: Path) -> None:
    found = find_checkpoint(str(TINY / "base"))
    assert (found.weights.name, found.processing.name, found.model_type) == ("vlm", "processor", "qwen2_5_vl")
    with pytest.raises(
        BackendSetupError, match=r"adapter 'default', mpe.mode=rope_sign, cse.enabled=true, proprioception=true"
    ):
        find_checkpoint(str(TINY / "full"))
    shutil.copytree(TINY / "base", tmp_path / "shared", ignore=shutil.ignore_patterns("vlm"))
    with pytest.raises(BackendSetupError, match="no weights of its own"):
        find_checkpoint(str(tmp_path / "shared"))


def test_the_fingerprint_changes_with_the_checkpoint(copy: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = find_checkpoint(str(folder)).fingerprint()
    found = find_checkpoint(str(copy))
    assert found.fingerprint() == first, "of a copy"
    (copy / "README.md").write_text("read me", encoding="utf-8")
    assert found.fingerprint() == first, "of what decides replies alone"
    seen = {first}
    for name in ("config.json", "tokenizer_config.json"):
        change(copy / name, more=1)
        seen.add(found.fingerprint())
    state = load_file(copy / "model.safetensors")
    save_file({k: v + 1e-3 for k, v in state.items()}, copy / "model.safetensors", {"format": "pt"})
    seen.add(found.fingerprint())
    monkeypatch.setattr(checkpoint, "_WHOLE_BYTES", 1000)
    monkeypatch.setattr(checkpoint, "_SAMPLE_BYTES", 64)
    seen.add(found.fingerprint())
    save_file({k: v + 2e-3 for k, v in state.items()}, copy / "model.safetensors", {"format": "pt"})
    seen.add(found.fingerprint())
    assert len(seen) == 6
