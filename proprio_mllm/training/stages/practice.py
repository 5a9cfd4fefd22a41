"""Stage `practice`: DAgger in the simulator. The words model acts, its teacher answers, and it learns from both worlds.

A model that has been aligned may act in its place (`practice.student`): the next alignment learns from its episodes.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from data.files import read_json
from data.shards import ShardReader, config_hash
from proprio_mllm.model.building import load_model
from proprio_mllm.training.pipeline import Metrics, Pipeline, StageError
from proprio_mllm.training.processes import first_alone
from proprio_mllm.training.rollouts import DaggerRequest
from proprio_mllm.training.words import WordsObjective, held_out_metrics, mixed


class PracticeStage:
    """One loop over episodes of the text world, of the teacher in the simulator, and of the model itself there."""

    name = "practice"
    needs = ("words",)
    shards = ("lessons",)
    recipe = 1

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """The loop, how much the model acts, and who acts where it is not the words model."""
        cfg = pipeline.cfg.practice
        settings: dict[str, Any] = dataclasses.asdict(cfg)
        if settings.pop("student") is not None:
            settings["student"] = read_json(Path(str(cfg.student)) / "config.json")
        return {"practice": settings}

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Lets the model act, trains it and stores it; measures it on episodes that it was not trained on.

        Pretrained weights need none of it; a student of theirs acts, and that is all.
        """
        cfg, shards = pipeline.cfg.practice, pipeline.paths.shards("practice")
        given = pipeline.cfg.model.weights is not None
        if given and cfg.student is None:
            pipeline.needs_no(self.name)
            return {}
        words = pipeline.paths.model("words")
        _collect(pipeline, words if cfg.student is None else Path(cfg.student), shards)
        metrics = _as_teacher(shards)
        if given:
            return metrics
        lessons = pipeline.lessons
        taught, own = lessons.logged(pipeline.paths.shards("lessons")), lessons.logged(shards)
        episode = mixed(lessons.episode, (cfg.own_share, own), (cfg.logged, taught))
        model = load_model(words)
        if pipeline.given(self.name) is None:  # else it has been through it
            model.requires_grad_(False)
            model.core.model.language_model.requires_grad_(True)
            pipeline.loop(WordsObjective(model, episode, key, pipeline.cfg.words.reading), cfg.loop, folder / "loop")
        pipeline.store("practice", model)
        return {**held_out_metrics(model, {"": lessons.episode, "_logged": taught, "_own": own}), **metrics}


def _collect(pipeline: Pipeline, student: Path, shards: Path) -> None:
    """Lets a model act on training tasks."""
    if pipeline.collect_dagger is None:
        raise StageError("stage 'practice' needs the simulator: run it with `python train.py stage=practice`")
    cfg, ahead, collect = pipeline.cfg.practice, pipeline.cfg.collect.foreseen, pipeline.collect_dagger
    acts = pipeline.key("words") if cfg.student is None else read_json(student / "config.json")
    written = config_hash({"key": acts, "episodes": cfg.episodes, "share": cfg.teacher_share, "foreseen": ahead})
    size = pipeline.cfg.model.image_size
    request = DaggerRequest(student, shards, cfg.episodes, pipeline.cfg.seed, cfg.teacher_share, size, written, ahead)

    def act() -> None:
        if pipeline.cfg.overwrite:
            shutil.rmtree(shards, ignore_errors=True)
        collect(request, workers=cfg.workers)

    first_alone(act)


def _as_teacher(shards: Path) -> Metrics:
    """How many steps the student took itself, and the share of them that were the teacher's."""
    reader = ShardReader(shards, "demos")
    notes = [json.loads(text) for text in reader.column("privileged")]
    mine = [note["executed"] == note["taught"] for note in notes if note["origin"] == "student"]
    return {"own_steps": float(len(mine)), "own_as_teacher": float(np.mean(mine)) if mine else 0.0}
