"""One episode again in the browser: `python -m proprio_mllm report replay RUN TASK [trial=0] [pause=false] [speed=2]`.

The episode is acted out again from its trace, so no planner is needed. Before each step it waits for Enter; `c`
goes on without waiting, `q` ends. The terminal says the step, what became of it, and which goals hold.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from configs.arguments import read_named
from interface.failures import INVALID_OUTPUT
from proprio_mllm.report.reenact import Episode, Reenactment, RunTasks, find_record
from proprio_mllm.report.stored import load_run
from sim.play.live import LiveView

#: Letters of a reply.
_SHOWN = 80


@dataclass(frozen=True)
class ReplayConfig:
    """How an episode is shown.

    Attributes:
        trial: number of the trial.
        pause: whether to wait before each step.
        speed: simulated seconds per second.
    """

    trial: int = 0
    pause: bool = True
    speed: float = 2.0

    def __post_init__(self) -> None:
        if not 0.1 <= self.speed <= 1000.0:
            raise ValueError(f"speed {self.speed} outside 0.1..1000")


def replay(episode: Episode, config: ReplayConfig) -> int:
    """Shows an episode; the number of steps that went otherwise than in the ledger."""
    reenactment = Reenactment(episode)
    moments = reenactment.moments()
    next(moments)
    view, pause, differing = LiveView(reenactment.session, speed=config.speed), config.pause, 0
    sys.stdout.write(f"{view.url}\n{reenactment.session.task.instruction}\n")
    try:
        for number, entry in enumerate(episode.record.trace, 1):
            sys.stdout.write(f"{number}. {' '.join(str(entry['step']).split())[:_SHOWN]}")
            sys.stdout.flush()
            if pause:
                word = sys.stdin.readline()
                pause = word.strip() != "c" and word != ""
                if word.strip() == "q":
                    break
            moment = next(moments)
            view.show()
            said = INVALID_OUTPUT if moment.feedback is None else moment.feedback.to_text()
            other = " (differs from the ledger)" if moment.differs else ""
            differing += moment.differs
            sys.stdout.write(f"\n   {said}{other}; {sum(moment.goals)} of {len(moment.goals)} goals hold\n")
        else:
            sys.stdout.write(f"{episode.record.outcome.value}\n")
    finally:
        view.close()
    return differing


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments or what cannot be acted out."""
    try:
        (folder, task), config = read_named(ReplayConfig, arguments, ("RUN", "TASK"))
        run = load_run(Path(folder))
        replay(RunTasks(run).episode(find_record(run, task, config.trial)), config)
    except ValueError as error:
        sys.stderr.write(f"replay: {error}\n")
        return 2
    return 0
