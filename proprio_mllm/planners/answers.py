"""What a model that answers in words may say next: the grammar of actions, over the ids that are known.

Paper: none; its planners are free to answer anything. Constrained, every reply is a step that the robot can be asked for.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Final

from interface.actions import ACTIONS, ActionKind, ActionSpec, Amount, exclude_each_other
from interface.belief import Belief
from interface.bodies import Arm
from interface.effects import Condition, Grasp, Walk
from interface.steps import Action
from proprio_mllm.model.wording import CAUSES, CHANGES, END, PLACES, Words, id_words, number_words
from proprio_mllm.planners.furniture import CONTAINERS, FIXTURES, SEATS, SURFACES
from proprio_mllm.planners.scripted.words import type_of

#: Verbs whose object is never furniture.
_OF_MOVABLES: Final = frozenset(("Pick", "Lift", "Slice", "Pour", "UseUp"))
#: The words of a reflection, place by place.
_REFLECTION: Final = (CAUSES, ("so",), CHANGES)


class AnswerGrammar:
    """The answers of one moment.

    Args:
        ids: known ids.
        belief: what is known of the world; left out are actions that are bound to be refused by it, walks in search of
            something to where it is not or was looked for, walks where walks alone have not helped, and the end of the task
            unless hands have just done something. None leaves out none.
        reflects: whether an answer begins with a reflection.
        places: whether it may say where its thing is.
        place: tells where that is, so that it is said whenever it is told; None leaves it to who answers.
    """

    def __init__(
        self,
        ids: Sequence[str],
        belief: Belief | None = None,
        reflects: bool = False,
        places: bool = False,
        place: Callable[[Words], Words] | None = None,
    ) -> None:
        self.ids: Mapping[Words, str] = {id_words(name): name for name in ids}
        self._belief, self._reflection, self._places, self._place = belief, _REFLECTION if reflects else (), places, place
        #: Words of the reflection.
        self.reflected = len(self._reflection)
        self._searched = frozenset() if belief is None else _searched(ids, belief)

    def allowed(self, words: Sequence[str]) -> list[str]:
        """The words that may follow some words of an answer; none after its end."""
        if len(words) < self.reflected:
            return list(self._reflection[len(words)])
        words = words[self.reflected :]
        if not words:
            return list(ACTIONS)
        if "do" not in words:
            spec = ACTIONS[words[0]]
            if not spec.takes_object or words[-1] == "unseen":
                return ["do"]
            following = _next(words[1:], (one for one, name in self.ids.items() if self._may_be_wanted(spec, name)))
            return [*following, "unseen"] if len(words) == 1 else following or self._of_place(tuple(words[1:]))
        skipped = self._searched if words[1] == "unseen" else frozenset()
        step = list(words[words.index("do") + 1 :])  # type: ignore[attr-defined]  # every sequence has index
        if step and step[-1] == END:
            return []
        if "&" in step:
            cut = step.index("&")
            return self._of_action(step[cut + 1 :], self._action(step[:cut]), skipped)
        return self._of_action(step, None, skipped)

    def _of_place(self, words: Words) -> list[str]:
        """What follows the thing of a sub-goal and the first words of its place."""
        end = next(index for index, word in enumerate(words) if word.startswith("_")) + 1
        said, open_end = len(words) - end, self._place is None and len(words) == end
        told = PLACES if self._place is None else tuple((word,) for word in self._place(words[:end]))
        following = told[said] if self._places and said < len(told) else ()
        return [*following, *(("do",) if open_end or not following else ())]

    def _of_action(self, words: Sequence[str], first: Action | None, skipped: Collection[str]) -> list[str]:
        if not words:
            return [name for name, spec in ACTIONS.items() if any(True for _ in self._arms(spec, first, skipped))]
        spec, rest, arm = ACTIONS[words[0]], list(words[1:]), None
        if spec.kind is ActionKind.ARM:
            if not rest:
                return [one.value for one in self._arms(spec, first, skipped) if one is not None]
            arm = Arm(rest.pop(0))
        if spec.takes_object:
            if following := _next(rest, self._targets(spec, arm, first, skipped)):
                return following
            rest = rest[next(index for index, word in enumerate(rest) if word.startswith("_")) + 1 :]
        more = _numbers(spec.amounts[len(rest)]) if len(rest) < len(spec.amounts) else ()
        after = [*more, END]
        if len(spec.amounts) == 2 and not rest:
            after.append("auto")
        if rest and rest[-1] == "auto":
            after.remove(END)
        if spec.kind is ActionKind.ARM and first is None:
            after.append("&")
        return after

    def _arms(self, spec: ActionSpec, first: Action | None, skipped: Collection[str]) -> Iterator[Arm | None]:
        """The arms that may do an action beside a first one; None for what is not an arm's, if it may be done."""
        if first is not None and spec.kind is not ActionKind.ARM:
            return
        arms = (None,) if spec.kind is not ActionKind.ARM else tuple(Arm) if first is None else (_other(first),)
        yield from (arm for arm in arms if any(True for _ in self._targets(spec, arm, first, skipped)))

    def _targets(
        self, spec: ActionSpec, arm: Arm | None, first: Action | None, skipped: Collection[str]
    ) -> Iterator[tuple[str, ...]]:
        """The words of what an action may be about; no words for an action that is about nothing.

        Args:
            spec: the action.
            arm: its arm.
            first: the action beside it.
            skipped: what is not walked to.
        """
        for words, name in self.ids.items() if spec.takes_object else (((), None),):
            action = Action(spec.name, arm, name)
            if name is not None and not self._may_be_wanted(spec, name):
                continue
            if first is not None and exclude_each_other(first, action):
                continue
            if name in skipped and spec.has_effect(Walk):
                continue
            if self._belief is None or self._may_come_now(action, self._belief):
                yield words

    def _may_come_now(self, action: Action, belief: Belief) -> bool:
        if action.spec.kind is ActionKind.EPISODE and not any(event.ok and event.action.spec.arms for event in belief.last):
            return False
        return belief.refusal(action) is None and not belief.walked_enough(action)

    def _may_be_wanted(self, spec: ActionSpec, name: str) -> bool:
        """Whether an object is one for a verb, whatever the hands do now: furniture is not picked, nor what is held."""
        if spec.name in _OF_MOVABLES and type_of(name) in FIXTURES:
            return False
        return self._belief is None or not spec.has_effect(Grasp) or not self._belief.state.holds(name)

    def _action(self, words: Sequence[str]) -> Action:
        spec, rest = ACTIONS[words[0]], list(words[1:])
        arm = Arm(rest.pop(0)) if spec.kind is ActionKind.ARM else None
        return Action(words[0], arm, self.ids[tuple(rest)] if spec.takes_object else None)


def _next(begun: Sequence[str], ids: Iterator[tuple[str, ...]]) -> list[str]:
    """The next words of ids that begin so; none when an id is complete."""
    if any(word.startswith("_") for word in begun):
        return []
    size = len(begun)
    return list(dict.fromkeys(words[size] for words in ids if words[:size] == tuple(begun)))


def _searched(ids: Sequence[str], belief: Belief) -> frozenset[str]:
    """Where one need not go to look for something: what nothing lies in, what was looked through while some was not."""
    spots = {name for name in ids if type_of(name) in (*SURFACES, *SEATS, *CONTAINERS)}
    left = {name for name in spots if not _looked_through(name, belief)}
    return frozenset(set(ids) - (left or spots))


def _looked_through(name: str, belief: Belief) -> bool:
    """Whether it was gone to, and is not shut."""
    return name in belief.visited and (type_of(name) not in CONTAINERS or belief.state.is_in(Condition.OPEN, name) is True)


@functools.cache
def _numbers(amount: Amount) -> tuple[str, ...]:
    """The words of the numbers that an action takes."""
    words = (word for word in number_words() if ("." in word if amount.unit == "m" else word.endswith("d")))
    return tuple(word for word in words if amount.low <= float(word.rstrip("d")) <= amount.high)


def _other(first: Action) -> Arm:
    assert first.arm is not None
    return first.arm.other
