"""Runs training stages, each skipped while its output is current.

A stage is one file of `proprio_mllm.training.stages` behind the protocol `Stage`: what it needs, what makes its output
current, and what it does. The variants of the ablation share everything up to alignment and then train with the same budget.
"""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Protocol, get_args

from configs.schema.model import CseConfig, ModelConfig, MpeConfig, PointMapConfig
from configs.schema.train import LoopConfig, TrainConfig, Variant
from proprio_mllm.model.building import save_model
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.tensors import file_hashes
from proprio_mllm.model.wording import WordEpisode
from proprio_mllm.training.loop import Objective, run_loop
from proprio_mllm.training.memory import spare_memory
from proprio_mllm.training.metrics import MetricWriter
from proprio_mllm.training.paths import RELEASED_AS, StagePaths, finish, finished_key, stage_key
from proprio_mllm.training.processes import first_alone, from_first, processes
from proprio_mllm.training.sources import shard_hash

logger = logging.getLogger(__name__)

Metrics = dict[str, float]

#: Where released weights hold what a stage trains.
_GIVEN: Final = {
    "words": RELEASED_AS["practice"],
    "practice": RELEASED_AS["practice"],
    "base": RELEASED_AS["base"],
    "pointmap": RELEASED_AS["pointmap"],
    "tokenizer": "full/motion",
}


class StageError(RuntimeError):
    """A stage that cannot start; the message names the command to run first."""


class LessonSource(Protocol):
    """Where episodes in words come from."""

    def words(self) -> tuple[str, ...]:
        """Every word that occurs in them, apart from made-up names."""
        ...

    def episode(self, seed: int) -> WordEpisode:
        """The episode of a seed; negative ones are held out."""
        ...

    def logged(self, folder: Path) -> Callable[[int], WordEpisode]:
        """Episodes of the simulator, each drawn with a seed; those of negative seeds are held out."""
        ...

    def told(self, folder: Path) -> tuple[WordEpisode, ...]:
        """All episodes of a folder in order; a turn is a row."""
        ...


class Stage(Protocol):
    """One stage of training.

    Attributes:
        name: as in `stage=NAME`; names the output's folder too.
        needs: stages whose current output it starts from; their keys are part of its own.
        shards: kinds of shards whose content is part of its key.
        recipe: raised when what it trains on changes in code, so that older output is not taken for current; starts at 0.
    """

    @property
    def name(self) -> str: ...
    @property
    def needs(self) -> tuple[str, ...]: ...
    @property
    def shards(self) -> tuple[str, ...]: ...
    @property
    def recipe(self) -> int: ...

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """What of the configuration its output depends on, as plain values; empty for nothing besides seed and inputs."""
        ...

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Does the work; what it leaves behind is below `folder`.

        Args:
            pipeline: gives the configuration, the folders and the training loop.
            folder: of this stage's output.
            key: of this stage's output; checkpoints carry it.
        """
        ...


def variant_model(model: ModelConfig, variant: str) -> ModelConfig:
    """The model's configuration with the ablated parts switched off, and their options as if they had never been set.

    Raises:
        ValueError: on an unknown variant.
    """
    if variant not in get_args(Variant):
        raise ValueError(f"variant {variant!r}; allowed: {', '.join(get_args(Variant))}")
    none = variant == "no_proprio"
    mpe = MpeConfig(mode="mrope") if none or "mpe" in variant else model.mpe
    parts: dict[str, Any] = {"mpe": mpe, "proprioception": model.proprioception and not none}
    if none or "cse" in variant:
        parts |= {"cse": CseConfig(enabled=False), "point_map": PointMapConfig()}
    return dataclasses.replace(model, **parts)


def base_model_config(model: ModelConfig) -> ModelConfig:
    """The plain backbone: no MPE, no CSE, no proprioception; it does not say where things are."""
    return dataclasses.replace(variant_model(model, "no_proprio"), places=False)


def seeded(make: Callable[[], Any], seed: int) -> Any:
    """What `make` builds with torch's random stream at a seed; the stream outside is left as it was."""
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


class Pipeline:
    """The stages of one configuration.

    Args:
        stages: every stage by name, in the order in which they run.
        cfg: configuration.
        collect_rollouts: runs an actor in the simulator and writes `rollouts` shards; given by the entry point, because
            training does not know the simulator.
        command: the command line, stored with every finished stage.
        collect_dagger: lets a model act in the simulator and writes the teacher's corrections; given likewise.
        lessons: makes episodes in words with a teacher's answers; given likewise.
    """

    def __init__(
        self,
        stages: Mapping[str, Stage],
        cfg: TrainConfig,
        collect_rollouts: Callable[..., Any] | None = None,
        command: str = "",
        collect_dagger: Callable[..., Any] | None = None,
        lessons: LessonSource | None = None,
    ) -> None:
        self.stages, self.cfg, self.command = stages, cfg, command
        self.paths = StagePaths(cfg)
        self.collect_rollouts, self.collect_dagger, self._lessons = collect_rollouts, collect_dagger, lessons
        self._taken: Metrics = {}  # steps of each run of the current stage: a time budget may end it early

    @property
    def lessons(self) -> LessonSource:
        """Where episodes in words come from.

        Raises:
            StageError: when none was given.
        """
        if self._lessons is None:
            raise StageError("no source of lessons was given; run the stage with `python train.py`")
        return self._lessons

    def key(self, name: str) -> str:
        """Key of a stage's output under the present configuration and inputs.

        Raises:
            ValueError: on an unknown stage.
        """
        if name not in self.stages:
            raise ValueError(f"stage {name!r} has no key; allowed: {', '.join(self.stages)}")
        stage = self.stages[name]
        inputs = {needed: self.key(needed) for needed in stage.needs}
        inputs |= {kind: shard_hash(self.paths.shards(kind)) for kind in stage.shards}
        own: dict[str, Any] = {
            "recipe": stage.recipe,
            "micro_batches": self.cfg.micro_batches,
            "keep_spatial": self.cfg.keep_spatial,
        }
        if (given := self.given(name)) is not None:
            own["given"] = file_hashes(given)
        return stage_key(dict(stage.settings(self)) | own, self.paths.seed(name), inputs)

    def given(self, stage: str) -> Path | None:
        """The folder of released weights with what a stage would train (`TrainConfig.given`); None where it starts afresh.

        Raises:
            StageError: when there are no released weights of this model.
        """
        names = _GIVEN | ({"alignment": self.paths.variant} if self.cfg.given_alignment else {})
        if self.cfg.given is None or stage not in names:
            return None
        released = Path(self.cfg.given) / self.cfg.model.name
        if not released.is_dir():
            raise StageError(
                f"given={self.cfg.given}: no folder {released}; it is where released weights are, such as `weights`"
            )
        folders = [released / names[stage]]
        if stage == "alignment" and self.cfg.given_alignment == "continued":
            folders.append(released / "full")  # whose parts a variant leaves out
        return next((folder for folder in folders if folder.is_dir()), None)

    def fits(self, given: Path, has: object, wanted: object) -> None:
        """Holds what released weights are of against the configuration.

        Raises:
            StageError: when they differ.
        """
        if has != wanted:
            raise StageError(f"given={self.cfg.given}: {given} is of {has}, the configuration asks for {wanted}")
        logger.info("taken from %s", given)

    def continues(self, stage: str) -> bool:
        """Whether a stage goes on from what is given, in place of taking it as it is."""
        return stage == "alignment" and self.cfg.given_alignment == "continued" and self.given(stage) is not None

    def ancestors(self, name: str) -> tuple[str, ...]:
        """A stage and everything that went into its output, in the order in which they run."""
        found, waiting = {name}, [name]
        while waiting:
            new = set(self.stages[waiting.pop()].needs) - found
            found |= new
            waiting += new
        return tuple(stage for stage in self.stages if stage in found)

    def is_current(self, name: str) -> bool:
        """Whether a stage has finished under the present configuration and inputs."""
        done = finished_key(self.paths.stage(name))
        return done is not None and done == self.key(name)

    def run(self, name: str) -> Metrics | None:
        """Runs a stage unless its output is current; returns its metrics, None when it was skipped.

        `seconds` is the time of this run; those of a loop, which may have been resumed, count its earlier runs too.

        Raises:
            StageError: when a stage that it needs has no current output.
        """
        folder, key = self.paths.stage(name), self.key(name)
        (current,) = from_first([float(finished_key(folder) == key and not self.cfg.overwrite)])
        if current:
            logger.info("%s: current, skipped (%s)", name, folder)
            return None
        for needed in self.stages[name].needs:
            if not self.is_current(needed):
                raise StageError(f"stage {name!r} needs the output of {needed!r}; run `python train.py stage={needed}` first")
        first_alone(lambda: _unfinished(folder))
        began = time.monotonic()
        self._taken.clear()
        metrics = self.stages[name].run(self, folder, key) | self._taken
        metrics["seconds"] = round(time.monotonic() - began, 1)
        first_alone(lambda: finish(folder, key, metrics, self.command))
        logger.info("%s: %s", name, ", ".join(f"{k} {v:.4g}" for k, v in metrics.items()))
        return metrics

    def needs_no(self, stage: str) -> bool:
        """Whether pretrained weights stand in for a stage's output; says so."""
        given = self.cfg.model.weights is not None
        if given:
            logger.info("%s: %s has pretrained weights, nothing to do", stage, self.cfg.model.name)
        return given

    def store(self, name: str, model: ProprioMLLM, tokenizer: MotionTokenizer | None = None) -> None:
        """Writes a stage's model, and the motion tokenizer that its prompts were made with."""
        first_alone(lambda: save_model(model.eval(), self.paths.model(name), tokenizer))

    def loop(self, objective: Objective, cfg: LoopConfig, folder: Path) -> None:
        """Runs one objective with this configuration's seed and logger."""
        first_alone(lambda: folder.mkdir(parents=True, exist_ok=True))
        spare_memory(objective.module, self.cfg.recompute, self.cfg.shard)
        if self.cfg.keep_spatial and isinstance(objective.module, ProprioMLLM):
            objective.module.keep_spatial()
        about = {"key": objective.key}
        writer = MetricWriter(folder, objective.name, self.cfg.logger, about) if processes().is_main_process else None
        resume = self.cfg.resume and not self.cfg.overwrite
        try:
            result = run_loop(objective, cfg, folder, self.cfg.seed, writer, resume, self.cfg.micro_batches)
            self._taken |= {
                f"{objective.name}/steps": float(result.steps),
                f"{objective.name}/seconds": round(result.seconds, 1),
            }
        finally:
            if writer is not None:
                writer.close()


def _unfinished(folder: Path) -> None:
    """From here on the folder's content is no finished stage's."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "done.json").unlink(missing_ok=True)
