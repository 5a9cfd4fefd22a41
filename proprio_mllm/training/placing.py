"""Where the things are that decisions are about, as a point map finds them: what answers say with `model.places`.

Lessons hold no positions. A point map that knows what is where has learnt them from posed views, so its centres are the labels:
an answer says of its own picture what the point map makes of it, and the step is learnt behind these words (embodied chain of
thought; Zawalski et al., 2024). Every variant learns the same words, whether or not it has the point map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.named_map import NamedPointMap
from proprio_mllm.model.placing import Placing, stands_alone
from proprio_mllm.model.wording import Words
from proprio_mllm.training.sources import Demos

_BATCH: Final = 32


class Places:
    """Finds things in the pictures of decisions.

    Args:
        model: gives the tokenizer and the words' rows.
        encoder: a trained point map that knows what is where.
        demos: the decisions.
    """

    def __init__(self, model: ProprioMLLM, encoder: NamedPointMap, demos: Demos) -> None:
        self._place, self._demos = Placing(model, encoder), demos

    def __call__(self, asked: Sequence[tuple[int, Words]]) -> Mapping[int, Words]:
        """The place of one thing in the picture of each row, where it is alone of its name there and found.

        Args:
            asked: rows and the words of ids.
        """
        found: dict[int, Words] = {}
        for start in range(0, len(asked), _BATCH):
            some = [(row, self._demos.reader[row], thing) for row, thing in asked[start : start + _BATCH]]
            some = [one for one in some if stands_alone(one[2], one[1]["visible"])]
            if some:
                said = self._place([self._demos.view(row) for _, row, _ in some], [thing for *_, thing in some])
                found |= {number: place for (number, *_), place in zip(some, said, strict=True) if place}
        return found


def thing_of(answer: Words) -> Words:
    """What the sub-goal of an answer is about; nothing where that has not been seen, or there is none."""
    goal = answer[: answer.index("do")]
    goal = goal[goal.index("so") + 2 :] if "so" in goal else goal
    return () if goal[1:] == ("unseen",) else goal[1:]
