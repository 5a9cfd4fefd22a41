"""Which object ids a graph may name, and which real id a name of something unseen turns out to mean.

Furniture is known from the start, small things only once they have been seen. A graph is made before that, so it may name what
the task names, by type and any number, and what is seen later of that type is taken for it. Paper: DAG-Plan lists all objects
in its prompt; here most are unknown at first.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Final

from proprio_mllm.planners.chat.dag_plan.graph import Graph
from proprio_mllm.planners.furniture import FIXTURES
from proprio_mllm.planners.scripted.instruction import TOOLS
from proprio_mllm.planners.scripted.words import candidates, find_mentions, type_of

#: Types of tools, which a task need not name.
_TOOLS: Final = frozenset(name for names in TOOLS.values() for name in names)


class Vocabulary:
    """Tells which ids may be named.

    Args:
        instruction: the task.
        known: ids seen so far, and the furniture.
    """

    def __init__(self, instruction: str, known: Iterable[str]) -> None:
        self.known = frozenset(known)
        mentions = find_mentions(instruction, self.known)[1]
        self._spoken = tuple(replace(mention, ordinal=None) for mention in mentions)

    def refusal(self, object_id: str) -> str | None:
        """Why an id may not be named, None when it may."""
        if object_id in self.known or type_of(object_id) in _TOOLS:
            return None
        if type_of(object_id) in FIXTURES:
            there = ", ".join(sorted(one for one in self.known if type_of(one) == type_of(object_id)))
            return f"there is no {object_id}; known of its type: {there or 'none'}"
        if any(candidates(mention, [object_id]) for mention in self._spoken):
            return None
        return f"{object_id} has not been seen, and the task names nothing of its type"


def bindings(graph: Graph, before: Collection[str], now: Iterable[str], visited: Collection[str]) -> dict[str, str]:
    """Real ids for names of a graph that nothing bears so far.

    Args:
        graph: with the names.
        before: ids known when the graph was made; the graph did not mean those.
        now: ids known now.
        visited: where the robot has been. What is said to be somewhere is not taken for something seen before it got there.
    """
    now = tuple(now)
    named = graph.objects()
    places = {node.target: node.at for node in graph.nodes if node.at is not None}
    found: dict[str, str] = {}
    for name in sorted(named.difference(now)):
        place = places.get(name)
        if place is not None and place not in visited:
            continue
        new = [one for one in now if one not in before and one not in named and one not in found.values()]
        fitting = sorted(one for one in new if type_of(one) == type_of(name))
        if fitting:
            found[name] = fitting[0]
    return found
