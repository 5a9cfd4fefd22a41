"""Video of an episode: `python -m sim video out=open.mp4 robot=h1 plan='[GoTo(Microwave_1), "Open(left, Microwave_1)"]'`.

Frames are taken between control ticks while skills run, so motion is smooth; the step and what became of it are written below.
With `task=ID` and no plan the expert acts. The file is written under a temporary name and renamed when it is complete. Encoding
is PyAV's (H.264), through imageio, because ffmpeg inside a wheel needs nothing of the system.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from configs.arguments import command, read_arguments
from configs.validate import ConfigError, allowed_values
from interface.bodies import DEFAULT_ROBOT
from interface.feedback import Feedback
from interface.steps import ActionError, PlanStep
from sim.expert.expert import Expert
from sim.session.session import FreePlay, Session, TaskLike
from sim.skills.runner import CONTROL_DT_S
from sim.tasks.task import load_benchmark
from sim.world.rendering import CAMERAS, Renderer
from sim.world.world import World

_CAPTION_PX: Final = 28
_HOLD_S: Final = 0.5


@dataclass(frozen=True)
class VideoConfig:
    """What is filmed.

    Attributes:
        out: the file, `.mp4`.
        robot: robot name.
        room: room name; ignored with a task.
        task: id of a benchmark task; None plays freely in the room.
        plan: steps in the grammar; without any the expert solves the task.
        cameras: cameras side by side.
        size: side of each picture, pixels, even.
        fps: pictures per simulated second, at most 50.
        pretty: a lamp with shadows and smooth edges, but in the head's pictures, which stay what a planner sees.
        difficulty: easy, medium, hard or natural.
        seed: key of the contingencies.
    """

    out: str
    robot: str = DEFAULT_ROBOT
    room: str = "kitchen_1"
    task: str | None = None
    plan: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ("behind", "head")
    size: int = 400
    fps: int = 25
    pretty: bool = True
    difficulty: str = "easy"
    seed: int = 0

    def __post_init__(self) -> None:
        check_film(self.out, self.cameras, self.size, self.fps)
        if not self.plan and self.task is None:
            raise ValueError("give a plan, or a task that the expert solves")


def check_film(out: str, cameras: Sequence[str], size: int, fps: int) -> None:
    """Refuses films that cannot be made.

    Raises:
        ValueError: naming the value and what is allowed.
    """
    if not out.endswith(".mp4"):
        raise ValueError(f"out must end in .mp4, got {out!r}")
    unknown = [name for name in cameras if name not in CAMERAS]
    if unknown or not cameras:
        raise ValueError(f"cameras {list(cameras)} must be some of {', '.join(CAMERAS)}")
    if size % 2 or not 16 <= size <= 1280:
        raise ValueError(f"size must be even and within 16..1280, got {size}")
    if not 1 <= fps <= 50:
        raise ValueError(f"fps {fps} outside 1..50")


class VideoRecorder:
    """Films a session while it is open.

    Args:
        session: a session with a running episode.
        path: the `.mp4` file; it appears when the recorder is closed without an error.
        cameras, size, fps, pretty: as in `VideoConfig`.

    Attributes:
        frames: how many have been written.
    """

    def __init__(
        self,
        session: Session,
        path: str | Path,
        cameras: Sequence[str] = ("behind", "head"),
        size: int = 400,
        fps: int = 25,
        pretty: bool = True,
    ) -> None:
        self._session, self._path = session, Path(path)
        self._cameras, self._fps = tuple(cameras), fps
        plain, lit = (Renderer(session.world.scene, size, size, pretty=wanted) for wanted in (False, pretty))
        self._renderers = {camera: plain if camera == "head" else lit for camera in self._cameras}
        self._world = session.world
        self._font = ImageFont.load_default(15)
        self._temporary = self._path.with_name(f".{self._path.stem}.{os.getpid()}.mp4")
        self._file: Any = None
        self._bar: Any = None
        self._due_s = 0.0
        self.frames = 0

    def __enter__(self) -> VideoRecorder:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._file = iio.imopen(self._temporary, "w", plugin="pyav")
        self._file.init_video_stream("libx264", fps=self._fps, pixel_format="yuv420p")
        self._bar = tqdm(desc=self._path.name, unit="frame", disable=None, leave=False)  # shown at a terminal alone
        self._session.watchers.append(self._tick)
        self.hold(_HOLD_S, self._session.task.instruction)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._session.watchers.remove(self._tick)
        self._file.close()
        self._bar.close()
        if kind is None:
            self._temporary.replace(self._path)
        else:
            self._temporary.unlink(missing_ok=True)

    def hold(self, seconds: float, caption: str) -> None:
        """Shows the scene as it is for a while."""
        picture = self._picture(caption)
        for _ in range(max(1, round(seconds * self._fps))):
            self._write(picture)

    def _tick(self, world: World, text: str) -> None:
        if world is not self._world:
            raise RuntimeError("the session was reset while it was filmed: one recorder films one episode")
        self._due_s -= CONTROL_DT_S
        if self._due_s <= 1e-9:
            self._due_s += 1.0 / self._fps
            self._write(self._picture(text))

    def _picture(self, caption: str) -> NDArray[np.uint8]:
        views = np.concatenate([self._renderers[camera].view(camera).rgb for camera in self._cameras], axis=1)
        bar = Image.new("RGB", (views.shape[1], _CAPTION_PX), (24, 24, 28))
        ImageDraw.Draw(bar).text((8, 5), caption, fill=(240, 240, 240), font=self._font)
        return np.concatenate([views, np.asarray(bar, dtype=np.uint8)], axis=0)

    def _write(self, picture: NDArray[np.uint8]) -> None:
        self._file.write_frame(picture)
        self.frames += 1
        self._bar.update(1)


def _task(config: VideoConfig) -> TaskLike:
    if config.task is None:
        return FreePlay(config.room, instruction=config.room.replace("_", " "))
    tasks = {task.id: task for task in load_benchmark()}
    if config.task not in tasks:
        raise ConfigError(f"unknown task {config.task!r}; {allowed_values(config.task, tuple(tasks))}")
    return tasks[config.task]


def film(config: VideoConfig) -> tuple[int, tuple[str, ...]]:
    """Plays an episode and films it.

    Returns:
        The number of frames, and what failed: steps with their codes; with an expert, whose failures are part of its way, the
        task where its goals do not hold in the end.

    Raises:
        ConfigError: on an unknown task.
        ActionError: on a step outside the grammar; before anything is filmed.
        ValueError: on an unknown robot, room or difficulty.
    """
    plan = [PlanStep.parse(text) for text in config.plan]
    task = _task(config)
    session = Session(config.robot, config.difficulty, image_size=0)
    session.reset(task, config.seed)
    failed: list[str] = []
    with VideoRecorder(session, config.out, config.cameras, config.size, config.fps, config.pretty) as video:
        if plan:
            for step in plan:
                feedback = _act(session, step, video)
                failed += [] if feedback.success else [feedback.to_text()]
        else:
            expert = Expert(session)
            expert.reset()
            while not session.finished:
                _act(session, expert.next_step(), video)
            failed += [] if session.succeeded else [config.task or config.room]
    session.close()
    return video.frames, tuple(failed)


def _act(session: Session, step: PlanStep, video: VideoRecorder) -> Feedback:
    _, feedback = session.step(step)
    video.hold(_HOLD_S, feedback.to_text())
    return feedback


@command(ActionError, ValueError)
def main(arguments: Sequence[str]) -> int:
    """Command line; returns 0 when every step succeeded, 1 when one failed, 2 on wrong arguments."""
    config = read_arguments(VideoConfig, arguments)
    frames, failed = film(config)
    sys.stdout.write(
        f"{config.out}: {frames} frames, {frames / config.fps:.1f} s{'; failed: ' * bool(failed)}{', '.join(failed)}\n"
    )
    return 1 if failed else 0
