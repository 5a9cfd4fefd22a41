"""The command line: composition of every override that is allowed, and what is said about those that are not."""

from __future__ import annotations

from pathlib import Path

import pytest

import eval as command
from configs.compose import CONFIG_DIR, compose
from configs.schema.eval import EvalConfig
from configs.validate import build


@pytest.mark.parametrize("planner", sorted(path.stem for path in (CONFIG_DIR / "planner").glob("*.yaml")))
@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_every_planner_composes(planner: str, robot: str) -> None:
    needs = ["backend.model=folder", "workers=0"] if planner in ("qwen2_5_vl", "internvl2_5") else []
    needs += ["planner.source=own.py:Own"] if planner == "file" else []
    cfg = build(EvalConfig, compose("eval", [f"planner={planner}", f"robot={robot}", "difficulty=hard", "trials=3", *needs]))
    assert (cfg.planner.name, cfg.robot.name, cfg.difficulty, cfg.trials) == (planner, robot, "hard", 3)
    assert cfg.experiment is None


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONFIG_DIR / "experiment").glob("*.yaml")))
def test_every_experiment_composes_with_known_planners(name: str) -> None:
    cfg = build(EvalConfig, compose("eval", [f"experiment={name}"]))
    assert cfg.experiment is not None
    assert cfg.experiment.name == name
    assert all((CONFIG_DIR / "planner" / f"{planner}.yaml").is_file() for planner in cfg.experiment.planners)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("planer=proprio", "difficulty"),
        ("planner=gpt", "proprio_no_mpe"),
        ("robot=h2", "h1, x1"),
        ("difficulty=brutal", "easy, medium, hard"),
        ("category=both", "single, optional, essential"),
        ("start=anywhere", "fixed, turned, random"),
        ("split=test", "all, seen, unseen"),
        ("trials=0", "trials 0"),
        ("workers=-1", "workers -1"),
        ("limit=0", "limit 0"),
        ("retries=-2", "retries -2"),
        ("seed=-1", "seed -1"),
        ("trials=many", "many"),
        ("planner.image_size=big", "big"),
        ("tasks=/nowhere/tasks.jsonl", "nowhere"),
        ("robot.mjcf=/tmp/x.xml", "robot.spec"),
        ("robot.spec=typo.yaml", "allowed: h1, x1"),
    ],
)
def test_wrong_words_stop_with_what_is_allowed(
    override: str, said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert command.main(["planner=random", f"output={tmp_path}", override]) == 2
    assert said in capsys.readouterr().err.replace("\n", " ")
    assert not list(tmp_path.iterdir())


def test_absent_weights(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert command.main([f"planner.weights={tmp_path}/none", f"output={tmp_path}"]) == 1
    assert "train.py" in capsys.readouterr().err


def test_an_experiment_without_runs_prints_the_papers_rows(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert command.main(["experiment=main_table", f"output={tmp_path}"]) == 0
    assert "63.16" in capsys.readouterr().out


@pytest.mark.parametrize("override", ["planner=random", "experiment=main_table"])
def test_an_output_that_cannot_be_written_is_one_message(
    override: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    assert command.main([override, "limit=1", "workers=0", f"output={tmp_path / 'file'}"]) == 1
    assert f"eval.py: [Errno 20] Not a directory: '{tmp_path / 'file'}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "said"),
    [("{", "not JSON"), ("[]", "run version None is unknown"), ('{"version": 1}', "damaged: planner: Field required; label")],
)
def test_a_damaged_run_is_named(content: str, said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "eval" / "gpt4o-h1" / "run.json"
    path.parent.mkdir(parents=True)
    path.write_text(content)
    assert command.main(["experiment=main_table", f"output={tmp_path}"]) == 1
    assert f"eval.py: {path}: {said}" in capsys.readouterr().err
