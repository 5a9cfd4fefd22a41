"""What the model is told about graphs, and the questions it is asked.

Paper: DAG-Plan, prompt for the graph; reflection is this paper's addition (Table III). The wording is ours: what each type of
node is and what has to follow from it is DAG-Plan's, names, places and heights are of this simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from interface.actions import ACTIONS
from interface.feedback import Feedback
from interface.observation import Observation
from proprio_mllm.planners.chat.dag_plan.checks import KINDS
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.reflection import Seen, changed_text, completed_steps, failed_text
from proprio_mllm.planners.chat.view import scene_text

_OPERATE: Final = ", ".join(name for name in KINDS["operate"] if ACTIONS[name].arms == 1 and ACTIONS[name].takes_object)
GRAPH_RULES: Final = f"""\
Write what has to be done as a graph. A scheduler carries it out with both arms, at the same time where it can: it chooses the
arms, walks to the object of each node, and looks for objects that have not been seen. A node is one action of the grammar with
its arm left out, such as Pick(Mug_1), Place(CounterTop_1), Release() or Lift(Pot_1). Its fields:
- id: a short name, each used once
- action: as above
- type: what it does to the hand
  occupy, full afterwards: Pick, Hold, Lift, and Open of a door that falls shut unless the hand stays at it
  release, empty again: Place, Release, PlaceBoth
  tool-use, works with what it holds: Slice, Clean, Pour, Fill
  operate, empty before and after: {_OPERATE}; and all movements of the body
  complete, the end of the task: Done
- arms: 2 for Lift and PlaceBoth, otherwise 1
- after: ids of the nodes that have to be done before, and no others: what does not wait is done at the same time
- item: for release and tool-use the object that the hand holds, otherwise null
- at: the furniture on or in which the action's object is, null when you do not know; things at one place are handled together
Rules:
- Every occupy is followed by a release of its item, and between the two that item is only used as a tool. What shall stay in
  the hand at the end has a complete node after its occupy instead of a release.
- There are two hands. {" and ".join(_OPERATE.rsplit(", ", 1))} need an empty one.
- A hand that Holds something or stays at a door keeps the robot there: pick up first what it needs.
- Furniture goes by the ids of the message. A small thing that has not been seen goes by its type and a number, such as Mug_1,
  if the task names it.
- Where a thing is low or high, put MoveDown or MoveUp before its node. GoTo is only for a distance or bearing of your own."""

_NODE: Final = (
    '{"id": "a", "action": "Pick(Mug_1)", "type": "occupy", "arms": 1, "after": [], "item": null, "at": "CounterTop_1"}'
)
GRAPH_FORM: Final = f'Reply with one JSON object: {{"reasoning": "...", "nodes": [{_NODE}, ...]}}'
REVISED_FORM: Final = (
    "The last step failed. Think about why: name the cause, say what has to change, then give a new graph for all that is "
    "still to be done from here. What is done is not part of it, and what the hands hold already has no occupy. Do not repeat "
    "what has just failed unless chance was the cause or you change what made it fail.\n"
    f'Reply with one JSON object: {{"cause": "...", "change": "...", "nodes": [{_NODE}, ...]}}'
)


def graph_text(observation: Observation, options: ChatOptions, hands: Sequence[str | None]) -> str:
    """The question for a graph: the scene, and what the hands are believed to hold, right and left."""
    return f"{scene_text(observation, options.history, options.body)}\n{_hands_text(hands)}"


def failure_text(
    observation: Observation,
    options: ChatOptions,
    hands: Sequence[str | None],
    feedback: Feedback,
    before: Seen | None,
    progress: str,
) -> str:
    """The question after a failure.

    Args:
        observation: after the failed step.
        options: how much of the log and the body is told.
        hands: what the right and the left hand are believed to hold.
        feedback: of the failed step.
        before: what was seen before it.
        progress: the graph's nodes with what became of them.
    """
    lines = (
        graph_text(observation, options, hands),
        f"Failed: {failed_text(feedback)}",
        f"Changed: {changed_text(before, observation)}",
        f"Completed: {'; '.join(completed_steps(observation.history)) or 'nothing'}",
        f"Graph so far: {progress}",
    )
    return "\n".join(lines)


def mending_text(question: str, answer: str, problems: Sequence[str]) -> str:
    """The one call that asks to mend a graph: the question, the answer and all that is wrong with it."""
    wrong = "\n".join(f"- {problem}" for problem in problems)
    return f"{question}\nYou answered:\n{answer}\nThis graph cannot be carried out:\n{wrong}\nAnswer again, with all nodes."


def _hands_text(hands: Sequence[str | None]) -> str:
    right, left = (item or "nothing" for item in hands)
    return f"Your right hand holds {right}, your left hand {left}."
