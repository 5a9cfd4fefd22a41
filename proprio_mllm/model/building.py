"""Builds, saves and loads models: one path for the model trained from scratch and for released weights.

Order: backbone (config or weights), then the vocabulary, then the wrapper, then adapters when a phase asks for them. A stored
model is a folder, safetensors and JSON only:

    config.json            the ModelConfig, format version, adapter names
    processor/             tokenizer, image processor, chat template
    vlm/                   backbone weights (only when it was built from scratch), or, after `share_backbone`, those of another
                           stored model, which config.json names with their hash
    heads.safetensors      cse, mpe, point map, and the merger (what else training moved) of a backbone that is stored elsewhere
    adapters/<name>/       LoRA and motion rows, peft's format
    motion/                the motion tokenizer, when one was given
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import torch
from peft import LoraConfig as PeftLoraConfig
from peft import PeftModel, get_peft_model
from torch import Tensor, nn
from transformers import BitsAndBytesConfig, Qwen2_5_VLForConditionalGeneration

from configs.schema.model import ModelConfig
from configs.validate import build
from data.files import file_hash, new_folder, read_json
from proprio_mllm.model.backbone import PatchEmbedding, backbone_config
from proprio_mllm.model.groups import adapter_of, group_of
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.named_map import NamedPointMap
from proprio_mllm.model.point_map import OraclePointMap, SimPointMap
from proprio_mllm.model.processor import ProprioProcessor, load_processor, make_processor
from proprio_mllm.model.tensors import check_files, file_hashes, read_tensors, write_tensors
from proprio_mllm.model.tokenizer import train_tokenizer
from proprio_mllm.model.vocabulary import add_motion_tokens

_FORMAT = 2
_WEIGHTS, _HEADS = "model.safetensors", "heads.safetensors"
LORA_TARGETS = r".*language_model\.layers\..*(q|k|v|o|gate|up|down)_proj"


def build_processor(cfg: ModelConfig, texts: Sequence[str] = (), whole_words: Sequence[str] = ()) -> ProprioProcessor:
    """The processor of the configured weights, or one around a tokenizer trained on `texts`; motion tokens included.

    Args:
        cfg: model configuration.
        texts: training text of the tokenizer; needed without `cfg.weights`.
        whole_words: words of one token each, such as object type names.

    Raises:
        ValueError: without weights and without texts.
    """
    if cfg.weights is not None:
        processor = load_processor(cfg.weights, cfg.image_size)
    elif texts:
        processor = make_processor(train_tokenizer(texts, cfg.vocab_size, whole_words), cfg.image_size)
    else:
        raise ValueError(f"model {cfg.name!r} has no weights: texts are needed to train its tokenizer")
    add_motion_tokens(processor.tokenizer, cfg.motion.vocabulary)
    return processor


#: Point-map encoders that stage `pointmap` trains.
TRAINED_HERE: Final = ("sim", "named")


def build_point_map(cfg: ModelConfig) -> nn.Module | None:
    """The configured point-map encoder, untrained; None for `none`."""
    point_map = cfg.point_map
    if point_map.encoder == "sim":
        return SimPointMap(point_map.width, point_map.depth)
    if point_map.encoder == "named":
        return NamedPointMap(point_map.width, point_map.depth, cfg.text.hidden, cfg.image_size)
    if point_map.encoder == "oracle":
        return OraclePointMap()
    if point_map.encoder == "cut3r":
        from proprio_mllm.model.cut3r import Cut3rPointMap  # imports the user's checkout

        return Cut3rPointMap.from_config(point_map)
    return None


def _extend(vlm: Qwen2_5_VLForConditionalGeneration, size: int) -> None:
    embeddings: Any = vlm.get_input_embeddings()
    rows = int(embeddings.num_embeddings)
    if size > rows:  # released matrices have spare rows; resizing to the tokenizer could shrink them
        vlm.resize_token_embeddings(size, pad_to_multiple_of=64)


def build_model(
    cfg: ModelConfig, processor: ProprioProcessor, seed: int = 0, point_map: nn.Module | None = None
) -> ProprioMLLM:
    """A model without adapters.

    Args:
        cfg: model configuration.
        processor: from `build_processor`.
        seed: of the initial weights of everything that is not loaded.
        point_map: a trained encoder; by default a fresh one of the configured kind.
    """
    dtype = getattr(torch, cfg.dtype)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if cfg.weights is not None:
            quantised = _four_bits(dtype) if cfg.four_bit else {}
            vlm = Qwen2_5_VLForConditionalGeneration.from_pretrained(cfg.weights, dtype=dtype, **quantised)
        else:
            vlm = Qwen2_5_VLForConditionalGeneration(backbone_config(cfg, processor)).to(dtype)
        visual: Any = vlm.model.visual
        visual.patch_embed = PatchEmbedding(visual.patch_embed.proj)
        _extend(vlm, len(processor.tokenizer))
        motion_ids = add_motion_tokens(processor.tokenizer, cfg.motion.vocabulary)
        if point_map is None and cfg.cse.enabled:
            point_map = build_point_map(cfg)
        return ProprioMLLM(vlm, cfg, processor, motion_ids, point_map)


def _four_bits(dtype: torch.dtype) -> dict[str, Any]:
    """What makes Transformers hold the language model's layers in 4 bits; they have to be read on the device that uses them.

    Raises:
        ValueError: without bitsandbytes.
    """
    if importlib.util.find_spec("bitsandbytes") is None:
        raise ValueError("model.four_bit=true needs bitsandbytes: pip install 'proprio-mllm[four-bit]'")
    quantisation = BitsAndBytesConfig(
        load_in_4bit=True,
        bnb_4bit_quant_type="nf4",
        bnb_4bit_use_double_quant=True,
        bnb_4bit_compute_dtype=dtype,
        llm_int8_skip_modules=["model.visual", "lm_head"],
    )
    device = torch.cuda.current_device() if torch.cuda.is_available() else "cpu"
    return {"quantization_config": quantisation, "device_map": {"": device}}


def add_adapter(model: ProprioMLLM, name: str = "default", start: str | None = None) -> None:
    """Adds LoRA weights and trainable motion rows under a name and makes them the active adapter.

    The first adapter freezes the whole backbone; choose what trains afterwards with `groups.train_only`.

    Args:
        model: the model.
        name: name of the new adapter.
        start: adapter whose weights the new one starts from; None starts as the backbone.

    Raises:
        ValueError: when the name is taken, or `start` does not exist.
    """
    if start is not None:
        use_adapter(model, start)
    tied = model.core.config.tie_word_embeddings
    rows: Any = list(model.motion_ids) if tied else {"embed_tokens": list(model.motion_ids), "lm_head": list(model.motion_ids)}
    lora = PeftLoraConfig(
        r=model.cfg.lora.rank,
        lora_alpha=model.cfg.lora.alpha,
        lora_dropout=model.cfg.lora.dropout,
        target_modules=LORA_TARGETS,
        trainable_token_indices=rows,
    )
    if isinstance(model.vlm, PeftModel):
        if name in model.vlm.peft_config:
            raise ValueError(f"adapter {name!r} exists; present: {', '.join(model.vlm.peft_config)}")
        model.vlm.add_adapter(name, lora)
    else:
        heads = {k: p.requires_grad for k, p in model.named_parameters() if not k.startswith("vlm.")}
        with quiet_peft():
            model.vlm = get_peft_model(model.core, lora, adapter_name=name)  # type: ignore[arg-type]  # peft's stub wants PreTrainedModel
        for key, parameter in model.named_parameters():
            if key in heads:
                parameter.requires_grad_(heads[key])
    use_adapter(model, name)
    if start is not None:
        parameters = dict(model.named_parameters())
        with torch.no_grad():
            for key, parameter in parameters.items():
                if adapter_of(key) == name:
                    parameter.copy_(parameters[f".{start}".join(key.rsplit(f".{name}", 1))])


@contextmanager
def quiet_peft() -> Iterator[None]:
    """PEFT asks Transformers by a name that has a newer one, which is nothing that a user could mend."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="`is_gradient_checkpointing` is deprecated", category=FutureWarning)
        yield


def merge_adapter(model: ProprioMLLM) -> None:
    """Folds the active adapter into the backbone's weights and drops all adapters.

    Raises:
        ValueError: when there is no adapter.
    """
    if not isinstance(model.vlm, PeftModel):
        raise ValueError("no adapter to merge")
    vlm: Any = model.vlm.merge_and_unload()
    model.vlm = vlm


def go_back(model: ProprioMLLM, before: ProprioMLLM | None, share: float) -> None:
    """Takes the layers of the language model, adapters included, part of the way back to what they were before they saw.

    What was learnt since stays mostly, and less of what was known is lost (Wortsman et al., 2022).

    Args:
        model: the model; its rows, vision and heads stay.
        before: a model of the same layers without adapters; None when the layers have only learnt through adapters.
        share: how far, between 0 and 1.
    """
    known = {} if before is None else dict(before.core.named_parameters())
    with torch.no_grad():
        for name, weights in model.core.named_parameters():
            if ".lora_B." in name:
                weights.mul_(1.0 - share)
            elif known and group_of(name) == "lm":
                weights.lerp_(known[name.replace(".base_layer", "")].to(weights), share)


def use_adapter(model: ProprioMLLM, name: str) -> None:
    """Makes an adapter the active one.

    Raises:
        ValueError: when there is no such adapter.
    """
    present = list(model.vlm.peft_config) if isinstance(model.vlm, PeftModel) else []
    if name not in present:
        raise ValueError(f"no adapter {name!r}; present: {', '.join(present) or 'none'}")
    assert isinstance(model.vlm, PeftModel)
    model.vlm.set_adapter(name)


def backbone_state(model: ProprioMLLM) -> dict[str, Tensor]:
    """Weights of the backbone under their plain names, adapters left out."""
    state: dict[str, Tensor] = {}
    for name, tensor in model.core.state_dict().items():
        if "lora_" in name or "trainable_tokens_" in name:
            continue
        plain = name.replace(".token_adapter.", ".").replace(".base_layer.", ".")
        state[plain] = tensor
    return state


def _head_prefixes(cfg: ModelConfig) -> tuple[str, ...]:
    """Parts that are stored in `heads.safetensors`; CUT3R's weights stay where the user has them, as their licence asks."""
    return ("cse.", "mpe.") if cfg.point_map.encoder == "cut3r" else ("cse.", "mpe.", "point_map.")


def save_model(model: ProprioMLLM, folder: str | Path, motion: MotionTokenizer | None = None) -> None:
    """Writes a model so that `load_model` gives the same one; the folder appears at once, complete.

    Args:
        model: the model.
        folder: replaced when it exists.
        motion: the motion tokenizer the prompts were made with.
    """
    folder = Path(folder)
    with new_folder(folder) as work:
        model.processor.save_pretrained(str(work / "processor"))
        state = backbone_state(model)
        heads = {k: v for k, v in model.state_dict().items() if k.startswith(_head_prefixes(model.cfg))}
        if model.cfg.weights is None:
            (work / "vlm").mkdir()
            if model.core.config.tie_word_embeddings:
                state.pop("lm_head.weight", None)
            write_tensors({k: v.contiguous() for k, v in state.items()}, work / "vlm" / _WEIGHTS)
            model.core.config.save_pretrained(str(work / "vlm"))
        else:
            heads |= {f"backbone.{k}": v for k, v in state.items() if ".visual.merger." in k}
        write_tensors({k: v.clone().contiguous() for k, v in heads.items()}, work / _HEADS)
        adapters: list[str] = []
        if isinstance(model.vlm, PeftModel):
            adapters = list(model.vlm.peft_config)
            for name in adapters:
                model.vlm.save_pretrained(str(work / "adapters"), selected_adapters=[name], save_embedding_layers=False)
                if name == "default":  # peft writes this one beside the others
                    (work / "adapters" / name).mkdir(exist_ok=True)
                    for file in ("adapter_config.json", "adapter_model.safetensors"):
                        os.replace(work / "adapters" / file, work / "adapters" / name / file)
            for stray in (work / "adapters").rglob("README.md"):
                stray.unlink()
        if motion is not None:
            motion.save(work / "motion")
        write_stored(work, {"format": _FORMAT, "config": dataclasses.asdict(model.cfg), "adapters": adapters})


def write_stored(folder: Path, stored: Mapping[str, Any]) -> None:
    """Writes a stored model's `config.json`, with the checksums of its files as they are now."""
    text = json.dumps({**stored, "files": file_hashes(folder)}, indent=2)
    (folder / "config.json").write_text(text + "\n", encoding="utf-8")


def stored_config(folder: str | Path) -> ModelConfig:
    """The configuration of a stored model, read without its weights.

    Raises:
        ValueError: on an unknown format.
    """
    return build(ModelConfig, _stored(Path(folder))["config"], "model")


def _stored(folder: Path) -> dict[str, Any]:
    stored: dict[str, Any] = read_json(folder / "config.json")
    if stored.get("format") != _FORMAT:
        raise ValueError(f"{folder}: model format {stored.get('format')!r}; this version reads {_FORMAT}")
    return stored


def load_model(
    folder: str | Path, adapter: str | None = None, trainable: bool = False, cfg: ModelConfig | None = None
) -> ProprioMLLM:
    """Reads what `save_model` wrote, in evaluation mode.

    Args:
        folder: the stored model.
        adapter: the adapter to make active; by default the first, if any.
        trainable: whether adapters keep their gradients.
        cfg: the stored configuration with parts switched off, whose weights are left out; by default all of it.

    Raises:
        DamagedFileError: when a file of it is not what was written.
        ValueError: on an unknown format or adapter, or when a shared backbone is missing or another one.
    """
    folder = Path(folder)
    stored = _stored(folder)
    check_files(folder, stored.get("files", {}))
    cfg = cfg or build(ModelConfig, stored["config"], "model")
    processor = load_processor(folder / "processor", cfg.image_size)
    local = dataclasses.replace(cfg, weights=str(_backbone(folder, stored))) if cfg.weights is None else cfg
    model = build_model(local, processor)
    model.cfg = cfg
    heads = read_tensors(folder / _HEADS)
    merger = {k.removeprefix("backbone."): v for k, v in heads.items() if k.startswith("backbone.")}
    model.core.load_state_dict(merger, strict=False)
    own = {k: v for k, v in heads.items() if not k.startswith("backbone.")}
    missing = [k for k in model.load_state_dict(own, strict=False).missing_keys if k.startswith(_head_prefixes(cfg))]
    if missing:
        raise ValueError(f"{folder}/heads.safetensors lacks {missing[:3]}")
    names: list[str] = stored["adapters"]
    for name in names:
        path = str(folder / "adapters" / name)
        if isinstance(model.vlm, PeftModel):
            model.vlm.load_adapter(path, name, is_trainable=trainable)
        else:
            with quiet_peft():
                model.vlm = PeftModel.from_pretrained(model.core, path, adapter_name=name, is_trainable=trainable)
    if adapter is not None or names:
        use_adapter(model, adapter if adapter is not None else names[0])
        if not trainable:
            model.vlm.requires_grad_(False)
    return model.eval()


def share_backbone(folder: str | Path, owner: str | Path) -> None:
    """Lets a stored model read its backbone from another stored model's; the tensors that differ stay with its heads.

    Args:
        folder: the stored model; its `vlm` folder is removed.
        owner: the stored model whose backbone has the same architecture; must stay where it is, seen from `folder`.

    Raises:
        ValueError: when the backbones have different tensors.
    """
    folder, owner = Path(folder), Path(owner)
    ours, theirs = (read_tensors(path / "vlm" / _WEIGHTS) for path in (folder, owner))
    if {k: v.shape for k, v in ours.items()} != {k: v.shape for k, v in theirs.items()}:
        raise ValueError(f"{folder} and {owner} have backbones of different architectures")
    moved = {f"backbone.{k}": v for k, v in ours.items() if not torch.equal(v, theirs[k])}
    write_tensors({**read_tensors(folder / _HEADS), **moved}, folder / _HEADS)
    stored = read_json(folder / "config.json")
    path = owner / "vlm"
    stored["backbone"] = {"folder": os.path.relpath(path, folder), "sha256": file_hash(path / _WEIGHTS)}
    shutil.rmtree(folder / "vlm")
    write_stored(folder, stored)


def _backbone(folder: Path, stored: dict[str, Any]) -> Path:
    """Where a stored model's backbone is."""
    if "backbone" not in stored:
        return folder / "vlm"
    path = folder / stored["backbone"]["folder"]
    if not (path / _WEIGHTS).is_file():
        raise ValueError(f"{folder} shares the backbone of {path}, which is not there: keep the two folders side by side")
    if file_hash(path / _WEIGHTS) != stored["backbone"]["sha256"]:
        raise ValueError(f"{path}/{_WEIGHTS} is not the backbone that {folder} was trained on: export both again")
    return path


def load_motion(folder: str | Path) -> MotionTokenizer | None:
    """The motion tokenizer stored with a model, or None."""
    path = Path(folder) / "motion"
    return MotionTokenizer.load(path) if path.is_dir() else None
