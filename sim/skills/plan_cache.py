"""Plan cache: the expert plans an action, and right afterwards the skill executes it from the same state."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

from interface.steps import Action
from sim.skills.body.body import Body

T = TypeVar("T")


def cached_plan(plan: Callable[[Body, Action], T]) -> Callable[[Body, Action], T]:
    """Caches the plan of an action as long as nothing that it depends on has changed."""

    @functools.wraps(plan)
    def wrapped(body: Body, action: Action) -> T:
        state, kept = body.planning_state(), body.plans
        if kept.state != state:
            kept.state, kept.made = state, {}
        if action not in kept.made:
            kept.made[action] = plan(body, action)
        return kept.made[action]

    return wrapped
