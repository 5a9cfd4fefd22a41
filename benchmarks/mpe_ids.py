"""What the position ids of an object's visual token tell about where the object is, for each reading of MPE.

    python -m benchmarks.mpe_ids views=outputs/tiny/data/views rows=6000

Of every object in a posed view, the ids of the token on which its centre falls are looked up in a table made from other views:
the commonest answer of training views with the same robot and the same ids. The share that is right in held-out views is what
a model could answer from ids alone; `mrope` stands for the token's place in the picture, which every variant can tell from the
vision tower as well. `hands` is the reading with a robot in two places: the signs to the left and to the right hand.
"""

from __future__ import annotations

import json
import sys
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from configs.arguments import command, read_arguments
from data.motion import N_FEATURES
from data.shards import ShardReader
from interface.bodies import KEY_BODIES
from interface.observation import Camera
from proprio_mllm.model.geometry import centroid, project
from proprio_mllm.model.mpe import relative_cells
from proprio_mllm.model.questions import arm_answer, distance_answer, height_answer, shift_answer, side_answer
from proprio_mllm.report.statistics import wilson
from proprio_mllm.training.sources import held_out, key_bodies_of

#: Smallest object that is asked about, pixels, as in training.
_PIXELS: Final = 6
_HANDS: Final = [KEY_BODIES.index(f"{side}_hand") for side in ("left", "right")]
Ids = tuple[int, ...]


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        views: folder of `views` shards.
        rows: how many of its views.
        grid: rows and columns of the merged grid; 8 is that of 224 pixels.
    """

    views: str
    rows: int = 6000
    grid: int = 8


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


def objects_seen(options: Options) -> list[Seen]:
    """The objects of the views, with the ids of their tokens."""
    reader, found = ShardReader(Path(options.views), "views"), list[Seen]()
    for number in range(min(options.rows, len(reader))):
        row = reader[number]
        shape = int(row["height"]), int(row["width"])
        intrinsics, pose = (np.asarray(row[name], dtype=np.float64) for name in ("intrinsics", "camera_in_pelvis"))
        camera = Camera(intrinsics.reshape(3, 3), pose.reshape(4, 4), *shape)
        bodies = key_bodies_of(np.asarray(row["motion"], dtype=np.float32).reshape(-1, N_FEATURES))
        for item in json.loads(row["objects"]):
            centre = np.asarray(item["center_in_pelvis"], dtype=np.float64)
            x, y = project(camera, centre)
            cell = int(y / shape[0] * options.grid), int(x / shape[1] * options.grid)
            if int(item["pixels"]) < _PIXELS or not all(0 <= one < options.grid for one in cell):
                continue
            answers = {
                "side": side_answer(centre),
                "arm": arm_answer(centre),
                "distance": distance_answer(centre),
                "height": height_answer(centre),
                "shift": shift_answer(centre, bodies).partition("(")[0],
            }
            found.append(Seen(row["robot"], held_out(f"{row['seed']}"), ids_of(cell, options.grid, camera, bodies), answers))
    return found


def told(seen: Sequence[Seen], variant: str, question: str) -> tuple[int, int]:
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


@command()
def main(arguments: Sequence[str]) -> int:
    """Prints the table."""
    options = read_arguments(Options, arguments)
    seen = objects_seen(options)
    questions = list(seen[0].answers)
    sys.stdout.write(f"{sum(not one.test for one in seen)} objects to look up, {sum(one.test for one in seen)} asked about\n")
    sys.stdout.write(f"{'ids':20s}" + "".join(f"{question:>18s}" for question in questions) + "\n")
    for variant in ("", *seen[0].ids):
        cells = []
        for question in questions:
            right, count = told(seen, variant, question)
            low, high = wilson(right, count)
            cells.append(f"{100 * right / count:5.1f} [{100 * low:.0f}, {100 * high:.0f}]")
        sys.stdout.write(f"{variant or 'robot alone':20s}" + "".join(f"{cell:>18s}" for cell in cells) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
