"""What stage `alignment` costs, before it costs it: `python train.py model=qwen2_5_vl_7b budget=gpu footprint=400`.

Nothing is loaded and nothing computed: the model is built on the meta device, where tensors have shapes and no content, and one
pass forward and backward through two layers of its language model says what a layer computes and keeps. The rest is arithmetic.
An example is a decision with a picture, its log in text, and motion, the longest that stage 2 trains on.

Left out: CUT3R, whose weights are the user's; the vision tower's attention; what the allocator and the kernels' workspaces take
(some GB on a GPU). The language model's attention is counted as the plain kernel keeps it, which fused kernels do not.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import torch
from peft import LoraConfig as PeftLoraConfig
from peft import get_peft_model
from torch import nn
from torch.utils.flop_counter import FlopCounterMode
from transformers import Qwen2_5_VLForConditionalGeneration

from configs.schema.model import ModelConfig
from configs.schema.train import TrainConfig
from proprio_mllm.model.backbone import backbone_config, given_config
from proprio_mllm.model.building import LORA_TARGETS, TRAINED_HERE, build_point_map, build_processor, quiet_peft
from proprio_mllm.model.cse import CrossSpatialEncoder
from proprio_mllm.model.named_map import NamedPointMap
from proprio_mllm.model.vocabulary import motion_tokens
from proprio_mllm.training.pipeline import variant_model

#: Text tokens of a decision whose log is read anew, with Qwen's tokenizer (`python -m benchmarks.episode_tokens`).
_TEXT_TOKENS: Final = 253
#: Width of CUT3R's decoder, the tokens that CSE reads.
_CUT3R_TOKENS: Final = 768
#: Bytes per trained parameter besides its weight: gradient and AdamW's two moments, float32.
_TRAINING_BYTES: Final = 12
#: Bytes per weight in 4 bits, with the doubly quantised scales of its block of 64.
_FOUR_BIT_BYTES: Final = 0.516
_GPUS: Final = (1, 8, 64)


@dataclass(frozen=True, slots=True)
class Part:
    """Parameters of a part of the model, how many of them train, and bytes of one weight."""

    parameters: int
    trained: int
    width: float

    @property
    def bytes(self) -> float:
        """Of its weights, gradients and optimiser."""
        return self.parameters * self.width + self.trained * _TRAINING_BYTES


@dataclass(frozen=True, slots=True)
class Footprint:
    """Costs of stage 2b, the joint phase.

    Attributes:
        parts: by name.
        tokens: of an example: visual, text, motion.
        reading: FLOP of the language model for an example, forward and backward; with `recompute`, once more forward.
        seeing: FLOP of the frozen vision tower, forward, and of merger and CSE, forward and backward.
        activations: bytes that an example keeps for the backward pass.
        shared: bytes of the frozen layers, which `shard=true` spreads.
        cfg: what is trained.
    """

    parts: Mapping[str, Part]
    tokens: tuple[int, int, int]
    reading: float
    seeing: float
    activations: int
    shared: int
    cfg: TrainConfig

    @property
    def flop(self) -> float:
        """Of an example."""
        return self.reading + self.seeing

    def gigabytes(self, gpus: int) -> float:
        """Memory per GPU: weights, gradients, optimiser and activations of a micro-batch."""
        loop = self.cfg.alignment.joint
        cut = max(self.cfg.micro_batches, gpus)
        shared = self.shared * (1 - 1 / gpus) if self.cfg.shard else 0.0
        fixed = sum(part.bytes for part in self.parts.values()) - shared
        return (fixed + self.activations * max(1, loop.batch // cut)) / 1e9

    def steps_per_hour(self, gpus: int, tflops: float) -> float:
        """Steps per hour where each GPU reaches so many TFLOP/s and waits for none."""
        per_gpu = self.flop * max(1.0, self.cfg.alignment.joint.batch / gpus)
        return 3600.0 * tflops * 1e12 / per_gpu

    def text(self, tflops: float) -> str:
        """For people."""
        cfg = self.cfg
        lines = [f"{cfg.model.name}, variant {cfg.variant}: alignment, joint phase", ""]
        lines.append(f"{'part':<28}{'parameters':>16}{'trained':>14}{'GB':>8}")
        for name, part in self.parts.items():
            lines.append(f"{name:<28}{part.parameters:>16,}{part.trained:>14,}{part.bytes / 1e9:>8.2f}")
        visual, words, motion = self.tokens
        batch = cfg.alignment.joint.batch
        lines += [
            "",
            f"tokens of an example: {visual} visual, {words} text, {motion} motion; {batch * sum(self.tokens):,} of a step",
            f"an example: {self.flop / 1e12:.2f} TFLOP, {self.activations / 1e9:.2f} GB of activations"
            + (" (recomputed)" if cfg.recompute else ""),
            "",
            f"{'GPUs':>6}{'examples each':>16}{'GB each':>10}{'steps/h':>10}{'hours of text, image, joint':>30}",
        ]
        for gpus in _GPUS:
            loops = (cfg.alignment.text, cfg.alignment.image, cfg.alignment.joint)
            hours = [loop.steps / self.steps_per_hour(gpus, tflops) for loop in loops]
            each = max(1, batch // max(cfg.micro_batches, gpus))
            lines.append(
                f"{gpus:>6}{each:>16}{self.gigabytes(gpus):>10.1f}{self.steps_per_hour(gpus, tflops):>10.0f}"
                f"{', '.join(f'{one:.1f}' for one in hours):>30}"
            )
        lines += [
            "",
            f"at {tflops:g} TFLOP/s reached per GPU, all examples as long as this one; by arithmetic, nothing was run",
        ]
        return "\n".join(lines) + "\n"


def footprint(cfg: TrainConfig) -> Footprint:
    """The costs of stage 2b of a configuration.

    Raises:
        ValueError: when the shape of `model.weights` is not known.
    """
    model = variant_model(cfg.model, cfg.variant)
    full = _config(model)
    with torch.device("meta"):
        vlm: Any = Qwen2_5_VLForConditionalGeneration(full)
        heads = _heads(model, full.text_config.hidden_size)
    text, seen = full.text_config, full.vision_config
    vocabulary = len(motion_tokens(model.motion.vocabulary)) if model.proprioception else 0
    rows = vocabulary * text.hidden_size * (1 if full.tie_word_embeddings else 2)
    width = getattr(torch, model.dtype).itemsize
    blocks, merger, vision = (_count(one) for one in (vlm.model.visual.blocks, vlm.model.visual.merger, vlm.model.visual))
    layers = _count(vlm.model.language_model.layers)
    lora = sum(
        model.lora.rank * (one.in_features + one.out_features)
        for name, one in vlm.named_modules()
        if isinstance(one, nn.Linear) and re.fullmatch(LORA_TARGETS, name)
    )
    parts = {
        "language model's layers": Part(layers, 0, _FOUR_BIT_BYTES if model.four_bit else width),
        "vision tower": Part(vision - merger, 0, width),
        "merger": Part(merger, merger, width),
        "tables and last norm": Part(_count(vlm) - layers - vision, 0, width),
        "LoRA": Part(lora, lora, 4),
        "rows of motion tokens": Part(rows, rows, 4),
        **{name: Part(_count(head), 0 if name == "point map" else _count(head), 4) for name, head in heads.items()},
    }
    side = model.image_size // (seen.patch_size * seen.spatial_merge_size)
    tokens = (side * side, _TEXT_TOKENS, _motion_tokens(model))
    trained = merger + (parts["cross-spatial encoder"].trained if model.cse.enabled else 0)
    seeing = tokens[0] * (2.0 * blocks * seen.spatial_merge_size**2 + 6.0 * trained)
    once, both, kept = _layer(model, sum(tokens))
    count, inputs = text.num_hidden_layers, sum(tokens) * text.hidden_size * width
    reading = count * (both + (once if cfg.recompute else 0.0))
    activations = count * inputs + kept if cfg.recompute else count * kept
    return Footprint(parts, tokens, reading, seeing, activations, (blocks + layers) * width, cfg)


def _config(model: ModelConfig, **text: Any) -> Any:  # transformers' type says too little of its parts
    if model.weights is not None:
        return given_config(model.weights, **text)
    config = backbone_config(model, build_processor(model, ["a"]))
    for name, value in ({"vocab_size": -(-model.vocab_size // 64) * 64} | text).items():
        setattr(config.text_config, name, value)
    return config


def _heads(model: ModelConfig, hidden: int) -> dict[str, nn.Module]:
    heads: dict[str, nn.Module] = {}
    if model.cse.enabled:
        ours = build_point_map(model) if model.point_map.encoder in TRAINED_HERE else None
        channels: Any = _CUT3R_TOKENS if ours is None else ours.token_dim
        heads["cross-spatial encoder"] = CrossSpatialEncoder(model.cse, hidden, channels, isinstance(ours, NamedPointMap))
        if ours is not None:
            heads["point map"] = ours
    return heads


def _motion_tokens(model: ModelConfig) -> int:
    if not model.proprioception:
        return 0
    stages = model.motion.stages if model.motion.quantizer == "rvq" else 1
    return model.motion.window // 2**model.motion.down * stages + 2


def _layer(model: ModelConfig, length: int) -> tuple[float, float, int]:
    """Of one layer with its adapter: FLOP forward, FLOP forward and backward, and bytes kept between them."""
    found: list[tuple[float, float, int]] = []
    for layers in (1, 2):
        config = _config(model, num_hidden_layers=layers)
        with torch.device("meta"), quiet_peft():
            whole = Qwen2_5_VLForConditionalGeneration(config).to(getattr(torch, model.dtype))
            lora = PeftLoraConfig(r=model.lora.rank, lora_dropout=model.lora.dropout, target_modules=LORA_TARGETS)
            core: Any = get_peft_model(whole, lora).get_base_model()  # type: ignore[arg-type]  # peft's stub wants PreTrainedModel
        core.train()
        found.append(_measured(core.model.language_model, length))
    (once, both, kept), (more_once, more_both, more_kept) = found
    return more_once - once, more_both - both, more_kept - kept


def _measured(language_model: nn.Module, length: int) -> tuple[float, float, int]:
    """FLOP forward, FLOP forward and backward, and bytes that are kept between them, of an example on the meta device."""
    any_model: Any = language_model
    embedded = torch.empty(1, length, any_model.config.hidden_size, dtype=any_model.dtype, device="meta", requires_grad=True)
    places = torch.zeros(3, 1, length, dtype=torch.long, device="meta")
    own = {one.untyped_storage()._cdata for one in language_model.parameters()}
    kept: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        if storage._cdata not in own:
            kept[storage._cdata] = storage  # held, so that no other takes its place
        return tensor

    counter = FlopCounterMode(display=False)
    with counter, torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        out = any_model(inputs_embeds=embedded, position_ids=places, use_cache=False)[0]
        once = float(counter.get_total_flops())
        out.sum().backward()
    return once, float(counter.get_total_flops()), sum(storage.nbytes() for storage in kept.values())


def _count(module: nn.Module) -> int:
    return sum(one.numel() for one in module.parameters())
