"""Shards as training examples: decoding, held-out splits, and the questions an image can be asked.

Views and steps are decoded on demand; motion windows, which are small, are kept in memory. The held-out part of each shard is
fixed by the row's seed or episode, so it is the same for every stage and variant.

Shape letters: T frames, F motion features, K key bodies, H and W image rows and columns.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import torch
from numpy.typing import NDArray

from configs.schema.model import ModelConfig
from data.interface.observation import Camera
from data.motion import HAND_OPENING, KEY_BODY_COUNT, OPEN_HAND
from data.shards import Manifest, ShardError, ShardReader, decode_depth, decode_motion, decode_png, decode_segmentation
from proprio_mllm.model.batch import Example, View
from proprio_mllm.model.chat import Message
from proprio_mllm.model.geometry import unproject
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.prompts import Style, answers, critic_prompt, named_prompt, plan_prompt, self_ask_prompt, with_answer
from proprio_mllm.model.questions import arm_answer, ask, distance_answer, height_answer, shift_answer, side_answer
from proprio_mllm.training.states import asked_relation, history_of, open_hands, states_from_log
from proprio_mllm.training.text_planning import OBJECT_ID, Exchange, is_symbolic

__all__ = ["Bodies", "Clips", "Demos", "GoalQuestions", "TextPlanning", "Views", "held_out", "shard_hash", "step_in_words"]

#: One in this many views, episodes and clips is never trained on.
HELD_OUT = 20
GROUNDING = ("side", "distance", "height")
BODY_RELATIVE = ("arm", "shift")
#: Shares of exercises: the expert's own logs with names exchanged, which objects an instruction names, which objects are in a
#: state according to the log. The others ask for the next step of an episode in words.
FROM_LOGS, NAMING, STATES = 0.2, 0.2, 0.1
#: Earlier steps that tell what to do next, nearly always.
_ENOUGH_LOG = 4
#: Share of corrections among the exercises where there are any.
CORRECTED = 0.5


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
        self._cfg = cfg

    def row(self, index: int) -> ViewRow:
        """Decodes one row."""
        row = self.reader[int(index)]
        height, width = int(row["height"]), int(row["width"])
        motion = decode_motion(row["motion"])
        camera = _camera(row, row["camera_in_pelvis"])
        points = unproject(decode_depth(row["depth"], height, width), camera.intrinsics)
        oracle = points if self._cfg.point_map.encoder == "oracle" else None
        view = View(decode_png(row["image"]), camera, key_bodies_of(motion), oracle)
        objects = tuple(json.loads(row["objects"]))
        return ViewRow(view, motion, objects, decode_segmentation(row["segmentation"], height, width), points)

    def pairs(self, row: ViewRow, kinds: Sequence[str], count: int, rng: np.random.Generator) -> list[tuple[str, str]]:
        """Question and answer pairs about visible objects, at most `count`, drawn without repetition."""
        bodies = row.view.key_bodies
        assert bodies is not None
        found: list[tuple[str, str]] = []
        visible = [obj for obj in row.objects if int(obj["pixels"]) >= 6]
        for obj in visible:
            centre = np.asarray(obj["center_in_pelvis"], dtype=np.float64)
            for kind in kinds:
                answer = {
                    "side": lambda c=centre: side_answer(c),
                    "distance": lambda c=centre: distance_answer(c),
                    "height": lambda c=centre: height_answer(c),
                    "arm": lambda c=centre: arm_answer(c),
                    "shift": lambda c=centre: shift_answer(c, bodies),
                }[kind]()
                found.append((ask(kind, str(obj["id"]), self.style), answer))
        order = rng.permutation(len(found))[:count]
        return [found[i] for i in order]

    def listing(self, row: ViewRow) -> tuple[str, str]:
        """Image to text: the names of the objects in view, nearest to the top-left corner first."""
        visible = [obj for obj in row.objects if int(obj["pixels"]) >= 6]
        ordered = sorted(visible, key=lambda obj: (float(obj["bbox"][0]), float(obj["bbox"][1])))
        return ask("see", style=self.style), answers([str(obj["id"]) for obj in ordered][:8])


def _planning(
    row: Mapping[str, Any], motion: Sequence[int] | None, cfg: ModelConfig, right: Sequence[bool] = ()
) -> tuple[Message, ...]:
    """The planner's prompt of a row; `right` as `plan_prompt` takes it."""
    return plan_prompt(
        row["instruction"],
        row["robot"],
        row["visible"],
        row["known"],
        history_of(row),
        int(row["step"]),
        int(row["time_limit"]),
        motion,
        cfg.prompt,
        cfg.history,
        right,
    )


def step_in_words(
    row: Mapping[str, Any], motion: Sequence[int] | None, cfg: ModelConfig, right: Sequence[bool] = ()
) -> tuple[Message, ...]:
    """The planner's prompt of a row without its picture; `right` as `plan_prompt` takes it."""
    return _unpictured(_planning(row, motion, cfg, right))


def _unpictured(prompt: Sequence[Message]) -> tuple[Message, ...]:
    """The same prompt without the picture."""
    return tuple(replace(message, images=0) for message in prompt)


class _Logs:
    """Which steps of a row's log are what the expert would have done at their moments, so that they teach as the answer does.

    So a row teaches several steps for the price of one. What teaches nothing: a mistake, a moment without a recorded answer,
    one at which something had not been seen yet that the episode then used (the prompt would give it away), and one whose own
    log is cut off here.
    """

    def __init__(self, readers: Sequence[ShardReader]) -> None:
        columns = ["instruction", "robot", "step", "visible", "known", "history", "target"]
        self._rows = datasets.concatenate_datasets([reader.dataset.select_columns(columns) for reader in readers])

    def right(self, index: int) -> tuple[bool, ...]:
        """For each entry of the row's log; rows of an episode stand together, in order."""
        row: Mapping[str, Any] = self._rows[int(index)]
        log = row["history"]
        known = {*row["visible"], *row["known"]}
        used = {match[0] for match in OBJECT_ID.finditer(" ".join((*(item["step"] for item in log), row["target"])))}
        found = [False] * len(log)
        for before in range(int(index) - 1, max(int(index) - len(log), 0) - 1, -1):
            moment: Mapping[str, Any] = self._rows[before]
            back = int(row["step"]) - int(moment["step"])
            if not 0 < back <= len(log) or not _same_episode(row, moment, back):
                break
            fresh = known - {*moment["visible"], *moment["known"]}
            told = len(log) - back >= min(len(moment["history"]), _ENOUGH_LOG)
            found[-back] = told and moment["target"] == log[-back]["step"] and not fresh & used
        return tuple(found)


def _same_episode(row: Mapping[str, Any], moment: Mapping[str, Any], back: int) -> bool:
    """Whether a row is of the same episode, `back` steps earlier."""
    same = all(row[name] == moment[name] for name in ("instruction", "robot"))
    earlier = row["history"][:-back]
    return same and (not earlier or earlier[-1:] == moment["history"][-1:])


class _Joined:
    """Several `demos` folders read as one, in order."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._readers = [ShardReader(folder, "demos") for folder in folders]
        self._starts = np.cumsum([0, *(len(reader) for reader in self._readers)])

    def logs(self) -> _Logs:
        return _Logs(self._readers)

    def column(self, name: str) -> list[Any]:
        return [value for reader in self._readers for value in reader.column(name)]

    def folder_of(self) -> list[int]:
        """Number of the folder that each row comes from."""
        return [number for number, reader in enumerate(self._readers) for _ in range(len(reader))]

    def __getitem__(self, index: int) -> Mapping[str, Any]:
        which = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self._readers[which][int(index - self._starts[which])]


class Demos:
    """Expert steps: the planner's prompt and the step that the expert chose.

    Args:
        folder: demonstrations.
        cfg: the model's.
        more: further folders of the same kind (corrections); their rows follow.
        failures: whether there are episodes without success among them; those with it end in `Done`.
    """

    def __init__(self, folder: Path, cfg: ModelConfig, more: Sequence[Path] = (), failures: bool = False) -> None:
        self.reader = _Joined([folder, *more])
        self.split = _Split(self.reader.column("episode"), folder)
        self.motions = np.stack([decode_motion(m) for m in self.reader.column("motion")])  # (N, T, F)
        last: dict[str, tuple[int, int]] = {}
        for index, (episode, step) in enumerate(zip(self.reader.column("episode"), self.reader.column("step"), strict=True)):
            last[episode] = max(last.get(episode, (-1, -1)), (int(step), index))
        targets = self.reader.column("target")
        ends = [index for _, index in last.values() if not failures or targets[index] == "Done()"]
        #: Training rows of the last step of each episode that met its goals.
        self.finals = np.intersect1d(np.array(ends, dtype=np.int64), self.split.train)
        self.style: Style = cfg.prompt
        self._cfg, self._logs = cfg, self.reader.logs()
        labels = np.char.add(np.asarray(self.reader.column("category")), np.asarray(self.reader.folder_of(), dtype=str))
        labels = labels[self.split.train]
        self._groups = [self.split.train[labels == name] for name in sorted(set(labels))]
        self._symbolic = np.array([i for i in self.split.train if is_symbolic(targets[int(i)])], dtype=np.int64)

    def draw(self, rng: np.random.Generator, size: int) -> NDArray[np.int64]:
        """Training rows (size,), every category of every folder as often: there are fewer successes where tasks are harder."""
        chosen = rng.integers(len(self._groups), size=size)
        return np.array([rng.choice(self._groups[c]) for c in chosen], dtype=np.int64)

    def tokens(self, tokenizer: MotionTokenizer) -> NDArray[np.int64]:
        """Motion tokens (N, T / stride) of every row's window."""
        with torch.no_grad():
            device = tokenizer.mean.device
            newest = self.motions[:, -tokenizer.cfg.window :]
            parts = [torch.from_numpy(newest[i : i + 256]).to(device) for i in range(0, len(newest), 256)]
            return torch.cat([tokenizer.encode(part) for part in parts]).cpu().numpy()

    def example(self, index: int, motion: Sequence[int] | None, answered: bool = True) -> Example:
        """The step's conversation; `motion` None leaves proprioception out of the prompt."""
        row = self.reader[int(index)]
        prompt = _planning(row, motion, self._cfg, self._logs.right(index) if answered else ())
        return Example(with_answer(prompt, row["target"]) if answered else prompt, (self.view(row),))

    def text_step(self, rng: np.random.Generator, bodies: Bodies | None = None) -> Example:
        """A step without its picture, names exchanged (see `text_planning`); with `bodies` its motion stays."""
        index = int(rng.choice(self._symbolic))
        exchanged = Exchange.draw(rng).row(self.reader[index])
        motion = None if bodies is None else bodies.row(index)
        prompt = step_in_words(exchanged, motion, self._cfg, self._logs.right(index))
        return Example(with_answer(prompt, exchanged["target"]))

    def view(self, row: Mapping[str, Any]) -> View:
        """The head-camera view of a row."""
        bodies = np.asarray(row["key_bodies"], dtype=np.float64).reshape(KEY_BODY_COUNT, 3)
        return View(decode_png(row["image"]), _camera(row, row["camera_in_pelvis"]), bodies)

    def target(self, index: int) -> str:
        """The expert's step."""
        return str(self.reader[int(index)]["target"])


class Bodies:
    """Recorded motion for steps that have none: that of the same robot with the same hands open.

    Args:
        demos: whose training rows lend their motion.
        tokens: (N, T / stride) motion tokens of all rows.
    """

    def __init__(self, demos: Demos, tokens: NDArray[np.int64]) -> None:
        self._tokens = tokens
        self._rows: dict[tuple[str, bool, bool], NDArray[np.int64]] = {}
        robots = np.asarray(demos.reader.column("robot"))[demos.split.train]
        opened = demos.motions[demos.split.train, -1, HAND_OPENING] >= OPEN_HAND  # (N, 2)
        for robot, left, right in product(sorted(set(robots.tolist())), (False, True), (False, True)):
            chosen = demos.split.train[(robots == robot) & (opened == (left, right)).all(axis=1)]
            if len(chosen):
                self._rows[robot, left, right] = chosen
        #: Training rows of each robot with the same hands open.
        self.grips = list(self._rows.values())

    def row(self, index: int) -> list[int]:
        """A recorded step's own motion tokens."""
        return self._tokens[index].tolist()

    def draw(self, row: Mapping[str, Any], rng: np.random.Generator) -> list[int] | None:
        """Motion tokens for a step in words.

        None when its log is cut, so that its hands are not known, or when no recorded step shows its robot's hands so.
        """
        if len(row["history"]) < int(row["step"]):
            return None
        rows = self._rows.get((row["robot"], *open_hands(history_of(row))))
        return None if rows is None else self.row(int(rng.choice(rows)))


class TextPlanning:
    """Text-planning rows of shards (`sim.collection.text_planning` writes them), and logs with names exchanged.

    Args:
        folder: `text_planning` shards.
        cfg: the model's.
        demos: the logs.
        corrected: shards of the same kind, corrections in words; None leaves them out.
    """

    def __init__(self, folder: Path, cfg: ModelConfig, demos: Demos, corrected: Path | None = None) -> None:
        self.reader = ShardReader(folder, "text_planning")
        self._cfg, self._demos, self._logs = cfg, demos, _Logs([self.reader])
        dagger = None if corrected is None else ShardReader(corrected, "text_planning")
        self._corrected = None if dagger is None else (dagger, _Logs([dagger]))
        # rows of an episode stand together: the last ones are held out
        self._train = len(self.reader) - len(self.reader) // HELD_OUT
        self.test = np.arange(self._train, len(self.reader), dtype=np.int64)

    def draw(self, rng: np.random.Generator, bodies: Bodies | None = None) -> Example:
        """A training example; with `bodies` steps get motion whose hands agree with the log."""
        if self._corrected is not None and rng.random() < CORRECTED:
            reader, logs = self._corrected
            index = int(rng.integers(len(reader)))
            return self._step(reader[index], rng, bodies, logs.right(index))
        kind = rng.random()
        if kind < FROM_LOGS:
            return self._demos.text_step(rng, bodies)
        index = int(rng.integers(self._train))
        if kind < FROM_LOGS + NAMING:
            return self._naming(index)
        if kind < FROM_LOGS + NAMING + STATES:
            return self._state(index, rng)
        return self.example(index, rng, bodies)

    def _naming(self, index: int) -> Example:
        row = self.reader[index]
        prompt = named_prompt(row["instruction"], row["visible"], row["known"], self._cfg.prompt)
        return Example(with_answer(prompt, answers(row["named"])))

    def _state(self, index: int, rng: np.random.Generator) -> Example:
        row = self.reader[index]
        history = history_of(row)
        states = states_from_log(history)
        relation = asked_relation(states, rng)
        prompt = self_ask_prompt(relation, row["visible"], history, None, self._cfg.prompt)
        return Example(with_answer(_unpictured(prompt), answers(states[relation])))

    def example(self, index: int, rng: np.random.Generator, bodies: Bodies | None = None, answered: bool = True) -> Example:
        """One row's conversation; `rng` draws the motion that `bodies` lends."""
        return self._step(self.reader[int(index)], rng, bodies, self._logs.right(index) if answered else None)

    def _step(
        self, row: Mapping[str, Any], rng: np.random.Generator, bodies: Bodies | None, right: Sequence[bool] | None
    ) -> Example:
        motion = None if bodies is None else bodies.draw(row, rng)
        prompt = step_in_words(row, motion, self._cfg, right or ())
        return Example(prompt if right is None else with_answer(prompt, row["target"]))

    def target(self, index: int) -> str:
        """The right step."""
        return str(self.reader[int(index)]["target"])


class GoalQuestions:
    """Questions in text alone whether an instruction was carried out (`sim.collection.text_planning`)."""

    def __init__(self, folder: Path, cfg: ModelConfig) -> None:
        self.reader = ShardReader(folder, "goal_questions")
        self._cfg = cfg

    def draw(self, rng: np.random.Generator) -> Example:
        """A conversation with its answer."""
        row = self.reader[int(rng.integers(len(self.reader)))]
        prompt = critic_prompt(row["instruction"], row["visible"], history_of(row), None, self._cfg.prompt)
        return Example(with_answer(_unpictured(prompt), row["target"]))


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
