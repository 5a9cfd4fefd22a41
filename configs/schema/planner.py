"""Frozen configuration of planners: one dataclass for each kind, with what that kind reads and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, get_args, get_type_hints

from configs.schema.checks import require

BlindName = Literal["none", "image", "motion", "both"]
ReflectionName = Literal["on", "off"]


@dataclass(frozen=True)
class PlannerConfig:
    """One planner.

    Attributes:
        name: name in commands, ledgers and tables.
        kind: what plans.
        label: name printed in tables.
    """

    name: str
    kind: str
    label: str

    def __post_init__(self) -> None:
        require(self.name.isidentifier(), f"planner name {self.name!r} must be an identifier")


@dataclass(frozen=True)
class BuiltInPlanner(PlannerConfig):
    """Needs nothing: `random` draws legal actions, `scripted` follows rules, `expert` looks into the simulator (privileged).

    Attributes:
        image_size: side of the head view in pixels, 0 for none; other planners bring their own, or have `backend.image_size`.
    """

    kind: Literal["random", "scripted", "expert"]
    image_size: int = 112

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.image_size == 0 or 16 <= self.image_size <= 2048,
            f"image_size {self.image_size} outside [16, 2048]; 0 takes none",
        )


@dataclass(frozen=True)
class ModelPlanner(PlannerConfig):
    """A stored model.

    Attributes:
        weights: folder of the stored model.
        adapter: adapter to activate; None takes the stored model's first.
        train: command that makes the weights, for the message when they are absent.
        temperature: 0 takes the most likely token.
        insist: whether it may take steps that are bound to be refused by what its log tells of hands and states, look for
            something where it has been or nothing lies, walk to a thing a fourth time with no arm having tried it, end the
            task with a step that did nothing, and take a third time what was refused twice.
        blind: hides the picture, the robot's own body, or both (`proprio_mllm.evaluation.showing`).
        reflection: whether failures are reflected on: a stored model says of what type they are and what changes before it
            plans; planners that ask a backend ask once more for cause, change and new steps.
    """

    kind: Literal["mllm"]
    weights: str
    adapter: str | None = None
    train: str = ""
    temperature: float = 0.0
    insist: bool = False
    blind: BlindName = "none"
    reflection: ReflectionName = "on"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.temperature >= 0.0, f"temperature {self.temperature} must not be negative")


@dataclass(frozen=True)
class AskingPlanner(PlannerConfig):
    """What planners that ask the run's backend in chats have in common.

    Attributes:
        blind: hides the picture, the robot's own body, or both.
        reflection: `on` asks once more after a failure for cause, change and new steps.
        replans: most re-plans, reflecting or not, of an episode.
        history: steps of the log in a prompt.
        body: whether a prompt tells proprioception in words; the paper's baselines have none.
    """

    blind: BlindName = "none"
    reflection: ReflectionName = "on"
    replans: int = 5
    history: int = 20
    body: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, low in (("replans", 0), ("history", 1), ("horizon", 1), ("examples", 1)):
            value = getattr(self, name, low)
            require(value >= low, f"{name} {value} must be at least {low}")


@dataclass(frozen=True)
class PlainPlanner(AskingPlanner):
    """Plain prompting.

    Attributes:
        horizon: steps of a reply that are carried out before it asks again.
    """

    kind: Literal["plain"]
    horizon: int = 1


@dataclass(frozen=True)
class MemoryPlanner(AskingPlanner):
    """LLM-Planner and RAP, which are shown solved tasks.

    Attributes:
        examples: tasks taken from memory.
        memory: folder of the memory, made by `python -m proprio_mllm memory`.
    """

    kind: Literal["llm_planner", "rap"]
    examples: int = field(kw_only=True)
    memory: str = field(kw_only=True)


@dataclass(frozen=True)
class GraphPlanner(AskingPlanner):
    """DAG-Plan.

    Attributes:
        parallel: whether both arms may be used in one step; false does one node at a time.
    """

    kind: Literal["dag_plan"]
    parallel: bool = True


@dataclass(frozen=True)
class FilePlanner(AskingPlanner):
    """A class in a Python file of the user's; what the fields of `AskingPlanner` say, and `horizon`, it is told with a backend.

    Attributes:
        source: `FILE.py:CLASS`.
        horizon: steps of a reply that are carried out before it asks again.
    """

    kind: Literal["file"]
    source: str = field(kw_only=True)
    horizon: int = 1


ChatPlanner = PlainPlanner | MemoryPlanner | GraphPlanner
AnyPlanner = BuiltInPlanner | ModelPlanner | FilePlanner | ChatPlanner


def kinds_of(schema: type) -> tuple[str, ...]:
    """The values of `kind` that a schema is for."""
    return get_args(get_type_hints(schema)["kind"])


#: Kinds that ask a language model in chats, and so need a backend.
CHAT_KINDS: Final = tuple(kind for schema in get_args(ChatPlanner) for kind in kinds_of(schema))
#: The schema of each kind.
PLANNER_KINDS: Final[Mapping[str, type[PlannerConfig]]] = {
    kind: schema for schema in get_args(AnyPlanner) for kind in kinds_of(schema)
}
