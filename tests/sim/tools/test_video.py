"""Films of episodes: frames between control ticks, nothing half-written, refused arguments."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from interface.steps import PlanStep
from sim.session.session import FreePlay, Session
from sim.tools.video import VideoRecorder, main


def test_a_step_is_filmed_smoothly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "walk.mp4"
    arguments = [f"out={path}", "robot=x1", "room=bathroom_1", "plan=[MoveAhead(0.3), RotateLeft(30)]", "size=64", "fps=20"]
    assert main([*arguments, "cameras=[behind, head]"]) == 0
    frames = np.asarray(iio.imread(path, plugin="pyav"))
    assert frames.shape[1:] == (64 + 28, 128, 3) and len(frames) > 20
    assert f"{len(frames)} frames" in capsys.readouterr().out
    steps = np.abs(np.diff(frames[:, :64].astype(int), axis=0)).mean(axis=(1, 2, 3))
    assert (steps > 0.05).sum() > 8 and steps.max() < 40.0
    assert [item.name for item in path.parent.iterdir()] == ["walk.mp4"]


def test_what_failed_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    steps = 'plan=["GoTo(Unicorn_1)", "RotateLeft(5)"]'
    assert main([f"out={tmp_path / 'a.mp4'}", steps, "cameras=[head]", "size=16", "fps=1"]) == 1
    assert capsys.readouterr().out.endswith("; failed: GoTo(Unicorn_1) ObjectNotKnown\n")


def test_a_film_that_is_broken_off_leaves_nothing(tmp_path: Path) -> None:
    session = Session("x1", image_size=0)
    session.reset(FreePlay("bathroom_1"), 0)
    with pytest.raises(RuntimeError, match="stop here"):
        _film_and_stop(session, tmp_path / "x.mp4")
    assert not list(tmp_path.iterdir()) and not session.watchers
    recorder = VideoRecorder(session, tmp_path / "y.mp4", ("behind",), 32)
    with pytest.raises(RuntimeError, match="one recorder films one episode"):
        _film_another(session, recorder)


def _film_and_stop(session: Session, path: Path) -> None:
    with VideoRecorder(session, path, ("behind",), 32):
        session.step(PlanStep.parse("RotateLeft(10)"))
        raise RuntimeError("stop here")


def _film_another(session: Session, recorder: VideoRecorder) -> None:
    with recorder:
        session.reset(FreePlay("bathroom_1"), 0)
        session.step(PlanStep.parse("RotateLeft(10)"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["out=x.avi", "plan=[MoveAhead]"], "out must end in .mp4"),
        (["out=x.mp4"], "give a plan, or a task"),
        (["out=x.mp4", "plan=[Fly(1)]"], "unknown action 'Fly'"),
        (["out=x.mp4", "task=nothing"], "unknown task 'nothing'"),
        (["out=x.mp4", "plan=[MoveAhead()]", "room=attic"], "unknown room 'attic'"),
        (["out=x.mp4", "plan=[MoveAhead()]", "robot=atlas"], "'atlas': no such robot"),
        (["out=x.mp4", "plan=[MoveAhead()]", "cameras=[nose]"], "must be some of head"),
        (["out=x.mp4", "plan=[MoveAhead()]", "size=33"], "size must be even"),
        (["out=x.mp4", "plan=[MoveAhead()]", "fps=0"], "fps 0 outside 1..50"),
    ],
)
def test_wrong_arguments(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert message in capsys.readouterr().err
