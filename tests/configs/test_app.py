"""The entry points as Hydra applications: flags, sweeps, exit codes, and what a mistake is told."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import eval as evaluation
import train
from configs.app import run_app
from configs.schema.eval import EvalConfig

ROOT = Path(__file__).parents[2]


def _jobs(arguments: list[str], code: int = 0) -> tuple[int, list[EvalConfig]]:
    """Exit code of a command line, and the configurations that reached the job."""
    seen: list[EvalConfig] = []

    def job(cfg: EvalConfig) -> int:
        seen.append(cfg)
        return code

    return run_app("eval", EvalConfig, job, "About.", arguments), seen


def test_one_job_gets_a_frozen_dataclass_and_gives_its_exit_code() -> None:
    code, seen = _jobs(["planner=random", "trials=3"], code=1)
    assert code == 1
    assert [(cfg.planner.name, cfg.trials) for cfg in seen] == [("random", 3)]


def test_a_sweep_runs_every_combination(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, seen = _jobs(["-m", "planner=random,scripted", "robot=h1,x1", "planner.image_size=64"])
    assert code == 0
    assert [(cfg.planner.name, cfg.robot.name) for cfg in seen] == [
        ("random", "h1"), ("random", "x1"), ("scripted", "h1"), ("scripted", "x1"),
    ]  # fmt: skip
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")] == ["outputs/multirun/multirun.yaml"]


def test_a_sweep_ends_with_the_code_of_a_failed_job_after_all_have_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code, seen = _jobs(["-m", "planner=random", "robot=h1,x1"], code=1)
    assert (code, len(seen)) == (1, 2)
    assert "exit code 1 of the job planner=random robot=h1" in capsys.readouterr().err


def test_one_run_writes_nothing_of_hydras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert _jobs(["planner=random"])[0] == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("main", "key"), [(evaluation.main, "planner"), (train.main, "alignment")])
def test_cfg_job_prints_what_would_run(main, key: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--cfg", "job", "seed=7"]) == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    assert shown["seed"] == 7
    assert key in shown


def test_a_folder_of_groups_can_be_added(tmp_path: Path) -> None:
    (tmp_path / "planner").mkdir()
    (tmp_path / "planner" / "mine.yaml").write_text("name: mine\nkind: random\nlabel: Mine\n")
    code, seen = _jobs(["--config-dir", str(tmp_path), "planner=mine"])
    assert code == 0
    assert seen[0].planner.label == "Mine"


def test_a_mistake_beside_a_folder_of_groups_blames_no_group_of_it(tmp_path: Path, capsys) -> None:
    (tmp_path / "planner").mkdir()
    (tmp_path / "planner" / "mine.yaml").write_text("name: mine\nkind: random\nlabel: Mine\n")
    assert _jobs(["--config-dir", str(tmp_path), "planner=mine", "trails=2"]) == (2, [])
    assert "did you mean 'trials'?" in capsys.readouterr().err
    assert _jobs([f"--config-dir={tmp_path}", "planner=mine", "trails=2"]) == (2, [])
    assert "did you mean 'trials'?" in capsys.readouterr().err
    assert _jobs([f"--config-dir={tmp_path}", "planner=mne"]) == (2, [])
    assert "did you mean 'mine'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "near"),
    [
        ("planner=scrpted", "scripted"),
        ("difficulty=hrad", "hard"),
        ("trails=2", "trials"),
        ("planner.image_sise=64", "image_size"),
        ("split=unsen", "unseen"),
    ],
)
def test_a_mistake_names_the_nearest(override: str, near: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, seen = _jobs(["planner=random", override] if "planner=" not in override else [override])
    assert (code, seen) == (2, [])
    assert f"did you mean {near!r}?" in capsys.readouterr().err


def test_a_mistake_costs_little_time_and_no_traceback() -> None:
    done = subprocess.run(
        [sys.executable, "eval.py", "planner=scrpted"], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
