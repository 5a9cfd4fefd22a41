"""How episodes are spread: over processes of this machine or of a Ray cluster, with a model in each, or one that many ask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from configs.schema.checks import require

SchedulerName = Literal["local", "ray"]


@dataclass(frozen=True, kw_only=True)
class Execution:
    """Who runs episodes. Results depend on it by the rounding of batches alone.

    Attributes:
        workers: processes; 0 runs in this one.
        scheduler: who runs the workers: `local` this machine's process pool, `ray` a Ray instance or cluster.
        ray_address: a running cluster's address; None starts Ray on this machine for the run.
        batch: planner calls answered together, for models in this project's processes. Above 1, `workers=0` runs so many
            episodes side by side, and otherwise a process for every GPU, or one, holds the model and answers the workers.
        retries: how often an episode with an infrastructure error is run again.
    """

    workers: int = 2
    scheduler: SchedulerName = "local"
    ray_address: str | None = None
    batch: int = 1
    retries: int = 1

    def __post_init__(self) -> None:
        require(0 <= self.workers <= 4096, f"workers {self.workers} outside [0, 4096]")
        require(1 <= self.batch <= 1024, f"batch {self.batch} outside [1, 1024]")
        require(self.scheduler == "local" or self.workers > 0, f"workers {self.workers} must be positive with scheduler=ray")
        require(
            self.scheduler == "ray" or self.ray_address is None,
            f"ray_address {self.ray_address!r} needs scheduler=ray, got {self.scheduler!r}",
        )
        require(self.retries >= 0, f"retries {self.retries} must not be negative")
