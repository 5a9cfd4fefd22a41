"""Graphs for tests, and a world in which every action works."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from interface.actions import ActionKind
from interface.bodies import Arm
from proprio_mllm.planners.chat.dag_plan.checks import KINDS, check_graph
from proprio_mllm.planners.chat.dag_plan.graph import Graph, NodeReply
from proprio_mllm.planners.chat.dag_plan.hands import EMPTY, Hands, after
from proprio_mllm.planners.chat.dag_plan.names import Vocabulary
from proprio_mllm.planners.chat.dag_plan.scheduler import Job, Scheduler, Situation

FURNITURE = (
    "CounterTop_1",
    "CounterTop_2",
    "DiningTable_1",
    "Drawer_1",
    "Fridge_1",
    "SideTable_1",
    "StoveKnob_1",
    "StoveKnob_2",
)
THINGS = ("Apple_1", "Book_1", "Cup_1", "Egg_1", "Knife_1", "Mug_1", "Pot_1")
KNOWN = (*FURNITURE, *THINGS)


def node(name: str, action: str, waits: str = "", item: str | None = None, at: str | None = None, **others: Any) -> NodeReply:
    """A node; its type and arms follow from the action unless they are given."""
    verb = action.partition("(")[0]
    kinds = [kind for kind, verbs in KINDS.items() if verb in verbs and (kind, verb) != ("occupy", "Open")]
    fields = {"type": (kinds or ["operate"])[0], "arms": 2 if verb in ("Lift", "PlaceBoth") else 1}
    return NodeReply(id=name, action=action, after=waits.split(), item=item, at=at, **(fields | others))


def graph(*nodes: NodeReply, known: Sequence[str] = KNOWN, hands: Hands = EMPTY, task: str = "do it") -> Graph:
    """A checked graph."""
    return check_graph(nodes, Vocabulary(task, known), hands, frozenset())


def reply(*nodes: NodeReply, **fields: str) -> str:
    """What a model writes."""
    return json.dumps({"reasoning": "because"} | fields | {"nodes": [one.model_dump() for one in nodes]})


def carried(obj: str, source: str, target: str, tag: str = "") -> tuple[NodeReply, NodeReply]:
    """A thing is taken from one place to another."""
    tag = tag or obj[0].lower()
    taken = node(f"take_{tag}", f"Pick({obj})", at=source)
    return taken, node(f"put_{tag}", f"Place({target})", taken.id, item=obj)


def rollout(one: Graph, parallel: bool = True, hands: Hands = EMPTY, **situation: Any) -> list[str | tuple[Job, ...]]:
    """Steps when everything is known, things at one place are in view there, and every action works; walks are texts."""
    scheduler = Scheduler(one, parallel=parallel)
    at = {n.target: n.at for n in one.nodes if n.target and n.at}
    settled: set[str] = set()
    here: str | None = None
    steps: list[str | tuple[Job, ...]] = []
    while True:
        place = at.get(here or "", here)
        near = frozenset(name for name in KNOWN if place is not None and at.get(name, name) == place)
        now = Situation(frozenset(settled), hands, here, frozenset(KNOWN), near, at, **situation)
        jobs = scheduler.choose(now)
        if not jobs:
            return steps
        head = jobs[0].node
        anchored = any(n.anchors and n.id in settled and n.item in hands for n in one.nodes)
        if not now.reached(head) and not anchored:
            assert head.target is not None
            here = head.target
            steps.append(f"GoTo({here})")
            continue
        here = head.target if head.verb == "GoTo" else here
        for job in jobs:
            hands = after(job.node, job.arm, hands)
        settled |= {job.node.id for job in jobs}
        steps.append(jobs)


def texts(steps: Sequence[str | tuple[Job, ...]]) -> list[str]:
    """Steps as a planner writes them."""
    return [step if isinstance(step, str) else " & ".join(job.node.action(job.arm).to_text() for job in step) for step in steps]


def uses(job: Job) -> set[Arm]:
    """Arms that a job keeps busy."""
    kind = job.node.template.spec.kind
    if kind is ActionKind.ARM:
        assert job.arm is not None
        return {job.arm}
    return set(Arm) if kind is ActionKind.TWO_ARM else set()
