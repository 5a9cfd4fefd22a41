"""A script in a language model's place that knows the expert's plan and makes seeded mistakes: it tests planners' machinery.

    python eval.py planner=dag_plan backend=scripted backend.source=benchmarks/imperfect_expert.py:answer

It finds the task by the instruction in the prompt and answers in whatever form the planner asks for. Asked to plan, it goes
on with the certified plan as if every step had worked, and makes a mistake in a share `MISTAKES` of its steps (environment
variable of that name; wrong arm, wrong height, too far, malformed). Asked to reflect, it reads the log: it does again what
chance spoiled, undoes its mistakes and goes on from there. What a planner reaches with it says whether the planner's retrieval,
scheduling and reflection work; it is no result, and no table of results shows it.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from interface.actions import ActionKind
from interface.steps import Action, PlanStep
from proprio_mllm.backends.protocol import ChatReply, ChatRequest
from sim.benchmark.certificates import load_certificates
from sim.tasks.task import load_benchmark

MISTAKES = float(os.environ.get("MISTAKES", "0.2"))
KINDS = ("wrong arm", "wrong height", "too far", "malformed")
BY_CHANCE = ("Slipped", "Spilled", "NothingHappened", "Locked")
OCCUPIES, RELEASES, TOOLS = ("Pick", "Lift", "Hold"), ("Place", "PlaceBoth", "Release"), ("Slice", "Clean", "Pour", "Fill")


@functools.cache
def plans() -> dict[tuple[str, str], tuple[str, tuple[str, ...]]]:
    """Task id and certified plan by (instruction, robot); of equal instructions none."""
    tasks: dict[str, list[str]] = {}
    for task in load_benchmark():
        tasks.setdefault(task.instruction, []).append(task.id)
    ids = {names[0]: text for text, names in tasks.items() if len(names) == 1}
    return {(ids[c.task], c.robot): (c.task, tuple(c.plan)) for c in load_certificates() if c.task in ids}


def answer(request: ChatRequest) -> ChatReply:
    """The reply that the request's schema asks for."""
    text = "\n".join(message.text for message in request.messages)
    robot = re.findall(r"dual-arm humanoid (\w+)", text)[0].lower()
    scene = re.search(r"^Task: ([^\n]*)\nThis is step.*?^Log:\n(.*?)^The picture is", text, re.M | re.S)
    assert scene is not None
    task, plan = plans()[scene[1], robot]
    log = list(re.findall(r"^\d+\. (.*)$", scene[2], re.M))
    assert request.schema is not None
    reply = FORMS[request.schema.__name__](task, plan, log)
    if request.schema.__name__ == "GraphReply" and draw(task, 0, 1000) < 1000 * MISTAKES and "nowhere" not in text:
        reply = {"nodes": [node | {"after": ["nowhere"]} for node in nodes(plan, ())]}  # what a planner asks to be mended
    written = reply if isinstance(reply, str) else json.dumps(reply)
    return ChatReply(written, len(text) // 4, len(written) // 4, model="imperfect-expert")


def draw(task: str, number: int, of: int) -> int:
    """A number below `of` that depends on task and step alone."""
    return int.from_bytes(hashlib.sha256(f"{task} {number}".encode()).digest()[:4]) % of


def mistaken(task: str, number: int, step: str) -> str:
    """A step, with a mistake in some."""
    if draw(task, number, 1000) >= 1000 * MISTAKES:
        return step
    kind = KINDS[draw(task, number + 1000, len(KINDS))]
    first = PlanStep.parse(step).actions[0]
    if kind == "malformed":
        return f"take care of {first.object_id}"
    if kind == "too far" and first.name == "GoTo":
        return Action("GoTo", object_id=first.object_id, amount=2.0).to_text()
    if kind == "wrong height" and first.spec.kind is ActionKind.ARM:
        return "MoveDown(0.25)"
    return swapped(step) if kind == "wrong arm" else step


def swapped(step: str) -> str:
    """A step with left and right exchanged."""
    actions = PlanStep.parse(step).actions
    return PlanStep(tuple(one if one.arm is None else replace(one, arm=one.arm.other) for one in actions)).to_text()


def left_over(plan: Sequence[str], log: Sequence[str]) -> list[str]:
    """What of a plan is still to do after a log, also one done with the other arm; what chance spoiled is done again."""
    place, other = 0, False
    for line in log:
        if place == len(plan):
            break
        wanted = swapped(plan[place]) if other else plan[place]
        results = dict(re.findall(r"(\w+\([^()]*\)) (\w+)", line))
        done = " & ".join(results)
        if done == swapped(wanted) != wanted and set(results.values()) == {"ok"}:
            place, other = place + 1, not other
        elif done == wanted and not set(results.values()) & set(BY_CHANCE):
            place += 1
    rest = [swapped(step) for step in plan[place:]] if other else list(plan[place:])
    return rest or ["Done()"]


def careless(log: Sequence[str]) -> int:
    """Steps of the plan that somebody who does not read results takes for done: all, what was done again counting once."""
    steps = [" & ".join(re.findall(r"\w+\([^()]*\)", line)) for line in log]
    return len(steps) - sum(step == before for before, step in itertools.pairwise(steps))


def _plan(task: str, plan: Sequence[str], log: Sequence[str]) -> dict[str, object] | str:
    rest = [mistaken(task, number, step) for number, step in enumerate(plan)][careless(log) :]
    return {"reasoning": "as planned", "steps": [*rest, "Done()"]}


def _reflection(task: str, plan: Sequence[str], log: Sequence[str]) -> dict[str, object]:
    return {"cause": "chance or a slip of mine", "change": "do it as planned", "steps": left_over(plan, log)}


def _outline(task: str, plan: Sequence[str], log: Sequence[str]) -> dict[str, object]:
    return {"plan": list(plan), "key": {"kind": "action", "text": plan[0]}}


def _thought(task: str, plan: Sequence[str], log: Sequence[str]) -> dict[str, object]:
    step = ([mistaken(task, number, step) for number, step in enumerate(plan)][careless(log) :] or ["Done()"])[0]
    return {"thought": "as planned", "key": {"kind": "action", "text": step}, "steps": [step]}


def nodes(plan: Sequence[str], done: Sequence[tuple[str, str | None]]) -> list[dict[str, object]]:
    """A graph of a plan's actions: each waits for those before it that touch one of its objects.

    Args:
        plan: the certified steps.
        done: verb and target of actions that have succeeded already, each left out once.
    """
    left, held, where = list(done), dict[str, str | None](), ""
    found: list[dict[str, object]] = []
    touched: dict[str, str] = {}
    for step in plan:
        for action in PlanStep.parse(step).actions:
            target, arm = action.object_id, "both" if action.arm is None else action.arm.value
            if action.name == "GoTo":
                where = target if target is not None and target not in touched else where
                continue
            item = held.get(arm)
            held[arm] = target if action.name in OCCUPIES else None if action.name in RELEASES else item
            if (action.name, target) in left:
                left.remove((action.name, target))
                continue
            kind = "occupy" if action.name in OCCUPIES else "release" if action.name in RELEASES else "operate"
            kind = "tool-use" if action.name in TOOLS else kind
            name = f"n{len(found) + 1}"
            about = [obj for obj in (target, item if kind in ("release", "tool-use") else None) if obj is not None]
            text = replace(action, arm=None).to_text() if action.arm is None else f"{action.name}({target or ''})"
            node: dict[str, object] = {"id": name, "action": text, "type": kind, "arms": 2 if arm == "both" else 1}
            node["after"] = list(dict.fromkeys(touched[obj] for obj in about if obj in touched))
            found.append(node | ({"item": item} if kind in ("release", "tool-use") else {}) | {"at": where or None})
            touched |= dict.fromkeys(about, name)
    end = {"id": "end", "action": "Done()", "type": "complete", "arms": 1, "after": [node["id"] for node in found]}
    return [*found, end]


def _graph(task: str, plan: Sequence[str], log: Sequence[str]) -> dict[str, object] | str:
    return {"reasoning": "as planned", "nodes": nodes(plan, ())}


def _revised(task: str, plan: Sequence[str], log: Sequence[str]) -> dict[str, object]:
    done = [Action.parse(text) for line in log for text in re.findall(r"(\w+\([^()]*\)) ok", line)]
    rest = nodes(plan, [(action.name, action.object_id) for action in done])
    return {"cause": "chance", "change": "do it again", "nodes": rest}


FORMS: Mapping[str, Callable[[str, Sequence[str], Sequence[str]], dict[str, object] | str]] = {
    "Plan": _plan,
    "Reflection": _reflection,
    "Outline": _outline,
    "Thought": _thought,
    "GraphReply": _graph,
    "RevisedGraph": _revised,
}
