"""What a model that answers in words may say next: the grammar of actions, over the ids that are known.

Paper: none; its planners are free to answer anything. Constrained, every reply is a step that the robot can be asked for.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Final

from data.interface.actions import ACTIONS, ActionKind, ActionSpec, Amount, exclude_each_other
from data.interface.bodies import Arm
from data.interface.steps import Action
from proprio_mllm.model.wording import END, id_words, number_words
from proprio_mllm.planners.furniture import FIXTURES
from proprio_mllm.planners.scripted.words import type_of

__all__ = ["AnswerGrammar"]

#: Verbs whose object is never furniture.
_OF_MOVABLES: Final = frozenset(("Pick", "Lift", "Slice", "Pour", "UseUp"))


class AnswerGrammar:
    """The answers of one moment.

    Args:
        ids: known ids.
    """

    def __init__(self, ids: Sequence[str]) -> None:
        self.ids: Mapping[tuple[str, ...], str] = {id_words(name): name for name in ids}

    def allowed(self, words: Sequence[str]) -> list[str]:
        """The words that may follow some words of an answer; none after its end."""
        if not words:
            return list(ACTIONS)
        if "do" not in words:
            spec = ACTIONS[words[0]]
            if not spec.takes_object or words[-1] == "unseen":
                return ["do"]
            following = self._of_ids(words[1:], spec, None)
            return following + ["unseen"] * (len(words) == 1) if following else ["do"]
        step = list(words[words.index("do") + 1 :])  # type: ignore[attr-defined]  # every sequence has index
        if step and step[-1] == END:
            return []
        if "&" in step:
            cut = step.index("&")
            return self._of_action(step[cut + 1 :], self._action(step[:cut]))
        return self._of_action(step, None)

    def _of_action(self, words: Sequence[str], first: Action | None) -> list[str]:
        if not words:
            return [name for name, spec in ACTIONS.items() if first is None or spec.kind is ActionKind.ARM]
        spec, rest = ACTIONS[words[0]], list(words[1:])
        if spec.kind is ActionKind.ARM:
            if not rest:
                return [arm.value for arm in Arm if first is None or arm is not first.arm]
            rest.pop(0)
        if spec.takes_object:
            following = self._of_ids(rest, spec, first)
            if following:
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

    def _of_ids(self, begun: Sequence[str], spec: ActionSpec, first: Action | None) -> list[str]:
        """The next words of ids that begin so; none when an id is complete."""
        begun = tuple(begun)
        if any(word.startswith("_") for word in begun):
            return []
        fitting = [
            words
            for words, name in self.ids.items()
            if words[: len(begun)] == begun
            and not (spec.name in _OF_MOVABLES and type_of(name) in FIXTURES)
            and not (first is not None and exclude_each_other(first, Action(spec.name, arm=_other(first), object_id=name)))
        ]
        return list(dict.fromkeys(words[len(begun)] for words in fitting))

    def _action(self, words: Sequence[str]) -> Action:
        spec, rest = ACTIONS[words[0]], list(words[1:])
        arm = Arm(rest.pop(0)) if spec.kind is ActionKind.ARM else None
        return Action(words[0], arm, self.ids[tuple(rest)] if spec.takes_object else None)


@functools.cache
def _numbers(amount: Amount) -> tuple[str, ...]:
    """The words of the numbers that an action takes."""
    words = (word for word in number_words() if ("." in word if amount.unit == "m" else word.endswith("d")))
    return tuple(word for word in words if amount.low <= float(word.rstrip("d")) <= amount.high)


def _other(first: Action) -> Arm:
    assert first.arm is not None
    return first.arm.other
