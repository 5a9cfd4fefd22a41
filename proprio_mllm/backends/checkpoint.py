"""Checkpoints on disk that answer chats: found, named and read; safetensors only, no code of theirs is run.

A checkpoint is a Hugging Face folder (Qwen2.5-VL, or InternVL in its `-hf` form), or a model stored by this project that is the
base model: without adapters, motion tokens, MPE and CSE, which need more than a chat carries.

Their processors are read without the video halves: `AutoProcessor` builds those too, which needs torchvision, and picks another
image code where torchvision is there; the classes below need Pillow alone and give the same pixels everywhere.

Paper: the local baselines of Table II, Qwen2.5-VL and InternVL2.5.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import torch
from jinja2.exceptions import TemplateError
from safetensors import SafetensorError
from transformers import AutoModelForImageTextToText, GenerationConfig, PreTrainedTokenizerBase
from transformers.models.got_ocr2.image_processing_pil_got_ocr2 import GotOcr2ImageProcessorPil
from transformers.models.internvl.processing_internvl import InternVLProcessor
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil
from transformers.processing_utils import ProcessorMixin

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.protocol import BackendSetupError
from proprio_mllm.model.processor import ProprioProcessor

#: Files that decide replies; larger ones than this enter the fingerprint by sample.
_SUFFIXES: Final = frozenset({".json", ".jinja", ".model", ".safetensors", ".txt"})
_WHOLE_BYTES: Final = 16 * 2**20
_SAMPLES, _SAMPLE_BYTES = 16, 2**16


class QwenImages(ProprioProcessor):
    """Qwen2.5-VL's processor; the chat template has to be the checkpoint's own."""

    def __init__(
        self,
        image_processor: Qwen2VLImageProcessorPil | None = None,
        tokenizer: PreTrainedTokenizerBase | None = None,
        chat_template: str | None = None,
        **kwargs: object,
    ) -> None:
        super().__init__(image_processor, tokenizer, _template(chat_template, tokenizer), **kwargs)


class InternVLImages(InternVLProcessor):
    """InternVL's processor: pictures become tiles of one size and, from two tiles on, a small view of the whole."""

    # The base class finds its parts in this signature, so the name `video_processor` must not stand in it.
    def __init__(
        self,
        image_processor: GotOcr2ImageProcessorPil | None = None,
        tokenizer: PreTrainedTokenizerBase | None = None,
        image_seq_length: int = 256,
        chat_template: str | None = None,
        **kwargs: object,
    ) -> None:
        names = ("start_image_token", "end_image_token", "context_image_token")
        missing = [name for name in names if getattr(tokenizer, name, None) is None]
        if missing:
            raise ValueError(f"its tokenizer does not name {', '.join(missing)}")
        tokens: Any = tokenizer
        self.image_seq_length = image_seq_length
        self.start_image_token, self.start_image_token_id = tokens.start_image_token, tokens.start_image_token_id
        self.end_image_token, self.end_image_token_id = tokens.end_image_token, tokens.end_image_token_id
        self.image_token, self.image_token_id = tokens.context_image_token, tokens.context_image_token_id
        ProcessorMixin.__init__(self, image_processor, tokenizer, chat_template=_template(chat_template, tokenizer))

    def __call__(self, images: Any = None, text: Any = None, videos: Any = None, **kwargs: Any) -> Any:
        """Ids and tiles, the tiles of all pictures in order. What the base class adds is the order of pictures and videos."""
        made = ProcessorMixin.__call__(self, images=images, text=text, **kwargs)
        made.pop("num_patches", None)
        return made


_PROCESSORS: Final[Mapping[str, type[ProcessorMixin]]] = MappingProxyType(
    {"qwen2_5_vl": QwenImages, "internvl": InternVLImages}
)


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
    if found not in _PROCESSORS:
        hint = "; the -hf form of this checkpoint can" if found == "internvl_chat" else ""
        raise BackendSetupError(f"{path}: model type {found!r} cannot answer; allowed: {', '.join(_PROCESSORS)}{hint}")
    if not any(weights.glob("*.safetensors")):
        raise BackendSetupError(f"{path}: no weights there; expected *.safetensors, the only format that is read")
    return Checkpoint(path, weights, processing, found)


def load_checkpoint(checkpoint: Checkpoint, cfg: BackendConfig) -> Loaded:
    """Reads a checkpoint; `auto` takes the GPU when there is one, and there the checkpoint's type, else float32.

    Raises:
        BackendSetupError: when the device is not there or the checkpoint cannot be used.
    """
    device = cfg.device if cfg.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise BackendSetupError(f"device {cfg.device!r}: no CUDA device here; allowed: auto, cpu")
    dtype = cfg.dtype if cfg.dtype != "auto" or device.startswith("cuda") else "float32"
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


def load_chat_processor(folder: Path, model_type: str) -> Any:
    """The processor of a model type stored in a folder, in its old layout or the new one.

    Raises:
        ValueError: when it has no chat template, or one that cannot write a question, or lacks tokens for pictures.
        OSError: when files are missing.
    """
    kind = _PROCESSORS[model_type]
    processor: Any = kind.from_pretrained(str(folder), local_files_only=True, trust_remote_code=False, backend="pil")
    chat = [{"role": "user", "content": [{"type": "text", "text": "look"}]}]
    try:
        written = processor.apply_chat_template(chat, tokenize=False)
    except TemplateError as error:
        raise ValueError(f"its chat template cannot write a question: {error}") from error
    tokenizer = processor.tokenizer
    added = tokenizer("")["input_ids"]
    if added not in ([], [tokenizer.bos_token_id]):
        raise ValueError(f"its tokenizer adds {tokenizer.convert_ids_to_tokens(added)} to every text; allowed: a start token")
    if added and not written.startswith(tokenizer.bos_token):
        # InternVL2.5's tokenizer writes the start token, not its template. Control tokens in texts can be told from those of
        # the template only where the template writes them all.
        processor.chat_template = "{{ bos_token }}" + processor.chat_template
    return processor


def _template(own: str | None, tokenizer: PreTrainedTokenizerBase | None) -> str:
    """The processor's chat template, or the tokenizer's, where older checkpoints keep it."""
    template = own or getattr(tokenizer, "chat_template", None)
    if not isinstance(template, str):
        raise ValueError("it has no chat template, which says how a conversation is written")
    return template


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
    mode = config.get("mpe", {}).get("mode")
    more = [f"adapter {name!r}" for name in stored.get("adapters", ())]
    more += [f"mpe.mode={mode}"] if mode != "mrope" else []
    more += ["cse.enabled=true"] if config.get("cse", {}).get("enabled") else []
    more += ["proprioception=true"] if config.get("proprioception") else []
    more += ["no weights of its own"] if not (folder / "vlm").is_dir() else []
    if more:
        raise BackendSetupError(
            f"{folder}: a stored model with {', '.join(more)} plans as planner kind `mllm`; a chat can ask a base model "
            "alone (mpe.mode=mrope, cse.enabled=false, no adapters), such as weights/tiny/base"
        )
