"""Where the things are that decisions are about, as a point map finds them: what answers say with `model.places`.

Lessons hold no positions. A point map that knows what is where has learnt them from posed views, so its centres are the labels:
an answer says of its own picture what the point map makes of it, and the step is learnt behind these words (embodied chain of
thought; Zawalski et al., 2024). Every variant learns the same words, whether or not it has the point map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from proprio_mllm.model.placing import Placing, stands_alone
from proprio_mllm.model.wording import WordEpisode, Words, WordTurn
from proprio_mllm.training.sources import Demos

_BATCH: Final = 32


def placed(episodes: Sequence[WordEpisode], demos: Demos, place: Placing) -> list[WordEpisode]:
    """Episodes whose answers say where their thing is, where it is alone of its name in the picture and found.

    Args:
        episodes: of the decisions, in their order; the k-th turn of an episode is its k-th row's.
        demos: the decisions.
        place: finds things.
    """
    visible, asked = demos.reader.column("visible"), list[tuple[int, Words]]()
    for start, episode in zip(demos.starts, episodes, strict=True):
        things = enumerate((thing_of(turn.answer) for turn in episode.turns), start)
        asked += [(row, thing) for row, thing in things if thing and stands_alone(thing, visible[row])]
    found: dict[int, Words] = {}
    for some in (asked[first : first + _BATCH] for first in range(0, len(asked), _BATCH)):
        said = place([demos.view(demos.reader[row]) for row, _ in some], [thing for _, thing in some])
        found |= {row: words for (row, _), words in zip(some, said, strict=True)}
    return [
        replace(episode, turns=tuple(_at(turn, found.get(row, ())) for row, turn in enumerate(episode.turns, start)))
        for start, episode in zip(demos.starts, episodes, strict=True)
    ]


def _at(turn: WordTurn, place: Words) -> WordTurn:
    if not place:
        return turn
    do = turn.answer.index("do")
    return replace(turn, answer=(*turn.answer[:do], *place, *turn.answer[do:]))


def behind_places(episode: WordEpisode) -> WordEpisode:
    """An episode in which only the step is learnt where a place is known: goal and place are read before it."""
    return replace(episode, turns=tuple(map(_behind_place, episode.turns)))


def _behind_place(turn: WordTurn) -> WordTurn:
    if "at" not in turn.answer:
        return turn
    do = turn.answer.index("do")
    return replace(turn, now=(*turn.now, *turn.answer[:do]), answer=turn.answer[do:])


def thing_of(answer: Words) -> Words:
    """What the sub-goal of an answer is about; nothing where that has not been seen, or there is none."""
    goal = answer[: answer.index("do")] if answer else ()
    goal = goal[goal.index("so") + 2 :] if "so" in goal else goal
    return () if goal[1:] == ("unseen",) else goal[1:]
