"""Checkpoints on disk that answer chats: found, named and read; safetensors only, no code of theirs is run.

A checkpoint is a Hugging Face folder (Qwen2.5-VL, or InternVL in its `-hf` form), or a model stored by this project that is the
base model: without adapters, motion tokens, MPE and CSE, which need more than a chat carries.

Paper: the local baselines of Table II.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError
from transformers import AutoModelForImageTextToText, GenerationConfig

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.processors import PROCESSORS, load_chat_processor
from proprio_mllm.backends.protocol import BackendSetupError

__all__ = ["Checkpoint", "Loaded", "find_checkpoint", "load_checkpoint"]

#: Files that decide replies; larger ones than this enter the fingerprint by sample.
_SUFFIXES: Final = frozenset({".json", ".jinja", ".model", ".safetensors", ".txt"})
_WHOLE_BYTES: Final = 16 * 2**20
_SAMPLES, _SAMPLE_BYTES = 16, 2**16


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Where the parts of a checkpoint are.

    Attributes:
        folder: as configured.
        weights: folder of `config.json` and the weights.
        processing: folder of tokenizer, image processor and chat template.
        model_type: as `config.json` names it.
    """

    folder: Path
    weights: Path
    processing: Path
    model_type: str

    def fingerprint(self) -> str:
        """16 hexadecimal digits that change with the checkpoint.

        SHA-256 over name, size and content of every configuration, tokenizer and weight file; of files above 16 MiB only 16
        pieces of 64 KiB, evenly spread, are read, so that a checkpoint of many gigabytes is named at once. Weights that differ
        nowhere in those pieces would go unseen: training changes all of them, an edit of a single tensor may not.
        """
        digest = hashlib.sha256()
        for folder in dict.fromkeys((self.weights, self.processing)):
            for path in sorted(p for p in folder.iterdir() if p.suffix in _SUFFIXES and p.is_file()):
                size = path.stat().st_size
                digest.update(f"{path.name}\0{size}\0".encode())
                with path.open("rb") as file:
                    if size <= _WHOLE_BYTES:
                        digest.update(file.read())
                        continue
                    for index in range(_SAMPLES):
                        file.seek((size - _SAMPLE_BYTES) * index // (_SAMPLES - 1))
                        digest.update(file.read(_SAMPLE_BYTES))
        return digest.hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Loaded:
    """A checkpoint in memory.

    Attributes:
        model: in evaluation mode, on its device; decodes greedily, whatever sampling its files recommend.
        processor: text and pictures to tensors.
        ends: ids of the tokens that end a reply.
        pad: id that fills rows up.
        context: most tokens of prompt and reply together.
        vocabulary: entries of the logits.
    """

    model: Any
    processor: Any
    ends: tuple[int, ...]
    pad: int
    context: int
    vocabulary: int


def find_checkpoint(folder: str) -> Checkpoint:
    """The parts of the checkpoint in a folder.

    Raises:
        BackendSetupError: when it is not one that can answer.
    """
    path = Path(folder).expanduser()
    config = _read_config(path, path)
    weights = processing = path
    if "format" in config and "model_type" not in config:
        _require_base(path, config)
        weights, processing = path / "vlm", path / "processor"
        config = _read_config(path, weights)
    found = str(config.get("model_type"))
    if found not in PROCESSORS:
        hint = "; the -hf form of this checkpoint can" if found == "internvl_chat" else ""
        raise BackendSetupError(f"{path}: model type {found!r} cannot answer; allowed: {', '.join(PROCESSORS)}{hint}")
    if not any(weights.glob("*.safetensors")):
        raise BackendSetupError(f"{path}: no weights there; expected *.safetensors, the only format that is read")
    return Checkpoint(path, weights, processing, found)


def _read_config(folder: Path, part: Path) -> dict[str, Any]:
    try:
        config = json.loads((part / "config.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BackendSetupError(
            f"{folder}: not a checkpoint: {part.name}/config.json cannot be read ({type(error).__name__}); "
            "expected a folder with config.json, *.safetensors, tokenizer and chat template"
        ) from error
    if not isinstance(config, dict):
        raise BackendSetupError(f"{folder}: {part.name}/config.json is not a JSON object")
    return config


def _require_base(folder: Path, stored: dict[str, Any]) -> None:
    """Refuses a model stored by this project whose replies depend on more than text and pictures."""
    config = stored.get("config", {})
    more = [f"adapter {name!r}" for name in stored.get("adapters", ())]
    mode = config.get("mpe", {}).get("mode")
    more += [f"mpe.mode={mode}"] if mode != "mrope" else []
    more += ["cse.enabled=true"] if config.get("cse", {}).get("enabled") else []
    more += ["proprioception=true"] if config.get("proprioception") else []
    more += ["no weights of its own"] if not (folder / "vlm").is_dir() else []
    if more:
        raise BackendSetupError(
            f"{folder}: a stored model with {', '.join(more)} plans as planner kind `mllm`; a chat can ask a base model "
            "alone (mpe.mode=mrope, cse.enabled=false, no adapters), such as weights/tiny/base"
        )


def load_checkpoint(checkpoint: Checkpoint, cfg: BackendConfig) -> Loaded:
    """Reads a checkpoint; `auto` takes the GPU when there is one, and there the checkpoint's type, else float32.

    Raises:
        BackendSetupError: when the device is not there or the checkpoint cannot be used.
    """
    device = cfg.device if cfg.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise BackendSetupError(f"device {cfg.device!r}: no CUDA device here; allowed: auto, cpu")
    dtype: Any = cfg.dtype if cfg.dtype != "auto" or device.startswith("cuda") else "float32"
    dtype = dtype if dtype == "auto" else getattr(torch, dtype)
    try:
        processor = load_chat_processor(checkpoint.processing, checkpoint.model_type)
        read: Any = AutoModelForImageTextToText.from_pretrained(
            str(checkpoint.weights),
            dtype=dtype,
            device_map=device,
            local_files_only=True,
            use_safetensors=True,
            trust_remote_code=False,
            output_loading_info=True,
        )
        model, info = read
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise BackendSetupError(f"{checkpoint.folder}: cannot be read as {checkpoint.model_type}: {error}") from error
    if info["missing_keys"]:
        raise BackendSetupError(f"{checkpoint.folder}: weights lack {sorted(info['missing_keys'])[:3]}")
    own = model.generation_config.eos_token_id
    named = [own] if isinstance(own, int) else list(own or ())
    ends = tuple(dict.fromkeys(one for one in (*named, processor.tokenizer.eos_token_id) if one is not None))
    if not ends:
        raise BackendSetupError(f"{checkpoint.folder}: names no token that ends a reply (eos_token)")
    pad = processor.tokenizer.pad_token_id
    pad = ends[0] if pad is None else pad
    model.generation_config = GenerationConfig(eos_token_id=list(ends), pad_token_id=pad)
    text = model.config.get_text_config()
    return Loaded(model.eval(), processor, ends, pad, int(text.max_position_embeddings), int(text.vocab_size))
