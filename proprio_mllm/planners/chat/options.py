"""Settings that all chat planners share, taken from planner and backend configuration."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from configs.schema.backend import BackendConfig
from configs.schema.planner import AskingPlanner


@dataclass(frozen=True, slots=True)
class ChatOptions:
    """See `configs.schema.planner` and `BackendConfig`, whose fields these are.

    Attributes:
        image_size: side of the head view, pixels.
        max_tokens: longest reply.
        temperature: 0 asks for the most likely reply.
        reflection: whether the call after a failure reflects on it.
        replans: most re-plans, reflecting or not, of an episode.
        horizon: steps of a reply of plain prompting that are carried out before it asks again.
        history: steps of the log in a prompt.
        body: whether the prompt tells proprioception in words.
        examples: tasks taken from memory.
        memory: folder of the memory, None for planners without one.
        parallel: whether DAG-Plan may use both arms in one step.
    """

    image_size: int = 500
    max_tokens: int = 2048
    temperature: float = 0.0
    reflection: bool = True
    replans: int = 5
    horizon: int = 1
    history: int = 20
    body: bool = False
    examples: int = 0
    memory: str | None = None
    parallel: bool = True

    @staticmethod
    def of(planner: AskingPlanner, backend: BackendConfig) -> ChatOptions:
        """From the two configurations."""
        values: dict[str, Any] = {
            one.name: getattr(planner, one.name) for one in fields(ChatOptions) if hasattr(planner, one.name)
        }
        values |= {name: getattr(backend, name) for name in ("image_size", "max_tokens", "temperature")}
        values["reflection"] = planner.reflection == "on"
        return ChatOptions(**values)
