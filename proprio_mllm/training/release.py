"""Released weights: a finished stage's model as a small folder with where it comes from, and how a loader finds it.

    weights/<model>/<name>/     what `building.save_model` wrote, and
        provenance.json         seed, keys and hashes of data and configuration, physics of its episodes, versions, commit and
                                processor of the release, and for every stage that went into the model its command and metrics
        README.md               the same for people, in Hugging Face's format

Weights are stored as float16, half the size; they are read back as float32. A variant's backbone is the base model's, which is
released beside it, so that its own folder holds only what training moved. The motion tokenizer keeps its precision, so that
it gives the same tokens as in training, and the critic of stage 3 is left out: a planner does not need it.
"""

from __future__ import annotations

import dataclasses
import json
import platform
import shutil
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from configs.origin import PROVENANCE, origin
from data.files import new_folder, read_json
from data.shards import Manifest
from proprio_mllm.model.building import share_backbone, write_stored
from proprio_mllm.model.tensors import read_tensors, write_tensors
from proprio_mllm.training.card import model_card
from proprio_mllm.training.paths import RELEASED_AS, finished_key
from proprio_mllm.training.pipeline import Pipeline
from proprio_mllm.training.sources import shard_hash
from proprio_mllm.training.stages.selu import CRITIC

#: Largest size of one released folder of a model from scratch, megabytes: such are kept with the code.
LARGEST_MB: Final = 30.0
#: All that is released.
_RELEASED: Final = (*RELEASED_AS, "alignment", "selu")


def release_name(stage: str, variant: str) -> str:
    """Name of a released model: `words` is of practice, the last stage's is the variant's."""
    return RELEASED_AS.get(stage, variant if stage == "selu" else f"{variant}-{stage}")


def export(pipeline: Pipeline, folder: str | Path) -> list[Path]:
    """Copies the models of words and base, the point map, and the variant's newest model to `folder/<model>/<name>`.

    What rests on a stage that has not finished under this configuration is left out, and so is what was taken from released
    weights. The model of stage `alignment` is copied only while `selu` has not finished, and what variants share only when
    `folder` does not hold the same already.

    Args:
        pipeline: names folders and keys.
        folder: such as `weights`.

    Returns:
        The written folders.

    Raises:
        ValueError: when a folder would be larger than `LARGEST_MB`.
    """
    paths, written = pipeline.paths, list[Path]()

    for stage in _RELEASED:
        source = paths.model(stage)
        if (
            not source.is_dir()
            or (pipeline.given(stage) is not None and not pipeline.continues(stage))
            or not all(map(pipeline.is_current, pipeline.ancestors(stage)))
            or (stage == "alignment" and pipeline.is_current("selu"))
        ):
            continue
        key = pipeline.key(stage)
        target = Path(folder) / pipeline.cfg.model.name / release_name(stage, pipeline.paths.variant)
        if stage in RELEASED_AS and _released_key(target) == key:  # every variant's export meets them again
            continue
        with new_folder(target) as work:
            shutil.copytree(source, work, dirs_exist_ok=True)
            _shrink(work)
            if stage not in RELEASED_AS and (work / "vlm").is_dir():
                share_backbone(work, target.with_name(release_name("base", "")))
            provenance = _provenance(pipeline, stage, key)
            (work / PROVENANCE).write_text(json.dumps(provenance, indent=1) + "\n", encoding="utf-8")
            (work / "README.md").write_text(model_card(provenance), encoding="utf-8")
            size = sum(file.stat().st_size for file in work.rglob("*") if file.is_file()) / 1e6
            if size > LARGEST_MB and pipeline.cfg.model.weights is None:
                raise ValueError(f"{target}: {size:.1f} MB; at most {LARGEST_MB:g} MB are released")
        written.append(target)
    return written


def _released_key(target: Path) -> str | None:
    path = target / PROVENANCE
    return str(read_json(path)["key"]) if path.is_file() else None


def _shrink(folder: Path) -> None:
    """Halves floating-point weights and drops the critic's adapter."""
    shutil.rmtree(folder / "adapters" / CRITIC, ignore_errors=True)
    config = read_json(folder / "config.json")
    if "adapters" in config:
        config["adapters"] = [name for name in config["adapters"] if name != CRITIC]
    for path in folder.rglob("*.safetensors"):
        if path.parent == folder / "motion":
            continue
        tensors = read_tensors(path)
        write_tensors({name: tensor.half() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}, path)
    write_stored(folder, config)


def _provenance(pipeline: Pipeline, stage: str, key: str) -> dict[str, Any]:
    shards = {}
    for kind in ("clips", "views", "lessons", "practice"):
        folder = pipeline.paths.shards(kind)
        if (folder / "manifest.json").is_file():
            shards[kind] = shard_hash(folder)
    stages = {}
    for name in pipeline.ancestors(stage):
        record = read_json(pipeline.paths.stage(name) / "done.json")
        stages[name] = {"command": record.get("command", ""), "metrics": record["metrics"]}
    return {
        "stage": stage,
        "variant": pipeline.cfg.variant,
        "key": key,
        "seed": pipeline.cfg.seed,
        "shards": shards,
        "physics": Manifest.load(pipeline.paths.shards("lessons")).metadata.get("physics"),
        **origin(),
        "stages": stages,
        "stored_as": "float16",
        "config": dataclasses.asdict(pipeline.cfg),
        "versions": {name: version(name) for name in ("torch", "transformers", "peft")} | {"python": platform.python_version()},
    }


def find_model(output: str | Path, weights: str | Path, model: str, variant: str, stage: str) -> Path:
    """The folder of a model: this machine's training output when there is one, otherwise the released weights.

    Args:
        output: the training output root.
        weights: the released weights' root.
        model: model name.
        variant: variant.
        stage: `base`, `alignment` or `selu`.

    Raises:
        FileNotFoundError: when neither exists; the message names the command that trains it.
    """
    group = "shared" if stage in ("practice", "base") else variant
    trained = Path(output) / model / group / stage
    if finished_key(trained) is not None and (trained / "model").is_dir():
        return trained / "model"
    released = Path(weights) / model / release_name(stage, variant)
    if (released / "config.json").is_file():
        return released
    raise FileNotFoundError(
        f"no {stage} model of {model} ({variant}): neither {trained / 'model'} nor {released}; "
        f"train it with `python train.py stage=all model={model} variant={variant}`"
    )
