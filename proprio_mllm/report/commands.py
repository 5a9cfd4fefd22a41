"""Reports on what exists: `python -m proprio_mllm report` lists them.

`compare` sets two planners side by side on the same body, tasks and contingencies, or two ways to train, each by the runs of
its trainings (RUN,RUN,RUN); `gap` sets one planner on two bodies side by side; `write` writes a run's `summary.json` and tables
again, for example after the run at `difficulty=easy` that its regret needs.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich.console import Console

from configs.arguments import NoOptions, dispatch, read_named
from configs.schema.checks import require
from data.files import write_text
from proprio_mllm.report.comparison import RunComparison, compare_bodies, compare_runs, comparison_table
from proprio_mllm.report.runs import write_report
from proprio_mllm.report.stored import Run, load_run
from proprio_mllm.report.table import Table
from proprio_mllm.report.trainings import compare_trainings

_HERE: Final = "proprio_mllm.report.commands"
COMMANDS: Final = {
    "compare": (_HERE, "two planners, in pairs: RUN RUN; or trainings: RUN,RUN RUN,RUN"),
    "gap": (_HERE, "one planner on two bodies: RUN_H1 RUN_X1"),
    "write": (_HERE, "a run's summary and tables again: RUN"),
    "html": ("proprio_mllm.report.html", "runs as one page with every episode: RUN ..."),
    "strip": ("proprio_mllm.report.strip", "one episode as a strip of pictures: RUN TASK"),
    "video": ("proprio_mllm.report.video", "one episode as a film: RUN TASK"),
    "replay": ("proprio_mllm.report.replay", "one episode again in the browser, step by step: RUN TASK"),
    "export": ("proprio_mllm.report.export", "runs as training rows or JSON lines: RUN ..."),
    "curves": ("proprio_mllm.report.curves", "learning curves of training: FOLDER ..."),
    "tokenizers": ("proprio_mllm.report.tokenizer", "what motion tokenizers keep: TOKENIZER ..."),
    "reconstruction": (
        "proprio_mllm.report.reconstruction",
        "picture of motions before and after a tokenizer: TOKENIZER CLIPS",
    ),
    "filter": ("data.filter_table", "what the motion filters dropped: FOLDER"),
    "retarget": ("data.retarget_report", "quality of retargeting"),
    "replies": ("proprio_mllm.backends.cache", "recorded replies of language models: FILE"),
}
_PAIRED: Final[Mapping[str, Callable[[Run, Run], RunComparison]]] = {"compare": compare_runs, "gap": compare_bodies}
_FORMATS: Final[Mapping[str, Callable[[Table], str]]] = {
    ".md": Table.to_markdown,
    ".csv": Table.to_csv,
    ".tex": Table.to_latex,
}


@dataclass(frozen=True)
class PairOptions:
    """What `compare` and `gap` take besides the two runs.

    Attributes:
        json: print one JSON object, with every pair of episodes.
        out: file to write to; its ending, .md, .csv, .tex or .json, says how.
    """

    json: bool = False
    out: str = ""

    def __post_init__(self) -> None:
        endings = (*_FORMATS, ".json")
        require(not self.out or Path(self.out).suffix in endings, f"out={self.out}: endings are {', '.join(endings)}")


def _text(table: Table, result: RunComparison | None, suffix: str) -> str:
    if suffix != ".json":
        return _FORMATS[suffix](table)
    if result is None:
        raise ValueError(f"JSON is of two runs; a table of trainings is written as {', '.join(_FORMATS)}")
    return json.dumps(result.to_json(), indent=1, ensure_ascii=False) + "\n"


def _pair(command: str, arguments: Sequence[str]) -> None:
    named, options = read_named(PairOptions, arguments, ("RUN_A", "RUN_B"))
    firsts, seconds = ([load_run(Path(folder)) for folder in one.split(",")] for one in named)
    several = len(firsts) + len(seconds) > 2
    if several and command != "compare":
        raise ValueError(f"{command} takes one run a side, got {', '.join(named)}")
    result = None if several else _PAIRED[command](firsts[0], seconds[0])
    table = compare_trainings(firsts, seconds) if result is None else comparison_table(result)
    if options.out:
        out = Path(options.out)
        out.parent.mkdir(parents=True, exist_ok=True)
        write_text(out, _text(table, result, out.suffix))
    if options.json:
        sys.stdout.write(_text(table, result, ".json"))
    else:
        table.show()


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments or runs that cannot be compared."""
    command, *rest = arguments or [""]
    if COMMANDS.get(command, ("",))[0] != _HERE:
        return dispatch("python -m proprio_mllm report", COMMANDS, arguments)
    try:
        if command == "write":
            (run,), _ = read_named(NoOptions, rest, ("RUN",))
            write_report(load_run(Path(run))).show()
        else:
            _pair(command, rest)
    except ValueError as error:
        Console(stderr=True, highlight=False).print(f"report: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0
