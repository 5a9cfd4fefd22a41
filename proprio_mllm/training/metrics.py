"""The one writer of training metrics: CSV beside the checkpoints, the terminal, and W&B (offline unless asked otherwise)."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from configs.schema.train import LoggerConfig
from data.files import write_text

logger = logging.getLogger(__name__)


class MetricWriter:
    """Writes rows of metrics; columns may grow from row to row.

    Args:
        folder: receives `metrics.csv`, and W&B's offline files.
        name: run name.
        cfg: W&B mode; nothing leaves the machine unless it is `online`.
        config: shown by W&B beside the run.
    """

    def __init__(self, folder: Path, name: str, cfg: LoggerConfig, config: Mapping[str, Any] | None = None) -> None:
        self._path = Path(folder) / "metrics.csv"
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._rows: list[dict[str, str]] = []
        if self._path.is_file():
            with self._path.open(newline="", encoding="utf-8") as handle:
                self._rows = list(csv.DictReader(handle))
        self._run: Any = None
        if cfg.wandb != "disabled":
            import wandb

            self._run = wandb.init(
                project=cfg.project,
                name=name,
                dir=str(folder),
                mode=cfg.wandb,
                config=dict(config or {}),
                settings=wandb.Settings(console="off", silent=True),
            )

    def discard_after(self, step: int) -> None:
        """Drops rows beyond a step, which a resumed run writes again."""
        self._rows = [row for row in self._rows if int(row.get("step") or 0) <= step]

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Adds one row."""
        row = {"step": str(step), **{name: f"{value:.6g}" for name, value in values.items()}}
        self._rows.append(row)
        columns = list(dict.fromkeys(name for one in self._rows for name in one))
        text = io.StringIO(newline="")
        table = csv.DictWriter(text, columns)
        table.writeheader()
        table.writerows(self._rows)
        write_text(self._path, text.getvalue())
        if self._run is not None:
            self._run.log(dict(values), step=step)

    def close(self) -> None:
        """Ends the W&B run."""
        if self._run is not None:
            self._run.finish()
            self._run = None
