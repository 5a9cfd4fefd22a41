"""Reflection after a failure: what failed and what the robot has done so far, asked for cause, change and the steps to take.

Paper: replanning (Table III). The paper's prompt is not published. Here it names the failed action with its code, what has come
into view and gone from it since, the steps that succeeded, and with `body` the robot's own state; objects' states are not among
it, because no planner sees them. How often an episode may reflect is capped by the planner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from interface.feedback import Feedback
from interface.observation import HistoryItem, Observation
from proprio_mllm.backends.protocol import ChatImage
from proprio_mllm.planners.chat.asking import REFLECTION, Answer, Asker
from proprio_mllm.planners.chat.replies import Reflection
from proprio_mllm.planners.chat.view import encoded, scene_text
from proprio_mllm.planners.protocol import succeeded

REFLECTION_RULES = (
    "The last step failed. Think about why: name the cause, say what has to change, then give the next steps from here. "
    "Do not repeat what has just failed unless chance was the cause or you change what made it fail.\n"
    'Reply with one JSON object: {"cause": "...", "change": "...", "steps": ["...", ...]}'
)


@dataclass(frozen=True, slots=True)
class Seen:
    """What was in view and known before a step."""

    visible: frozenset[str]
    known: frozenset[str]

    @staticmethod
    def of(observation: Observation) -> Seen:
        """From an observation."""
        return Seen(frozenset(observation.visible_objects), frozenset(observation.known_objects))


def completed_steps(history: Sequence[HistoryItem]) -> list[str]:
    """Steps of which every action succeeded."""
    return [item.step for item in history if succeeded(item)]


def failed_text(feedback: Feedback) -> str:
    """The failed actions, each with its code."""
    return "; ".join(f"{one.action.to_text()}: {one.code}" for one in feedback.outcomes if not one.success)


def changed_text(before: Seen | None, observation: Observation) -> str:
    """What came into view, what left it, and what is new to the episode."""
    if before is None:
        return "nothing that is known"
    now = Seen.of(observation)
    parts = [
        ("now in view", now.visible - before.visible),
        ("no longer in view", before.visible - now.visible),
        ("seen for the first time", now.known - before.known),
    ]
    return "; ".join(f"{what}: {', '.join(sorted(ids))}" for what, ids in parts if ids) or "nothing in view"


def reflect(
    asker: Asker, system: str, observation: Observation, feedback: Feedback, before: Seen | None, last: int, body: bool,
    extra: str = "",
) -> Answer[Reflection]:  # fmt: skip
    """One reflecting call.

    Args:
        asker: of the episode.
        system: the planner's own system message, without the rules of its reply.
        observation: after the failed step.
        feedback: of the failed step.
        before: what was seen before it.
        last: steps of the log shown.
        body: whether proprioception is told.
        extra: further lines of the planner's own.
    """
    done = completed_steps(observation.history)
    text = "\n".join(
        (
            scene_text(observation, last, body),
            f"Failed: {failed_text(feedback)}",
            f"Changed: {changed_text(before, observation)}",
            f"Completed: {'; '.join(done) or 'nothing'}",
            *([extra] if extra else []),
        )
    )
    content: tuple[str | ChatImage, ...] = (text, encoded(observation.image))
    return asker.ask(f"{system}\n\n{REFLECTION_RULES}", content, Reflection, REFLECTION)
