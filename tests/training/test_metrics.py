"""The metric writer: growing columns, resumed files, and W&B without a network."""

from __future__ import annotations

from pathlib import Path

import pytest

from configs.schema.train import LoggerConfig
from proprio_mllm.training.metrics import MetricWriter


def test_columns_grow_and_rows_are_replaced_after_a_resume(tmp_path: Path) -> None:
    writer = MetricWriter(tmp_path, "run", LoggerConfig("disabled"))
    writer.write(5, {"loss": 2.0})
    writer.write(10, {"loss": 1.0, "accuracy": 0.5})
    again = MetricWriter(tmp_path, "run", LoggerConfig("disabled"))
    again.discard_after(5)
    again.write(10, {"loss": 0.5})
    assert (tmp_path / "metrics.csv").read_text().split() == ["step,loss,accuracy", "5,2,", "10,0.5,"]


def test_wandb_is_offline_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import wandb

    seen: dict[str, object] = {}

    class Run:
        def log(self, values: dict[str, float], step: int) -> None:
            seen["logged"] = (values, step)

        def finish(self, exit_code: int | None = None) -> None:
            seen["finished"] = True

    monkeypatch.setattr(wandb, "init", lambda **kwargs: seen.update(kwargs) or Run())
    writer = MetricWriter(tmp_path, "run", LoggerConfig(), {"seed": 0})
    writer.write(1, {"loss": 1.0})
    writer.close()
    assert seen["mode"] == "offline"
    assert seen["logged"] == ({"loss": 1.0}, 1)
    assert seen["finished"]
