"""Runs the training stages in order, each skipped while its output is current.

base needs views, exercises, demos and clips (for the tokenizer's text); corrections need base; pointmap needs views; tokenizer
needs clips and the windows of views and demos; alignment needs base, corrections, pointmap and tokenizer; selu needs alignment.
The variants of the ablation share everything up to alignment and then train with the same budget.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np

from configs.schema.model import ModelConfig
from configs.schema.train import LoopConfig, TrainConfig, Variant
from data.shards import ShardReader, config_hash, decode_motion
from proprio_mllm.model.building import add_adapter, build_model, build_point_map, build_processor, load_model, save_model
from proprio_mllm.model.dense import DenseHead
from proprio_mllm.model.groups import train_only
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.alignment import PHASES, AlignmentData, AlignmentObjective, body_state_accuracy
from proprio_mllm.training.base import DenseObjective, JointObjective, exercise_accuracy, grounding_accuracy, plan_accuracy
from proprio_mllm.training.geometry_stage import PointMapObjective, point_map_error
from proprio_mllm.training.loop import Objective, run_loop
from proprio_mllm.training.metrics import MetricWriter
from proprio_mllm.training.motion_stage import FEATURE_BIAS, MotionObjective, MotionWindows, tokenizer_metrics
from proprio_mllm.training.paths import StagePaths, finish, finished_key, stage_key
from proprio_mllm.training.reconstruction import render
from proprio_mllm.training.rollouts import CorrectionRequest
from proprio_mllm.training.sources import BODY_RELATIVE, GROUNDING, Clips, Demos, Exercises, Judgements, Views, shard_hash
from proprio_mllm.training.text import corpus, start_from_words, whole_words

__all__ = ["NEEDS", "STAGES", "Pipeline", "StageError", "variant_model"]

logger = logging.getLogger(__name__)

Metrics = dict[str, float]

#: Raised when what a stage trains on changes in code, so that older output is not taken for current.
RECIPES: Final[Mapping[str, int]] = {"base": 3, "tokenizer": 2, "alignment": 5, "selu": 4}
#: Stages whose current output a stage starts from.
NEEDS: Final[Mapping[str, tuple[str, ...]]] = {
    "corrections": ("base",),
    "alignment": ("base", "corrections", "pointmap", "tokenizer"),
    "selu": ("alignment",),
}


class StageError(RuntimeError):
    """A stage that cannot start; the message names the command to run first."""


def variant_model(model: ModelConfig, variant: str) -> ModelConfig:
    """The model's configuration with the ablated parts switched off.

    Raises:
        ValueError: on an unknown variant.
    """
    if variant not in get_args(Variant):
        raise ValueError(f"variant {variant!r}; allowed: {', '.join(get_args(Variant))}")
    none = variant == "no_proprio"
    mpe = dataclasses.replace(model.mpe, mode="mrope") if none or "mpe" in variant else model.mpe
    cse = dataclasses.replace(model.cse, enabled=False) if none or "cse" in variant else model.cse
    return dataclasses.replace(model, mpe=mpe, cse=cse, proprioception=model.proprioception and not none)


def base_model_config(model: ModelConfig) -> ModelConfig:
    """The plain backbone: no MPE, no CSE, no proprioception."""
    return variant_model(model, "no_proprio")


class Pipeline:
    """The stages of one configuration.

    Args:
        cfg: configuration.
        collect_rollouts: runs an actor in the simulator and writes `rollouts` shards; given by the entry point, because
            training does not know the simulator.
        command: the command line, stored with every finished stage.
        collect_corrections: lets a model act in the simulator and writes the expert's corrections; given likewise.
    """

    def __init__(
        self,
        cfg: TrainConfig,
        collect_rollouts: Callable[..., Any] | None = None,
        command: str = "",
        collect_corrections: Callable[..., Any] | None = None,
    ) -> None:
        self.cfg = cfg
        self.command = command
        self.paths = StagePaths(cfg)
        self._collect, self._correct = collect_rollouts, collect_corrections
        self._taken: Metrics = {}  # steps of each run of the current stage: a time budget may end it early

    # ---- what a stage depends on --------------------------------------------------------------------------------------------

    def key(self, name: str) -> str:
        """Key of a stage's output under the present configuration and inputs."""
        cfg, shards = self.cfg, self.paths.shards
        if name == "base":
            # no stage before it, and no motion in its prompts: of the tokenizer it has the words alone
            plain = dataclasses.asdict(base_model_config(cfg.model)) | {"motion": cfg.model.motion.vocabulary}
            inputs = {kind: shard_hash(shards(kind)) for kind in ("views", "exercises", "demos", "clips")}
            wanted = {"base": dataclasses.asdict(cfg.base), "model": plain, "recipe": RECIPES["base"]}
            return stage_key(wanted, cfg.seed, inputs)
        if name == "corrections":
            return stage_key(dict(self.corrections), cfg.seed, {"base": self.key("base")})
        if name == "pointmap":
            wanted = {"loop": _loop_values(cfg.pointmap), "map": dataclasses.asdict(cfg.model.point_map)}
            return stage_key(wanted, cfg.seed, {"views": shard_hash(shards("views"))})
        if name == "tokenizer":
            inputs = {kind: shard_hash(shards(kind)) for kind in ("clips", "views", "demos")}
            wanted = {
                "loop": _loop_values(cfg.tokenizer), "motion": dataclasses.asdict(cfg.model.motion),
                "bias": FEATURE_BIAS.tolist(), "recipe": RECIPES["tokenizer"],
            }  # fmt: skip
            return stage_key(wanted, cfg.seed, inputs)
        model = dataclasses.asdict(variant_model(cfg.model, cfg.variant))
        if name == "alignment":
            inputs = {stage: self.key(stage) for stage in NEEDS["alignment"]} | {"judgements": shard_hash(shards("judgements"))}
            wanted = {"alignment": dataclasses.asdict(cfg.alignment), "model": model, "recipe": RECIPES["alignment"]}
            return stage_key(wanted, cfg.seed, inputs)
        if name == "selu":
            wanted = {"selu": dataclasses.asdict(cfg.selu), "recipe": RECIPES["selu"]}
            return stage_key(wanted, cfg.seed, {"alignment": self.key("alignment")})
        raise ValueError(f"stage {name!r} has no key; allowed: {', '.join(STAGES)}")

    def run(self, name: str) -> Metrics | None:
        """Runs a stage unless its output is current; returns its metrics, None when it was skipped.

        `seconds` is the time of this run; those of a loop, which may have been resumed, count its earlier runs too.
        """
        folder, key = self.paths.stage(name), self.key(name)
        if finished_key(folder) == key and not self.cfg.overwrite:
            logger.info("%s: current, skipped (%s)", name, folder)
            return None
        for needed in NEEDS.get(name, ()):
            if finished_key(self.paths.stage(needed)) != self.key(needed):
                raise StageError(f"stage {name!r} needs the output of {needed!r}; run `python train.py stage={needed}` first")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "done.json").unlink(missing_ok=True)  # from here on the folder's content is no finished stage's
        began = time.monotonic()
        self._taken.clear()
        metrics = STAGES[name](self, folder, key) | self._taken
        metrics["seconds"] = round(time.monotonic() - began, 1)
        finish(folder, key, metrics, self.command)
        logger.info("%s: %s", name, ", ".join(f"{k} {v:.4g}" for k, v in metrics.items()))
        return metrics

    def loop(self, objective: Objective, cfg: LoopConfig, folder: Path) -> None:
        """Runs one objective with this configuration's seed and logger."""
        folder.mkdir(parents=True, exist_ok=True)
        writer = MetricWriter(folder, objective.name, self.cfg.logger, {"key": objective.key})
        try:
            result = run_loop(objective, cfg, folder, self.cfg.seed, writer, self.cfg.resume and not self.cfg.overwrite)
            self._taken |= {
                f"{objective.name}/steps": float(result.steps),
                f"{objective.name}/seconds": round(result.seconds, 1),
            }
        finally:
            writer.close()

    def demos(self, model: ModelConfig) -> Demos:
        """Demonstrations, and the corrections after them where there are any."""
        more = [self.paths.shards("corrections")] if "corrections" in self.corrections else []
        return Demos(self.paths.shards("demos"), model, more)

    def exercises(self, model: ModelConfig, demos: Demos) -> Exercises:
        """Exercises in words, and the corrections in words among them where there are any."""
        kind = "corrections_in_words"
        corrected = self.paths.shards(kind) if kind in self.corrections else None
        return Exercises(self.paths.shards("exercises"), model, demos, corrected)

    @property
    def corrections(self) -> Mapping[str, str]:
        """Key of each folder of corrections; none without a base model of this configuration's own to correct."""
        cfg = self.cfg.corrections
        if self.cfg.model.weights is not None:
            return {}
        counts = {"corrections": {"episodes": cfg.episodes}, "corrections_in_words": {"exercises": cfg.exercises}}
        inputs = {"base": self.key("base")}
        return {
            name: stage_key({**count, "expert_share": cfg.expert_share}, self.cfg.seed, inputs)
            for name, count in counts.items()
            if all(count.values())
        }

    # ---- stages -------------------------------------------------------------------------------------------------------------

    def _base(self, folder: Path, key: str) -> Metrics:
        cfg, plain = self.cfg, base_model_config(self.cfg.model)
        if cfg.model.weights is not None:
            logger.info("base: %s has pretrained weights, nothing to do", cfg.model.name)
            return {}
        views, demos = Views(self.paths.shards("views"), plain), Demos(self.paths.shards("demos"), plain)
        clips = Clips(self.paths.shards("clips"))
        exercises = Exercises(self.paths.shards("exercises"), plain, demos)
        texts = corpus(plain, views, demos, exercises, clips, cfg.seed)
        model = build_model(plain, build_processor(plain, texts, whole_words(views)), cfg.seed)
        start_from_words(model, views.type_names)
        head = _seeded(lambda: DenseHead(model, views.type_names), cfg.seed)
        model.requires_grad_(True)
        dense = DenseObjective(model, head, views, cfg.base, f"{key}/dense")
        self._train_dense(dense, model, head, folder / "dense")
        model.requires_grad_(True)
        joint = JointObjective(model, head, views, demos, exercises, clips, cfg.base, f"{key}/joint")
        self.loop(joint, cfg.base.joint, folder / "joint")
        save_model(model.eval(), self.paths.model("base"))
        asked = grounding_accuracy(model, views, (*GROUNDING, *BODY_RELATIVE))
        return {**asked, **plan_accuracy(model, demos), **exercise_accuracy(model, exercises)}

    def _corrections(self, folder: Path, key: str) -> Metrics:
        del key
        if not self.corrections:
            logger.info("corrections: none asked for, or no base model of this project's own")
            return {}
        cfg, metrics = self.cfg.corrections, Metrics()
        if "corrections" in self.corrections:
            reader = self._corrected("corrections", "demos", cfg.episodes)
            notes = [json.loads(text) for text in reader.column("privileged")]
            acted = zip(notes, reader.column("target"), strict=True)
            own = [note["executed"] == target for note, target in acted if note["origin"] == "student"]
            metrics |= {
                "episodes": float(cfg.episodes),
                "kept_episodes": float(len(set(reader.column("episode")))),
                "steps": float(len(notes)),
                "student_steps": float(len(own)),
                "student_as_expert": float(np.mean(own)) if own else 0.0,
            }
        if "corrections_in_words" in self.corrections:
            reader = self._corrected("corrections_in_words", "exercises", cfg.exercises)
            metrics |= {"exercises": float(cfg.exercises), "exercise_steps": float(len(reader))}
        return metrics

    def _corrected(self, name: str, kind: Literal["demos", "exercises"], episodes: int) -> ShardReader:
        """The shards of one folder of corrections, written by the collector where they are missing."""
        if self._correct is None:
            raise ValueError("stage 'corrections' needs the simulator: no collector was given")
        cfg, shards = self.cfg.corrections, self.paths.shards(name)
        if self.cfg.overwrite:  # the base model may be another one under the same key
            shutil.rmtree(shards, ignore_errors=True)
        written = config_hash({"key": self.corrections[name]})
        size, seed = self.cfg.model.image_size, self.cfg.seed
        request = CorrectionRequest(self.paths.model("base"), shards, kind, episodes, seed, cfg.expert_share, size, written)
        self._correct(request, workers=cfg.workers)
        return ShardReader(shards, kind)

    def _train_dense(self, objective: DenseObjective, model: ProprioMLLM, head: DenseHead, folder: Path) -> None:
        chosen = {id(p) for p in train_only(model, ("vision", "merger", "rows"))} | {id(p) for p in head.parameters()}
        for parameter in objective.module.parameters():
            parameter.requires_grad_(id(parameter) in chosen)
        self.loop(objective, self.cfg.base.dense, folder)

    def _pointmap(self, folder: Path, key: str) -> Metrics:
        encoder = _seeded(lambda: build_point_map(self.cfg.model), self.cfg.seed)
        if encoder is None or not list(encoder.parameters()):
            return {}
        views = Views(self.paths.shards("views"), self.cfg.model)
        if self.cfg.model.point_map.encoder == "sim":
            encoder.requires_grad_(True)
            self.loop(PointMapObjective(encoder, views, key), self.cfg.pointmap, folder)
        return point_map_error(encoder, views)

    def _tokenizer(self, folder: Path, key: str) -> Metrics:
        motion = self.cfg.model.motion
        clips = Clips(self.paths.shards("clips"))
        recorded = []
        for kind in ("views", "demos"):
            rows = [decode_motion(row)[-motion.window :] for row in ShardReader(self.paths.shards(kind), kind).column("motion")]
            recorded.append(np.stack(rows) if rows else np.zeros((0, motion.window, motion.features), dtype=np.float32))
        windows = MotionWindows(clips, recorded, motion.window)
        tokenizer = _seeded(lambda: MotionTokenizer(motion), self.cfg.seed)
        tokenizer.set_normalisation(*windows.statistics())
        self.loop(MotionObjective(tokenizer, windows, key), self.cfg.tokenizer, folder)
        tokenizer.eval().save(self.paths.model("tokenizer"))
        render(tokenizer, clips, folder / "pictures")
        return tokenizer_metrics(tokenizer, windows)

    def _start_alignment(self) -> ProprioMLLM:
        """The base model with this variant's MPE and CSE and the trained point map."""
        cfg = variant_model(self.cfg.model, self.cfg.variant)
        point_map = None
        if cfg.cse.enabled:
            point_map = _seeded(lambda: build_point_map(cfg), self.cfg.seed)
            if point_map is not None and cfg.point_map.encoder == "sim":
                _load_trained(point_map, self.paths.stage("pointmap") / "checkpoint" / "model.safetensors")
        if cfg.weights is None:
            base = load_model(self.paths.model("base"))
            local = dataclasses.replace(cfg, weights=str(self.paths.model("base") / "vlm"))
            model = build_model(local, base.processor, self.cfg.seed, point_map)
            model.cfg = cfg
        else:
            model = build_model(cfg, build_processor(cfg), self.cfg.seed, point_map)
        _seeded(lambda: add_adapter(model), self.cfg.seed)
        return model

    def _alignment(self, folder: Path, key: str) -> Metrics:
        model = self._start_alignment()
        tokenizer = MotionTokenizer.load(self.paths.model("tokenizer"))
        views, demos = Views(self.paths.shards("views"), model.cfg), self.demos(model.cfg)
        exercises = self.exercises(model.cfg, demos)
        judgements = Judgements(self.paths.shards("judgements"), model.cfg)
        clips = Clips(self.paths.shards("clips"))
        data = AlignmentData(model, tokenizer, clips, views, demos, exercises, judgements, self.cfg.alignment)
        # without proprioception there is nothing to align apart
        wanted = PHASES if model.cfg.proprioception else ("joint",)
        loops = {phase: getattr(self.cfg.alignment, phase) for phase in wanted}
        for phase, loop in loops.items():
            train_only(model, PHASES[phase].groups)
            self.loop(AlignmentObjective(model, data, phase, self.cfg.alignment, f"{key}/{phase}"), loop, folder / phase)
        read = tokenizer if model.cfg.proprioception else None
        save_model(model.eval(), self.paths.model("alignment"), read)
        asked = grounding_accuracy(model, views, (*GROUNDING, *BODY_RELATIVE), tokens=read)
        felt = body_state_accuracy(model, demos, read) if read is not None else {}
        return {**asked, **felt, **plan_accuracy(model, demos, read), **exercise_accuracy(model, exercises, data.bodies)}

    def _selu(self, folder: Path, key: str) -> Metrics:
        from proprio_mllm.training.selu import run_selu

        if self._collect is None:
            raise ValueError("stage 'selu' needs rollouts: no collector was given")
        return run_selu(self, folder, key, self._collect)


def _loop_values(cfg: LoopConfig) -> dict[str, Any]:
    """A loop's values for a key: AdamW goes without saying, so that output from before there was a choice stays current."""
    return {name: value for name, value in dataclasses.asdict(cfg).items() if (name, value) != ("optimizer", "adamw")}


def _seeded(make: Callable[[], Any], seed: int) -> Any:
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


def _load_trained(module: Any, path: Path) -> None:
    from safetensors.torch import load_file

    module.load_state_dict(load_file(path))


STAGES: Final[Mapping[str, Callable[[Pipeline, Path, str], Metrics]]] = {
    "base": Pipeline._base,
    "corrections": Pipeline._corrections,
    "pointmap": Pipeline._pointmap,
    "tokenizer": Pipeline._tokenizer,
    "alignment": Pipeline._alignment,
    "selu": Pipeline._selu,
}
