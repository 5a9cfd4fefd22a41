"""Stage `pointmap`: a small point-map encoder learns from the simulator's own depth; other encoders come trained."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from data.files import new_folder, read_json
from interface.actions import ACTIONS
from proprio_mllm.model.building import TRAINED_HERE, build_point_map, load_model, write_stored
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.named_map import NamedPointMap, name_rows
from proprio_mllm.model.tensors import check_files, read_tensors, write_tensors
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import ID_NUMBERS, MARKERS, name_words
from proprio_mllm.training.geometry_stage import NamedMapObjective, PointMapObjective, point_map_error
from proprio_mllm.training.pipeline import Metrics, Pipeline, seeded
from proprio_mllm.training.processes import first_alone
from proprio_mllm.training.sources import Views

#: File of the stored encoder.
WEIGHTS: Final = "model.safetensors"


class PointMapStage:
    """Metric points from single views."""

    name = "pointmap"
    needs = ("practice",)
    shards = ("views",)
    recipe = 5

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """The loop and the encoder."""
        cfg = pipeline.cfg
        return {"loop": dataclasses.asdict(cfg.pointmap), "map": dataclasses.asdict(cfg.model.point_map)}

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Trains the encoder and measures it on held-out views."""
        encoder = seeded(lambda: build_point_map(pipeline.cfg.model), pipeline.cfg.seed)
        if encoder is None or not list(encoder.parameters()):
            return {}
        views = Views(pipeline.paths.shards("views"), pipeline.cfg.model)
        names, about = None, _about(pipeline)
        if isinstance(encoder, NamedPointMap):
            words = load_model(pipeline.paths.model("practice"))
            names = names_of(words, views.type_names)
            about["words"] = hashlib.sha256(words.table.detach().half().numpy().tobytes()).hexdigest()  # as it is released
            objective = NamedMapObjective(encoder, views, names, key)
        else:
            objective = PointMapObjective(encoder, views, key)
        if pipeline.cfg.model.point_map.encoder in TRAINED_HERE:
            if (given := pipeline.given(self.name)) is not None:
                stored = read_json(given / "config.json")
                check_files(given, stored.pop("files"))
                pipeline.fits(given, stored, about)
                encoder.load_state_dict(read_tensors(given / WEIGHTS))
            else:
                encoder.requires_grad_(True)
                pipeline.loop(objective, pipeline.cfg.pointmap, folder)
            first_alone(lambda: _store(encoder, about, pipeline.paths.model(self.name)))
        return point_map_error(encoder.eval(), views, names)


def _about(pipeline: Pipeline) -> dict[str, Any]:
    """What a stored point map fits."""
    model = pipeline.cfg.model
    size = {"image_size": model.image_size, "hidden": model.text.hidden}
    return {name: getattr(model.point_map, name) for name in ("encoder", "width", "depth")} | size


def _store(encoder: torch.nn.Module, about: Mapping[str, Any], folder: Path) -> None:
    with new_folder(folder) as work:
        write_tensors({name: tensor.contiguous() for name, tensor in encoder.state_dict().items()}, work / WEIGHTS)
        write_stored(work, about)


@torch.no_grad()
def names_of(model: ProprioMLLM, types: Sequence[str]) -> Tensor:
    """Unit rows (C + M, D) of a language model's table: of the names of types, and of words of the grammar that are in none."""
    tokens, names = tokens_of(model.processor.tokenizer), [name_words(name) for name in types]
    parts = {part for name in names for part in name}
    others = [(word,) for word in (*MARKERS, *ACTIONS, *ID_NUMBERS) if word not in parts]
    return name_rows(tokens, model.table, [*names, *others])
