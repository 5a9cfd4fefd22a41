"""Learning curves of training loops: `python -m proprio_mllm report curves FOLDER [FOLDER ...] [out=FILE.png]`.

FOLDER is an output of training, or a part of one; every `metrics.csv` below it is a panel: the loss, and what is a share of
answers, in percent of its own axis. A row of the file is the mean since the row before.
"""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from configs.arguments import command, read_named
from proprio_mllm.report.figures import new_figure, save_figure

#: Columns that are shares of what was asked.
_SHARES: Final = ("exact", "accuracy")
_PER_LINE: Final = 3


def read_metrics(path: Path) -> dict[str, NDArray[np.float64]]:
    """Columns of a `metrics.csv`, each (rows,); NaN where a row has none.

    Raises:
        ValueError: when the file has no row or a cell is no number; the message names the file.
    """
    with path.open(newline="", encoding="utf-8") as handle:
        rows = list(csv.DictReader(handle))
    if not rows or not {"step", "loss"} <= set(rows[0]):
        raise ValueError(f"{path}: no metrics of training, expected columns `step` and `loss` and at least one row")
    try:
        columns = {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
    if not np.isfinite([columns["step"], columns["loss"]]).all():
        raise ValueError(f"{path}: a row without a number for `step` and `loss`")
    return columns


def draw_curves(loops: Mapping[str, Mapping[str, NDArray[np.float64]]], path: Path) -> Path:
    """Writes one panel per loop.

    Args:
        loops: columns of each loop's metrics, by its title.
        path: file to write.
    """
    lines = -(-len(loops) // _PER_LINE)
    figure, panels = new_figure(4.2 * min(len(loops), _PER_LINE), 3.0 * lines, min(len(loops), _PER_LINE), lines)
    for axes in panels[len(loops) :]:
        axes.axis("off")
    for axes, (title, columns) in zip(panels, loops.items(), strict=False):
        steps, share = columns["step"], axes.twinx()
        axes.plot(steps, columns["loss"], color="#bbbbbb", label="loss")
        for name in columns:
            if name.endswith(_SHARES):
                told = ~np.isnan(columns[name])
                share.plot(steps[told], 100 * columns[name][told], label=name.replace("_", " "))
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("step", fontsize=8)
        axes.set_ylabel("loss", fontsize=8)
        axes.set_ylim(0, 1.05 * float(np.percentile(columns["loss"], 98)))
        share.set_ylim(0, 100)
        share.set_ylabel("right, %", fontsize=8)
        axes.tick_params(labelsize=7)
        share.tick_params(labelsize=7)
        share.set_visible(bool(share.lines))
        handles = [handle for one in (axes, share) for handle in one.get_legend_handles_labels()[0]]
        axes.legend(handles=handles, fontsize=7, frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    return save_figure(figure, path, "Loss and share of right answers on batches as they were trained, means between logs.")


@dataclass(frozen=True)
class CurvesConfig:
    """Where the picture goes.

    Attributes:
        out: file to write.
    """

    out: str = "outputs/look/curves.png"


def _title(loop: Path, whole: Path) -> str:
    """A loop's place below the folder that holds all of them; that folder's name for itself."""
    name = loop.relative_to(whole)
    name = name.parent if name.name == "loop" else name
    return str(name) if name.parts else whole.name


@command(ValueError, OSError)
def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments or without metrics."""
    folders, config = read_named(CurvesConfig, arguments, ("FOLDER",), more=True)
    found = [path for folder in folders for path in sorted(Path(folder).rglob("metrics.csv"))]
    if not found:
        raise ValueError(f"{', '.join(folders)}: no metrics.csv here; expected a folder of training, for example outputs/tiny")
    whole = Path(os.path.commonpath([Path(folder).resolve() for folder in folders]))
    loops = {_title(path.resolve().parent, whole): read_metrics(path) for path in found}
    out = Path(config.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    sys.stdout.write(f"{draw_curves(loops, out)}\n")
    return 0
