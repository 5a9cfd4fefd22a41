"""What a critic is asked, with answers from logs: does the goal hold, and which objects are in a state.

Whether a goal holds is asked in the words in which planners are shown an episode: a planner that has learnt when it is done
knows most of it. The answers come from what the log itself says (an action with `ok`, or the end of a successful episode),
never from privileged simulator state, so a critic learns to read its inputs only.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.sightings import Shown
from proprio_mllm.model.batch import Example, View
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.observing import EpisodeLog, pictured_turn
from proprio_mllm.model.prompts import answers, self_ask_prompt, with_answer
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import verdict_words
from proprio_mllm.training.sources import Demos
from proprio_mllm.training.states import asked_relation, history_of, states_from_log

#: Earlier steps shown with a question about states.
LOG_LENGTH: Final = 8
#: How often a held-out moment that is asked about is its episode's end, and how often the goal there is another's.
_ENDED, _OTHER = 0.5, 0.3


def verdict_example(
    model: ProprioMLLM, shown: Iterable[Shown], view: View | None, codes: Sequence[int] | None, done: bool | None = None
) -> Example:
    """Whether the goal that was shown holds at the last moment.

    Args:
        model: gives the tokenizer, and says whether it sees.
        shown: every moment of the episode so far.
        view: of the last moment.
        codes: its motion tokens, None without proprioception.
        done: the answer; None leaves it open.
    """
    log, now = EpisodeLog(tokens_of(model.processor.tokenizer)), list[int]()
    for moment in shown:
        now = log.look(moment)
    answer = () if done is None else log.words.tokens(verdict_words(done))
    return pictured_turn(model, log.log, now, view if model.cfg.sees else None, codes, answer)


def state_example(demos: Demos, index: int, rng: np.random.Generator, tokens: NDArray[np.int64] | None) -> Example:
    """Which objects are in a relation before step `index`, with the answer.

    Args:
        demos: steps of lessons.
        index: a row.
        rng: draws the relation.
        tokens: motion tokens (rows, tokens) of all rows, None leaves proprioception out.
    """
    row = demos.reader[int(index)]
    history = history_of(row)
    states = states_from_log(history[-LOG_LENGTH:])
    relation = asked_relation(states, rng)
    motion = None if tokens is None else tokens[int(index)].tolist()
    prompt = self_ask_prompt(relation, row["visible"], history, motion, demos.style, LOG_LENGTH)
    return Example(with_answer(prompt, answers(states[relation])), (demos.view(row),))


class Verdicts:
    """Questions about lessons, whether a goal holds.

    Args:
        model: see `verdict_example`.
        demos: steps of lessons.
        tokens: motion tokens of all rows, or None.
    """

    def __init__(self, model: ProprioMLLM, demos: Demos, tokens: NDArray[np.int64] | None) -> None:
        self._model, self._demos, self._tokens = model, demos, tokens

    def draw(self, rng: np.random.Generator) -> Example:
        """Whether an episode that is learnt from has met another's goal, with the answer: what no planner has learnt to say."""
        ends = np.intersect1d(self._demos.ends, self._demos.split.train)
        index = int(rng.choice(ends))
        goal = self._goal(int(rng.choice(ends)))
        return self._example(index, goal, goal == self._goal(index))

    def held_out(self, count: int) -> list[tuple[Example, bool]]:
        """Questions about rows that are held out, the same every time, and what is true; none when nothing is held out.

        Half of them are about the end of an episode, and some of these about another's goal.
        """
        rng, rows = np.random.default_rng(0), self._demos.split.test
        ends, before = np.intersect1d(self._demos.ends, rows), np.setdiff1d(rows, self._demos.ends)
        found: list[tuple[Example, bool]] = []
        for _ in range(count if len(rows) else 0):
            ended = len(ends) > 0 and rng.random() < _ENDED
            index = int(rng.choice(ends if ended else before))
            other = ended and rng.random() < _OTHER
            goal = self._goal(int(rng.choice(ends)) if other else index)
            found.append((self._example(index, goal, None), bool(ended) and goal == self._goal(index)))
        return found

    def _goal(self, index: int) -> str:
        return str(self._demos.reader[index]["instruction"])

    def _example(self, index: int, goal: str, done: bool | None) -> Example:
        codes = None if self._tokens is None else self._tokens[index].tolist()
        view = self._demos.view(self._demos.reader[index])
        return verdict_example(self._model, self._demos.shown(index, goal), view, codes, done)
