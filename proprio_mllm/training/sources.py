"""Shards as training examples: decoding, held-out splits, and the questions an image can be asked.

Views and steps are decoded on demand; motion windows, which are small, are kept in memory. The held-out part of each shard is
fixed by the row's seed or episode, so it is the same for every stage and variant.

Shape letters: T frames, F motion features, K key bodies, H and W image rows and columns.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from configs.schema.model import ModelConfig
from data.motion import HAND_OPENING, KEY_BODY_COUNT, OPEN_HAND
from data.shards import Manifest, ShardError, ShardReader, decode_depth, decode_motion, decode_png, decode_segmentation
from interface.observation import Camera
from interface.sightings import Shown
from proprio_mllm.model.batch import View
from proprio_mllm.model.geometry import unproject
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.prompts import Style, answers
from proprio_mllm.model.questions import ANSWERS, ask, spoken
from proprio_mllm.training.states import history_of

#: One in this many views, episodes and clips is never trained on.
HELD_OUT = 20
#: Rows and columns of pixels of a merged visual token.
CELL: Final = 28
GROUNDING = ("side", "distance", "height")
BODY_RELATIVE = ("arm", "reach", "shift")


def asked_by(cfg: ModelConfig) -> tuple[str, ...]:
    """The kinds of question that a model is asked about views."""
    return (*GROUNDING, *BODY_RELATIVE, *(("place",) if cfg.places else ()))


def held_out(key: str) -> bool:
    """Whether a row with this key belongs to the held-out part."""
    return int.from_bytes(hashlib.sha256(key.encode()).digest()[:4], "big") % HELD_OUT == 0


def shard_hash(folder: Path) -> str:
    """Hash of a shard folder's manifest, which names the checksums of all its parts.

    Raises:
        ShardError: when the folder holds no shards, or its producer has not finished.
    """
    try:
        complete = Manifest.load(Path(folder)).complete
    except ShardError as error:
        stage = "data" if Path(folder).name == "clips" else "collect"
        raise ShardError(f"{error}; make them with `python train.py stage={stage}`") from error
    if not complete:
        raise ShardError(f"{folder}: its producer has not finished; run the same command again to continue it")
    return hashlib.sha256((Path(folder) / "manifest.json").read_bytes()).hexdigest()[:16]


def _camera(row: Mapping[str, Any], pose: Sequence[float]) -> Camera:
    return Camera(
        np.asarray(row["intrinsics"], dtype=np.float64).reshape(3, 3),
        np.asarray(pose, dtype=np.float64).reshape(4, 4),
        int(row["height"]),
        int(row["width"]),
    )


def key_bodies_of(motion: NDArray[np.float32]) -> NDArray[np.float64]:
    """Key bodies (K, 3) of the newest frame of a motion (T, F)."""
    return motion[-1, : 3 * KEY_BODY_COUNT].reshape(KEY_BODY_COUNT, 3).astype(np.float64)


class _Split:
    """Indices of the training and held-out rows of a reader."""

    def __init__(self, keys: Sequence[str], folder: Path) -> None:
        mask = np.array([held_out(key) for key in keys], dtype=bool)
        self.train = np.flatnonzero(~mask)
        self.test = np.flatnonzero(mask)
        if not len(self.train):
            raise ValueError(f"{folder}: no training rows among {len(keys)}")


@dataclass(frozen=True, slots=True)
class ViewRow:
    """One posed view with its truth: `objects` as written by the simulator, `points_m` (H, W, 3) in the camera frame."""

    view: View
    motion: NDArray[np.float32]
    objects: tuple[Mapping[str, Any], ...]
    segmentation: NDArray[np.int16]
    points_m: NDArray[np.float32]


class Asked(NamedTuple):
    """A question about a thing in a view, its answer, how it names the thing, and what the simulator wrote about that."""

    question: str
    answer: str
    name: str
    thing: Mapping[str, Any]


class Views:
    """Posed views with depth and segmentation."""

    def __init__(self, folder: Path, cfg: ModelConfig) -> None:
        self.reader = ShardReader(folder, "views")
        self.split = _Split([f"{s}" for s in self.reader.column("seed")], folder)
        self.type_names: tuple[str, ...] = (
            tuple(json.loads(self.reader.manifest.metadata["type_names"]))
            if isinstance(self.reader.manifest.metadata["type_names"], str)
            else tuple(self.reader.manifest.metadata["type_names"])
        )
        self.style: Style = cfg.prompt
        self.cfg = cfg

    def row(self, index: int) -> ViewRow:
        """Decodes one row."""
        row = self.reader[int(index)]
        height, width = int(row["height"]), int(row["width"])
        motion = decode_motion(row["motion"])
        camera = _camera(row, row["camera_in_pelvis"])
        points = unproject(decode_depth(row["depth"], height, width), camera.intrinsics)
        oracle = points if self.cfg.point_map.encoder == "oracle" else None
        view = View(decode_png(row["image"]), camera, key_bodies_of(motion), oracle)
        objects = tuple(json.loads(row["objects"]))
        return ViewRow(view, motion, objects, decode_segmentation(row["segmentation"], height, width), points)

    def draw(self, rng: np.random.Generator, size: int) -> list[ViewRow]:
        """Training rows."""
        return [self.row(int(index)) for index in rng.choice(self.split.train, size)]

    def asked(self, row: ViewRow, kinds: Sequence[str], count: int, rng: np.random.Generator) -> list[Asked]:
        """Questions about visible objects, at most `count`, one about each: a second would be answered by the first."""
        bodies = row.view.key_bodies
        assert bodies is not None
        found: list[Asked] = []
        visible = [obj for obj in row.objects if int(obj["pixels"]) >= 6]
        for obj in visible:
            centre, name = np.asarray(obj["center_in_pelvis"], dtype=np.float64), spoken(str(obj["id"]), self.style)
            kind = kinds[int(rng.integers(len(kinds)))]
            found.append(Asked(ask(kind, name, self.style), ANSWERS[kind](centre, bodies), name, obj))
        order = rng.permutation(len(found))[:count]
        return [found[i] for i in order]

    def listing(self, row: ViewRow) -> tuple[str, str]:
        """Image to text: the names of the objects in view, nearest to the top-left corner first."""
        visible = [obj for obj in row.objects if int(obj["pixels"]) >= 6]
        ordered = sorted(visible, key=lambda obj: (float(obj["bbox"][0]), float(obj["bbox"][1])))
        return ask("see", style=self.style), answers([str(obj["id"]) for obj in ordered][:8])


class _Joined:
    """Several `demos` folders read as one, in order."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._readers = [ShardReader(folder, "demos") for folder in folders]
        self._starts = np.cumsum([0, *(len(reader) for reader in self._readers)])

    def column(self, name: str) -> list[Any]:
        return [value for reader in self._readers for value in reader.column(name)]

    def folder_of(self) -> list[int]:
        """Number of the folder that each row comes from."""
        return [number for number, reader in enumerate(self._readers) for _ in range(len(reader))]

    def __getitem__(self, index: int) -> Mapping[str, Any]:
        which = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self._readers[which][int(index - self._starts[which])]


class Demos:
    """Steps of episodes in the simulator with what was seen and felt before them, and the teacher's step.

    Args:
        folder: lessons; an episode that met its goals ends in `Done`.
        cfg: the model's.
        more: further folders of the same kind; their rows follow.
    """

    def __init__(self, folder: Path, cfg: ModelConfig, more: Sequence[Path] = ()) -> None:
        self.reader = _Joined([folder, *more])
        names = self.reader.column("episode")
        #: First row of every episode.
        self.starts = [row for row, name in enumerate(names) if row == 0 or name != names[row - 1]]
        self.split = _Split(names, folder)
        self.motions = np.stack([decode_motion(m) for m in self.reader.column("motion")])  # (N, T, F)
        #: Rows at which the goals of an episode were met.
        self.ends = np.flatnonzero(np.asarray(self.reader.column("target")) == "Done()")
        self.style: Style = cfg.prompt
        labels = np.char.add(np.asarray(self.reader.column("category")), np.asarray(self.reader.folder_of(), dtype=str))
        labels = labels[self.split.train]
        self._groups = [self.split.train[labels == name] for name in sorted(set(labels))]

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.int64]:
        """Training rows (size,), every category of every folder as often: there are fewer successes where tasks are harder."""
        chosen = rng.integers(len(self._groups), size=size)
        return np.array([rng.choice(self._groups[c]) for c in chosen], dtype=np.int64)

    def tokens(self, tokenizer: MotionTokenizer) -> NDArray[np.int64]:
        """Motion tokens (N, T / stride) of every row's window."""
        with torch.no_grad():
            newest = self.motions[:, -tokenizer.cfg.window :]
            parts = [torch.from_numpy(newest[i : i + 256]) for i in range(0, len(newest), 256)]
            return torch.cat([tokenizer.encode(part) for part in parts]).cpu().numpy()

    def shown(self, index: int, goal: str) -> list[Shown]:
        """What a planner with a goal would have seen of a row's episode, up to that row."""
        start = self.starts[int(np.searchsorted(self.starts, index, side="right")) - 1]
        rows = [self.reader[row] for row in range(start, index + 1)]
        history = tuple(history_of(rows[-1]))
        return [
            Shown(goal, row["robot"], tuple(row["visible"]), tuple(row["known"]), history[:at]) for at, row in enumerate(rows)
        ]

    def view(self, row: Mapping[str, Any]) -> View:
        """The head-camera view of a row."""
        bodies = np.asarray(row["key_bodies"], dtype=np.float64).reshape(KEY_BODY_COUNT, 3)
        return View(decode_png(row["image"]), _camera(row, row["camera_in_pelvis"]), bodies)


def grips_of(demos: Demos) -> list[NDArray[np.int64]]:
    """Training rows of each robot with the same hands open."""
    robots = np.asarray(demos.reader.column("robot"))[demos.split.train]
    opened = demos.motions[demos.split.train, -1, HAND_OPENING] >= OPEN_HAND  # (N, 2)
    groups = [
        demos.split.train[(robots == robot) & (opened == hands).all(axis=1)]
        for robot, hands in product(sorted(set(robots.tolist())), product((False, True), repeat=2))
    ]
    return [rows for rows in groups if len(rows)]


class Clips:
    """Retargeted motions with captions and replayed head-camera frames."""

    def __init__(self, folder: Path) -> None:
        self.reader = ShardReader(folder, "clips")
        self.split = _Split(self.reader.column("name"), folder)
        self.motions = [decode_motion(m) for m in self.reader.column("motion")]
        self.captions: list[list[str]] = self.reader.column("captions")

    def window(self, index: int, frames: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """A window (frames, F) of a clip, at a random place; shorter clips repeat their first frame in front."""
        motion = self.motions[int(index)]
        start = int(rng.integers(0, max(len(motion) - frames, 0) + 1))
        part = motion[start : start + frames]
        return np.concatenate([np.repeat(part[:1], frames - len(part), axis=0), part])

    def view(self, index: int, rng: np.random.Generator) -> tuple[View, NDArray[np.float32]]:
        """A replayed frame and the motion up to it (at least one frame)."""
        row = self.reader[int(index)]
        pick = int(rng.integers(len(row["images"])))
        frame = int(row["image_frames"][pick])
        motion = self.motions[int(index)][: frame + 1]
        camera = _camera(row, row["cameras_in_pelvis"][pick])
        return View(decode_png(row["images"][pick]), camera, key_bodies_of(motion)), motion

    def caption(self, index: int, rng: np.random.Generator) -> str:
        """One of the clip's captions."""
        return self.captions[int(index)][int(rng.integers(len(self.captions[int(index)])))]
