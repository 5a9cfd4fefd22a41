"""Runs as one HTML page: `python -m proprio_mllm report html RUN [RUN ...] [out=FILE.html] [frames=all|failed|none]`.

The page holds everything itself (style, script, data, pictures as data URIs), so it opens from the file system without a
network. Its content security policy allows nothing else: no request, and no script but the page's own, known by its hash.
Whatever a model wrote is data in JSON and reaches the page as text only.

Every episode's steps and pictures lie in a script element of their own, which is read when the episode is opened; the list
draws the rows in view. The state of the page (filters, order, opened episode) is in the address after `#`, so that a view can
be linked.
"""

from __future__ import annotations

import base64
import hashlib
import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import jinja2

from configs.arguments import read_named
from configs.validate import ConfigError
from data.files import write_text
from interface.episode import EpisodeRecord, Outcome
from proprio_mllm.report.digest import episode_digest, run_digest
from proprio_mllm.report.frames import ActedOut, act_out, episode_id
from proprio_mllm.report.reenact import Episode, RunTasks, TaskGoneError
from proprio_mllm.report.references import references_of
from proprio_mllm.report.runs import run_notes
from proprio_mllm.report.stored import Run, load_run
from proprio_mllm.report.summary import Row

logger = logging.getLogger(__name__)

FrameChoice = Literal["all", "failed", "none"]
_FOLDER: Final = Path(__file__).parent


@dataclass(frozen=True)
class HtmlConfig:
    """What is shown.

    Attributes:
        out: the file; `report.html` in the run's folder by default, and needed for several runs.
        frames: episodes that are acted out again for their pictures and goals.
        size: side of the pictures, pixels.
        workers: processes that act out; 0 does it in this one.
    """

    out: str | None = None
    frames: FrameChoice = "all"
    size: int = 160
    workers: int = 2

    def __post_init__(self) -> None:
        if self.out is not None and not self.out.endswith(".html"):
            raise ValueError(f"out must end in .html, got {self.out!r}")
        if not 32 <= self.size <= 640:
            raise ValueError(f"size {self.size} outside 32..640 pixels")
        if not 0 <= self.workers <= 256:
            raise ValueError(f"workers {self.workers} outside 0..256")


@dataclass(frozen=True, slots=True)
class RunData:
    """One run as the page takes it.

    Attributes:
        about: see `run_digest`.
        rows: figures per category.
        notes: what to know about the run.
        episodes: see `episode_digest`, scored ones in planned order, then attempts that broke.
        acted: acted-out episodes by id.
    """

    about: Mapping[str, Any]
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    episodes: tuple[Mapping[str, Any], ...]
    acted: Mapping[str, ActedOut]


def run_data(run: Run, frames: FrameChoice, size: int = 160, workers: int = 2) -> RunData:
    """Everything about a run, acting out what was asked for.

    Args:
        run: the run.
        frames: which episodes are acted out.
        size: side of the pictures, pixels.
        workers: processes; 0 acts out in this one.

    Raises:
        ValueError: when the run's configuration or its file of tasks cannot be read.
    """
    tasks = RunTasks(run)
    wanted: list[Episode] = []
    notes: dict[str, str] = {}
    for record in run.records:
        if frames == "none" or (frames == "failed" and record.outcome is Outcome.SUCCESS):
            continue
        try:
            wanted.append(tasks.episode(record))
        except TaskGoneError as error:
            notes[episode_id(record)] = str(error)
    acted = act_out([(run.folder, episode) for episode in wanted], size, workers)

    def digest(record: EpisodeRecord) -> dict[str, Any]:
        name = episode_id(record)
        return episode_digest(record, tasks.get(record), acted.get(name), notes.get(name, ""))

    episodes = tuple(digest(record) for record in (*run.records, *run.broken))
    return RunData(run_digest(run), tuple(run.rows(references_of(run))), tuple(run_notes(run)), episodes, acted)


#: What the list and its filters need of an episode; the rest is read when it is opened.
_LISTED: Final = (
    "id", "task", "instruction", "category", "family", "room", "robot", "outcome", "failure", "goal_conditions_met", "steps",
    "in_time",
    "makespan_s", "trial",
)  # fmt: skip


def page(runs: Sequence[RunData]) -> str:
    """The page of one or several runs; equal runs give equal bytes."""
    listed: list[dict[str, Any]] = []
    details: list[dict[str, Any]] = []
    for number, run in enumerate(runs):
        for episode in run.episodes:
            codes = sorted({outcome["code"] for step in episode["trace"] for outcome in step["outcomes"] if outcome["code"]})
            listed.append({name: episode[name] for name in _LISTED} | {"run": number, "codes": " ".join(codes)})
            acted = run.acted.get(episode["id"])
            shown = {"images": [], "shown": []} if acted is None else {"images": acted.images, "shown": acted.shown}
            details.append({**episode, **shown})
    style, script = ((_FOLDER / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    policy = f"default-src 'none'; img-src data:; style-src '{_hash(style)}'; script-src '{_hash(script)}'"
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER), undefined=jinja2.StrictUndefined, autoescape=True, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.policies["json.dumps_kwargs"] = {"ensure_ascii": False, "separators": (",", ":"), "allow_nan": False}
    names = [str(run.about["title"]) for run in runs]
    return environment.get_template("page.html.jinja").render(
        title=names[0] if len(names) == 1 else f"{len(names)} runs",
        names=names,
        policy=policy,
        style=style,
        script=script,
        runs=runs,
        listed=listed,
        details=details,
    )


def _hash(text: str) -> str:
    """A source of a content security policy: the hash of an inline element."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments or what is no run."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        folders, config = read_named(HtmlConfig, arguments, ("RUN",), more=True)
        if config.out is None and len(folders) > 1:
            raise ConfigError(f"{len(folders)} runs need out=FILE.html")
        runs = [load_run(Path(folder)) for folder in folders]
        text = page([run_data(run, config.frames, config.size, config.workers) for run in runs])
    except ValueError as error:
        sys.stderr.write(f"html: {error}\n")
        return 2
    out = Path(config.out or Path(folders[0]) / "report.html")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text(out, text)
    sys.stdout.write(f"{out}\n")
    return 0
