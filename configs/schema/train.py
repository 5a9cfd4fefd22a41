"""Frozen configuration of training: the loop's numbers per stage, and what each stage reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from configs.schema.checks import require
from configs.schema.data import DataConfig
from configs.schema.execution import Execution
from configs.schema.model import ModelConfig

#: Training tasks have 2^31 seeds, a million for each seed of a run.
LARGEST_SEED = 2000
StageName = Literal["all", "data", "collect", "words", "practice", "base", "pointmap", "tokenizer", "alignment", "selu"]
Variant = Literal["full", "no_mpe", "no_cse", "no_mpe_cse", "no_proprio"]


def _require_shares(cfg: object, *names: str) -> None:
    for name in names:
        require(0.0 <= getattr(cfg, name) <= 1.0, f"{name} {getattr(cfg, name)} outside [0, 1]")


def _require_positive(cfg: object, *names: str) -> None:
    for name in names:
        require(getattr(cfg, name) > 0, f"{name} {getattr(cfg, name)} must be positive")


@dataclass(frozen=True)
class LoopConfig:
    """One run of the training loop.

    Attributes:
        steps: optimiser steps.
        batch: examples per step, of all processes together.
        lr: peak learning rate, reached after `warmup` steps, then a cosine down to a tenth of it.
        warmup: steps of linear warm-up.
        weight_decay: on matrices only.
        clip: largest gradient norm. Below the norm of every kind of batch, all kinds pull alike, whatever their losses.
        checkpoint_every: steps between checkpoints.
        log_every: steps between log lines.
        minutes: time budget over all resumed parts; the schedule then follows whichever of steps and time is further, so
            results depend on the machine's speed. 0 means steps alone count.
        precision: `bf16` computes under autocast, parameters stay as they are.
        optimizer: `adamw`, or `muon` for the weights of linear layers with AdamW for the rest.
        adam_share: with `muon`, AdamW's learning rate over Muon's.
    """

    steps: int
    batch: int
    lr: float
    warmup: int = 50
    weight_decay: float = 0.01
    clip: float = 1.0
    checkpoint_every: int = 200
    log_every: int = 20
    minutes: float = 0.0
    precision: Literal["fp32", "bf16"] = "fp32"
    optimizer: Literal["adamw", "muon"] = "adamw"
    adam_share: float = 1.0

    def __post_init__(self) -> None:
        _require_positive(self, "steps", "batch", "checkpoint_every", "log_every")
        _require_positive(self, "lr", "adam_share")
        require(self.minutes >= 0.0, f"minutes {self.minutes} must not be negative")


@dataclass(frozen=True)
class BaseConfig:
    """`stage=base`: dense pretraining, then grounding, listing and planning together.

    Attributes:
        dense: loop of the dense, name-tied pretraining of the vision tower.
        joint: loop of the mixed batches.
        questions: question and answer pairs packed per image.
        plan_share: share of the joint batches that are of episodes: decisions with pictures, episodes in words, questions
            about the states of objects.
        text_share: share of episodes in words among them.
        judge_share: share of questions about states, and of phrases, among the others.
        dense_weight: weight of the dense loss on the joint batches' views.
    """

    dense: LoopConfig
    joint: LoopConfig
    questions: int = 8
    plan_share: float = 0.7
    text_share: float = 0.5
    judge_share: float = 0.15
    dense_weight: float = 0.5

    def __post_init__(self) -> None:
        _require_shares(self, "plan_share", "text_share", "judge_share")
        require(self.questions > 0, f"questions {self.questions} must be positive")


@dataclass(frozen=True)
class WordsConfig:
    """`stage=words`: whole episodes in words.

    Attributes:
        loop: an example is an episode.
        reading: weight of predicting what is read, the log and the blocks before answers, beside the answers.
        logged: share of episodes from the simulator; the others are of the text world.
    """

    loop: LoopConfig
    reading: float = 1.0
    logged: float = 0.2

    def __post_init__(self) -> None:
        _require_shares(self, "reading", "logged")


@dataclass(frozen=True)
class PracticeConfig:
    """`stage=practice`: the words model acts on training tasks, the teacher answers, both worlds are learnt from.

    Attributes:
        loop: an example is an episode.
        episodes: how many the model acts in.
        teacher_share: share of their steps that the teacher takes itself.
        own_share: share of what is learnt that is from those episodes.
        logged: share that is from the teacher's own episodes in the simulator; the rest is of the text world.
        workers: processes.
        student: the stored model that acts in place of the words model (what alignment or selu made). With pretrained weights,
            which have no words model, None leaves such episodes out.
    """

    loop: LoopConfig
    episodes: int = 300
    teacher_share: float = 0.25
    own_share: float = 0.2
    logged: float = 0.2
    workers: int = 2
    student: str | None = None

    def __post_init__(self) -> None:
        _require_shares(self, "teacher_share", "own_share", "logged")
        require(self.own_share + self.logged <= 1.0, f"own_share {self.own_share} and logged {self.logged} exceed 1 together")
        _require_positive(self, "episodes", "workers")


@dataclass(frozen=True)
class AlignmentConfig:
    """`stage=alignment`: motion with text, then with images, then all together.

    Attributes:
        text: loop of phase 2a-i, motion and text; vision and CSE frozen.
        image: loop of phase 2a-ii, motion and image; vision frozen.
        joint: loop of phase 2b; rows, LoRA, CSE and merger train.
        whole: whether the language model's own layers train in phase 2b too, as is of use where they were not pretrained.
        plan_share: share of a phase's batches that are of episodes: decisions with pictures and motion, episodes in words.
        text_share: share of episodes in words among them.
        judge_share: share of questions about the states of objects among the decisions.
        questions: body-relative questions packed per image.
        mask: share of motion tokens hidden in masked motion.
        go_back: how far the language model's layers are taken back at the end to what they were before stage `base`, or before
            this one where they were pretrained; a share (`proprio_mllm.model.building.go_back`).
    """

    text: LoopConfig
    image: LoopConfig
    joint: LoopConfig
    plan_share: float = 0.7
    text_share: float = 0.3
    judge_share: float = 0.15
    questions: int = 6
    mask: float = 0.3
    go_back: float = 0.0
    whole: bool = False

    def __post_init__(self) -> None:
        _require_shares(self, "plan_share", "text_share", "judge_share", "mask", "go_back")
        require(self.questions > 0, f"questions {self.questions} must be positive")


@dataclass(frozen=True)
class SeluConfig:
    """`stage=selu`: rounds of rollouts, critic and actor fine-tuning.

    Attributes:
        rounds: number of rounds.
        episodes: rollouts per round.
        temperature: of the actor while exploring.
        critic: loop of the critic's fine-tuning.
        actor: loop of the actor's fine-tuning.
        truth: `audit` only reports the critic against the simulator; `oracle` lets the simulator judge (a labelled ablation).
        replay_share: share of the batches that is replayed against forgetting: decisions of lessons, for the critic
            questions about lessons too.
        per_class: most kept trajectories per verb, robot and category.
        precision: share of the critic's yes to held-out questions that must be right for its yes to count; 0 counts it always.
        rollouts: who runs them.
    """

    critic: LoopConfig
    actor: LoopConfig
    rounds: int = 2
    episodes: int = 60
    temperature: float = 0.7
    truth: Literal["audit", "oracle"] = "audit"
    replay_share: float = 0.5
    per_class: int = 40
    precision: float = 0.85
    rollouts: Execution = field(default_factory=Execution)

    def __post_init__(self) -> None:
        _require_shares(self, "replay_share", "precision")
        _require_positive(self, "rounds", "episodes", "per_class")
        require(self.temperature > 0.0, f"temperature {self.temperature} must be positive: exploration needs draws")


@dataclass(frozen=True)
class CollectStageConfig:
    """What the simulator writes for training.

    Attributes:
        views: posed views.
        lessons: episodes of the rules, with mistakes among their steps.
        foreseen: whether what is out of reach is foreseen in lessons and practice: the right step of a decision with a picture
            is then the one that the rules would come to after the failure.
        workers: processes.
    """

    views: int = 6000
    lessons: int = 500
    foreseen: bool = False
    workers: int = 2


@dataclass(frozen=True)
class LoggerConfig:
    """Where metrics go besides the CSV file and the terminal.

    Attributes:
        wandb: `offline` writes a local W&B run, `online` sends it to your account, `disabled` leaves W&B out.
        project: W&B project.
    """

    wandb: Literal["offline", "online", "disabled"] = "offline"
    project: str = "proprio-mllm"


@dataclass(frozen=True)
class TrainConfig:
    """Everything `train.py` needs.

    Attributes:
        stage: what to run.
        variant: which ablation of the model. `no_proprio` trains on the same data without motion tokens, MPE and CSE: what the
            stages bring without proprioception.
        model: the model.
        words: `stage=words`.
        practice: `stage=practice`.
        output: folder of all outputs.
        seed: seed of data order, initial weights and rollouts.
        shared_seed: seed of the stages before alignment, whose output is there; alignment or selu then runs with `seed`, in a
            folder of its own. None: `seed`.
        threads: torch threads; 0 leaves torch's choice.
        micro_batches: into how many each step's batch is cut, to save memory or to be shared by processes; a multiple of these.
        recompute: whether the backbone's activations are computed again in the backward pass instead of being kept.
        shard: whether processes share the backbone's frozen layers (FSDP2); with released weights (`model.weights`) alone.
        keep_spatial: whether what the frozen point map makes of an image is kept in the user's cache folder and computed once.
        footprint: prints what alignment costs, on GPUs that reach so many TFLOP/s each, and trains nothing; None trains.
        overwrite: run a stage from its start although its output is current, or a checkpoint is there.
        release: folder the finished stages are exported to, None for no export.
        given: folder of released weights, such as `weights`: the language model of words and practice, the base model, the
            point map and the motion tokenizer are taken from there, where it has them, in place of being trained. None trains
            everything.
        given_alignment: what alignment makes of the variant's model from there: it is `taken` as it is, so that `stage=selu`
            goes on from a released one, or `continued` by phase `joint` alone, where a variant or a seed that is not there goes
            on from the full model, without the variant's parts. None trains it from `base`.
        resume: continue an interrupted stage from its checkpoint.
        data: where motions come from, and what is kept of them.
        collect: what the simulator writes before training.
    """

    stage: StageName
    variant: Variant
    model: ModelConfig
    base: BaseConfig
    pointmap: LoopConfig
    tokenizer: LoopConfig
    alignment: AlignmentConfig
    selu: SeluConfig
    words: WordsConfig
    practice: PracticeConfig
    data: DataConfig = field(default_factory=DataConfig)
    collect: CollectStageConfig = field(default_factory=CollectStageConfig)
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    output: str = "outputs"
    seed: int = 0
    shared_seed: int | None = None
    threads: int = 2
    micro_batches: int = 1
    recompute: bool = False
    shard: bool = False
    keep_spatial: bool = False
    footprint: float | None = None
    overwrite: bool = False
    release: str | None = None
    given: str | None = None
    given_alignment: Literal["taken", "continued"] | None = None
    resume: bool = True

    def __post_init__(self) -> None:
        require(0 <= self.seed <= LARGEST_SEED, f"seed {self.seed} outside [0, {LARGEST_SEED}]")
        require(
            self.shared_seed is None or (0 <= self.shared_seed <= LARGEST_SEED and self.stage in ("alignment", "selu")),
            f"shared_seed {self.shared_seed} with stage={self.stage}: allowed is up to {LARGEST_SEED}, with alignment or selu",
        )
        require(
            self.footprint is None or self.footprint > 0.0, f"footprint {self.footprint} must be positive: TFLOP/s of a GPU"
        )
        require(
            self.model.weights is None or self.model.point_map.encoder != "named",
            "point_map.encoder 'named' learns the words of stage practice, which model.weights leave out; allowed: sim, cut3r",
        )
        require(
            not self.model.places or self.model.point_map.encoder == "named",
            f"model.places is learnt from point_map.encoder 'named', not {self.model.point_map.encoder!r}",
        )
        require(not self.shard or self.model.weights is not None, "shard=true shares a frozen backbone; set model.weights")
        require(
            not (self.alignment.whole and (self.shard or self.model.four_bit)),
            "alignment.whole=true trains the language model's layers, which shard=true and model.four_bit=true freeze",
        )
        require(not (self.shard and self.model.four_bit), "shard=true cannot share layers of 4 bits: leave out one of the two")
        require(
            self.given_alignment is None or self.given is not None,
            f"given_alignment={self.given_alignment} takes from `given`, which is not set",
        )
        require(self.micro_batches >= 1, f"micro_batches {self.micro_batches} must be at least 1")
