"""Frozen configuration of the model: vision-language backbone, MPE, CSE, point maps, LoRA and the motion tokenizer.

`configs/model/*.yaml` fill these classes; the field names are the paper's where the paper has a name. Every ablation is one
switch: `mpe.mode=mrope` and `cse.enabled=false` together give the base model, bit for bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from configs.schema.checks import require

MpeMode = Literal["mrope", "rope_sign", "rope_sign_raw", "rope_radial", "embed_sign", "rope_sign+embed"]
#: Frames of proprioception in shards and observations.
LONGEST_WINDOW = 64
CentroidName = Literal["body", "arms", "reach"]


@dataclass(frozen=True)
class MpeConfig:
    """Motion-based position embedding.

    Attributes:
        mode: `mrope` is Qwen's own embedding; the others are defined in `proprio_mllm.model.mpe`.
        centroid: which point of the robot's body is projected into the image, see `proprio_mllm.model.geometry`.
    """

    mode: MpeMode = "rope_sign"
    centroid: CentroidName = "reach"


@dataclass(frozen=True)
class CseConfig:
    """Cross-spatial encoder T = MLP(F2D + Phi(F3D)).

    Attributes:
        enabled: off leaves the visual tokens as they are.
        source: which part of the point map's output is F3D.
        literal: the equation as printed; otherwise F2D is added as a residual and the MLP's last layer starts at zero.
        frame: frame of the points: the camera's, or the robot's pelvis heading frame through its own kinematics.
        hidden: width of the MLP; 0 takes the language model's.
        named: whether words behind a picture get F3D of what they name (`proprio_mllm.model.cse.NamedPoints`); for models
            whose visual tokens are tied to names by stage `base`.
    """

    enabled: bool = True
    source: Literal["tokens", "points", "both"] = "both"
    literal: bool = False
    frame: Literal["camera", "pelvis"] = "pelvis"
    hidden: int = 0
    named: bool = False


@dataclass(frozen=True)
class PointMapConfig:
    """Point-map encoder that gives F3D.

    Attributes:
        encoder: `sim` is our small encoder, `named` one that also knows what is where, `cut3r` the user's checkout and weights,
            `oracle` the true depth, `none` nothing.
        width: channels of the attention of `sim` and `named`.
        depth: its blocks.
        checkout: CUT3R's source folder.
        checkpoint: CUT3R's weights.
        sha256: the checksum the user expects of `checkpoint`.
        trust_checkpoint: allows unrestricted unpickling of `checkpoint` when the restricted reader refuses it.
        size: side of the image that CUT3R sees, pixels.
    """

    encoder: Literal["sim", "named", "cut3r", "oracle", "none"] = "sim"
    width: int = 96
    depth: int = 2
    checkout: str | None = None
    checkpoint: str | None = None
    sha256: str | None = None
    trust_checkpoint: bool = False
    size: int = 432


@dataclass(frozen=True)
class LoraConfig:
    """Low-rank adapters of the language model's projections."""

    rank: int = 16
    alpha: int = 32
    dropout: float = 0.0

    def __post_init__(self) -> None:
        require(self.rank > 0, f"rank {self.rank} must be positive")
        require(0.0 <= self.dropout < 1.0, f"dropout {self.dropout} outside [0, 1)")


@dataclass(frozen=True)
class MotionTokenizerConfig:
    """Motion VQ-VAE (paper, stage 1).

    Attributes:
        features: motion features per frame.
        window: frames of a proprioception window.
        quantizer: `vq` (paper), or beyond it `rvq` (residual, one token per codebook and step) or `fsq` (a rounded grid).
        codes: codebook size; with `fsq` it has to be the product of the levels.
        stages: codebooks of `rvq`.
        levels: values per dimension of `fsq`.
        code_dim: width of a code.
        width: convolution channels.
        depth: residual blocks per resolution.
        dilation: growth of the dilation inside a residual stack.
        down: number of halvings of the frame rate; 2 gives one token per four frames.
        alpha: weight of the codebook loss.
        beta: weight of the commitment loss.
        velocity_weight: weight of the smooth-L1 loss on frame differences.
        update: moving averages (`ema`, alpha's term is then only logged) or gradients of the codebook loss (`grad`).
        ema_decay: decay of the moving averages.
        reset_below: codes whose moving count falls below this are replaced by vectors of the batch.
    """

    features: int = 48
    window: int = 64
    quantizer: Literal["vq", "rvq", "fsq"] = "vq"
    codes: int = 512
    stages: int = 2
    levels: tuple[int, ...] = (8, 8, 8)
    code_dim: int = 128
    width: int = 128
    depth: int = 2
    dilation: int = 3
    down: int = 2
    alpha: float = 1.0
    beta: float = 0.02
    velocity_weight: float = 0.5
    update: Literal["ema", "grad"] = "ema"
    ema_decay: float = 0.99
    reset_below: float = 1.0

    def __post_init__(self) -> None:
        for name in ("features", "window", "codes", "stages", "code_dim", "width", "depth", "dilation", "down"):
            require(getattr(self, name) > 0, f"{name} {getattr(self, name)} must be positive")
        require(self.window <= LONGEST_WINDOW, f"window {self.window} must be at most {LONGEST_WINDOW}, what shards hold")
        require(self.window % self.stride == 0, f"window {self.window} must be a multiple of {self.stride}")

        grid = math.prod(self.levels)
        require(
            self.quantizer != "fsq" or grid == self.codes, f"levels {self.levels} make {grid} codes, not codes {self.codes}"
        )
        require(min(self.levels, default=0) > 2, f"levels {self.levels} must each be at least 3")
        require(
            self.quantizer == "vq" or self.update == "ema", f"update {self.update!r} is for quantizer vq, not {self.quantizer}"
        )

    @property
    def stride(self) -> int:
        """Frames per step of the encoding."""
        return 2**self.down

    @property
    def codebooks(self) -> int:
        """Tokens per step of the encoding."""
        return self.stages if self.quantizer == "rvq" else 1

    @property
    def vocabulary(self) -> int:
        """Different motion tokens."""
        return self.codes * self.codebooks


@dataclass(frozen=True)
class TinyTextConfig:
    """Numbers of a language model trained from scratch."""

    hidden: int = 256
    layers: int = 5
    heads: int = 8
    kv_heads: int = 4
    intermediate: int = 512
    max_positions: int = 4096
    rope_theta: float = 10000.0

    def __post_init__(self) -> None:
        require(self.hidden % self.heads == 0, f"hidden {self.hidden} must be a multiple of heads {self.heads}")
        require(self.heads % self.kv_heads == 0, f"heads {self.heads} must be a multiple of kv_heads {self.kv_heads}")
        require((self.hidden // self.heads) % 16 == 0, f"head size {self.hidden // self.heads} must be a multiple of 16")


@dataclass(frozen=True)
class TinyVisionConfig:
    """Numbers of a vision tower trained from scratch."""

    hidden: int = 192
    depth: int = 4
    heads: int = 6
    intermediate: int = 512

    def __post_init__(self) -> None:
        require(self.hidden % self.heads == 0, f"hidden {self.hidden} must be a multiple of heads {self.heads}")


@dataclass(frozen=True)
class ModelConfig:
    """Everything that makes one model.

    Attributes:
        name: name of the configuration.
        weights: folder or hub name of a Qwen2.5-VL checkpoint; None builds `text` and `vision` from scratch.
        image_size: side of the square image, pixels, a multiple of 28.
        prompt: `terse` for models that learn the format, `full` for models that read English.
        vocab_size: rows of the tokenizer trained on the project's text; ignored with `weights`.
        dtype: parameter type.
        four_bit: whether the frozen layers of the language model are held in 4 bits (QLoRA's NF4, doubly quantised); with
            `weights`, and the extra `four-bit`.
        sees: whether a picture stands before each answer of an episode (`proprio_mllm.model.wording`).
        proprioception: whether motion tokens do too.
        places: whether an answer says where the thing is that it is about, if that is in view, before its step; learnt from
            what the point map makes of the picture.
    """

    name: str
    weights: str | None = None
    image_size: int = 112
    prompt: Literal["terse", "full"] = "terse"
    sees: bool = False
    vocab_size: int = 1400
    dtype: Literal["float32", "bfloat16"] = "float32"
    four_bit: bool = False
    proprioception: bool = True
    places: bool = False
    text: TinyTextConfig = field(default_factory=TinyTextConfig)
    vision: TinyVisionConfig = field(default_factory=TinyVisionConfig)
    lora: LoraConfig = field(default_factory=LoraConfig)
    mpe: MpeConfig = field(default_factory=MpeConfig)
    cse: CseConfig = field(default_factory=CseConfig)
    point_map: PointMapConfig = field(default_factory=PointMapConfig)
    motion: MotionTokenizerConfig = field(default_factory=MotionTokenizerConfig)

    def __post_init__(self) -> None:
        require(not self.four_bit or self.weights is not None, "four_bit is for released weights: set weights")
        require(self.image_size > 0 and self.image_size % 28 == 0, f"image_size {self.image_size} must be a multiple of 28")
        require(
            not (self.cse.enabled and self.point_map.encoder == "none"),
            "cse.enabled needs a point map: point_map.encoder 'none' is not allowed; allowed: sim, named, cut3r, oracle",
        )
        require(
            not (self.cse.enabled and self.point_map.encoder == "oracle" and self.cse.source != "points"),
            f"point_map.encoder 'oracle' has points only: cse.source {self.cse.source!r} is not allowed; allowed: points",
        )
