"""What is known of where an object is from its visual token's position ids (MPE), and from its points (CSE), before learning.

    python -m benchmarks.where views=outputs/tiny/data/views model=weights/tiny/full

Of every object in a posed view, the ids of the token on which its centre falls are looked up in a table made from other views:
the commonest answer of training views with the same robot and the same ids. The share that is right in held-out views is what
a model could answer from ids alone; `mrope` stands for the token's place in the picture, which every variant can tell from the
vision tower as well. `hands` is the reading with a robot in two places: the signs to the left and to the right hand. Points
answer by themselves: the mean of those on the token, true ones and those of the model's point map. Which token is the object's
is given; that is what a model has to learn.
"""

from __future__ import annotations

import json
import sys
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from configs.arguments import command, read_arguments
from data.motion import N_FEATURES
from data.shards import ShardReader
from interface.bodies import KEY_BODIES
from interface.observation import Camera
from proprio_mllm.model.batch import Collator
from proprio_mllm.model.building import load_model
from proprio_mllm.model.geometry import centroid, project, to_pelvis
from proprio_mllm.model.mpe import relative_cells
from proprio_mllm.model.questions import ANSWERS
from proprio_mllm.report.statistics import wilson
from proprio_mllm.training.sources import Views, held_out, key_bodies_of

#: Smallest object that is asked about, pixels, as in training.
_PIXELS: Final = 6
_ASKED: Final = tuple(kind for kind in ANSWERS if kind != "place")  # whose answers are words
_HANDS: Final = [KEY_BODIES.index(f"{side}_hand") for side in ("left", "right")]
Ids = tuple[int, ...]


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        views: folder of `views` shards.
        rows: how many of its views.
        grid: rows and columns of the merged grid; 8 is that of 224 pixels.
        model: folder of a model whose point map is asked; none when it is empty.
    """

    views: str
    rows: int = 6000
    grid: int = 8
    model: str = ""


@dataclass(frozen=True)
class Seen:
    """An object in a view.

    Attributes:
        robot: whose view it is.
        test: whether the view is held out.
        ids: of its token, by variant.
        answers: by question.
    """

    robot: str
    test: bool
    ids: Mapping[str, Ids]
    answers: Mapping[str, str]


def answers_about(point: NDArray[np.floating], bodies: NDArray[np.floating]) -> dict[str, str]:
    """Every question's answer about a point (3,) of the pelvis heading frame."""
    return {kind: ANSWERS[kind](point, bodies).partition("(")[0] for kind in _ASKED}


def ids_of(cell: tuple[int, int], grid: int, camera: Camera, bodies: NDArray[np.float64]) -> dict[str, Ids]:
    """What each variant's ids say of the token in a cell (row, column)."""
    token = cell[0] * grid + cell[1]
    found: dict[str, Ids] = {"mrope": cell}
    for provider in ("reach", "body", "arms"):
        place = centroid(camera, bodies, provider)
        dy, dx = (int(one[token]) for one in relative_cells(grid, grid, place))
        found[f"rope_radial, {provider}"] = (dy, dx)
        found[f"rope_sign, {provider}"] = (int(np.sign(dy)), int(np.sign(dx)))
    signs: list[int] = []
    for hand in _HANDS:
        x, y = project(camera, bodies[hand])
        signs += [int(one[token].sign()) for one in relative_cells(grid, grid, (x / camera.width, y / camera.height))]
    found["rope_sign, hands"] = tuple(signs)
    return found


def cells_of(objects: Sequence[Mapping[str, Any]], camera: Camera, grid: int) -> list[tuple[NDArray[np.float64], int, int]]:
    """Centre (3,), row and column of the token of each object whose centre is in the picture."""
    found = list[tuple[NDArray[np.float64], int, int]]()
    for item in objects:
        centre = np.asarray(item["center_in_pelvis"], dtype=np.float64)
        x, y = project(camera, centre)
        if int(item["pixels"]) >= _PIXELS and 0 <= x < camera.width and 0 <= y < camera.height:
            found.append((centre, int(y / camera.height * grid), int(x / camera.width * grid)))
    return found


def objects_seen(options: Options) -> list[Seen]:
    """The objects of the views, with the ids of their tokens."""
    reader, found = ShardReader(Path(options.views), "views"), list[Seen]()
    for number in range(min(options.rows, len(reader))):
        row = reader[number]
        intrinsics, pose = (np.asarray(row[name], dtype=np.float64) for name in ("intrinsics", "camera_in_pelvis"))
        camera = Camera(intrinsics.reshape(3, 3), pose.reshape(4, 4), int(row["height"]), int(row["width"]))
        bodies = key_bodies_of(np.asarray(row["motion"], dtype=np.float32).reshape(-1, N_FEATURES))
        test = held_out(f"{row['seed']}")
        for centre, *cell in cells_of(json.loads(row["objects"]), camera, options.grid):
            ids = ids_of((cell[0], cell[1]), options.grid, camera, bodies)
            found.append(Seen(row["robot"], test, ids, answers_about(centre, bodies)))
    return found


def told_by_ids(seen: Sequence[Seen], variant: str, question: str) -> tuple[int, int]:
    """Held-out answers that a look-up by robot and ids gets right, of how many; an empty variant looks up the robot alone."""
    table: dict[tuple[str, Ids], Counter[str]] = defaultdict(Counter)
    for one in seen:
        if not one.test:
            table[one.robot, one.ids.get(variant, ())][one.answers[question]] += 1
            table[one.robot, ()][one.answers[question]] += 1
    asked = [one for one in seen if one.test]
    best = {key: counts.most_common(1)[0][0] for key, counts in table.items()}
    keys = [(one.robot, one.ids.get(variant, ())) for one in asked]
    right = (best.get(key, best[one.robot, ()]) == one.answers[question] for key, one in zip(keys, asked, strict=True))
    return sum(right), len(asked)


@torch.no_grad()
def told_by_points(options: Options) -> dict[str, dict[str, tuple[int, int]]]:
    """Held-out answers that the mean point of an object's token gets right, of how many, by source and question."""
    model = load_model(options.model)
    assert model.point_map is not None, f"{options.model} has no point map"
    views, collate = Views(Path(options.views), model.cfg), Collator(model.processor, model.cfg)
    counts = {source: defaultdict[str, list[bool]](list) for source in ("true points", "the point map's points")}
    for index in views.split.test[views.split.test < options.rows]:
        row = views.row(int(index))
        bodies, camera = row.view.key_bodies, row.view.camera
        assert bodies is not None and camera is not None
        images = collate.images([row.view])
        own = model.point_map(images.rgb, None, images.stance).points_m[0].numpy()
        for centre, i, j in cells_of(row.objects, camera, options.grid):
            truth = answers_about(centre, bodies)
            for source, points in zip(counts, (row.points_m, own), strict=True):
                rows, columns = (
                    slice(k * size // options.grid, (k + 1) * size // options.grid)
                    for k, size in zip((i, j), points.shape, strict=False)
                )
                point = points[rows, columns].reshape(-1, 3).mean(0)
                answers = answers_about(to_pelvis(camera, point), bodies)
                for question, answer in answers.items():
                    counts[source][question].append(answer == truth[question])
    return {source: {key: (sum(all_), len(all_)) for key, all_ in found.items()} for source, found in counts.items()}


@command()
def main(arguments: Sequence[str]) -> int:
    """Prints the table."""
    options = read_arguments(Options, arguments)
    seen = objects_seen(options)
    questions = list(seen[0].answers)
    sys.stdout.write(f"{sum(not one.test for one in seen)} objects to look up, {sum(one.test for one in seen)} asked about\n")
    sys.stdout.write(f"{'known':24s}" + "".join(f"{question:>18s}" for question in questions) + "\n")
    found = {variant or "robot alone": {q: told_by_ids(seen, variant, q) for q in questions} for variant in ("", *seen[0].ids)}
    if options.model:
        found |= told_by_points(options)
    for name, shares in found.items():
        cells = []
        for right, count in (shares[question] for question in questions):
            low, high = wilson(right, count)
            cells.append(f"{100 * right / count:5.1f} [{100 * low:.0f}, {100 * high:.0f}]")
        sys.stdout.write(f"{name:24s}" + "".join(f"{cell:>18s}" for cell in cells) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
