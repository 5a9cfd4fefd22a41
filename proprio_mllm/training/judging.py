"""Judging questions from the logs of lessons: was the goal completed, and which objects are in a state.

A released model can answer such questions; the tiny one has to learn it. The answers come from what the log itself says (an
action with `ok`, or the end of a successful episode), never from privileged simulator state, so a judge learns to
read its inputs only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from proprio_mllm.model.batch import Example
from proprio_mllm.model.prompts import answers, critic_prompt, self_ask_prompt, with_answer
from proprio_mllm.training.sources import Demos
from proprio_mllm.training.states import asked_relation, history_of, states_from_log

#: Earlier steps shown to a judge.
LOG_LENGTH: Final = 8


def judge_example(demos: Demos, index: int, rng: np.random.Generator, tokens: NDArray[np.int64] | None) -> Example:
    """A judging conversation about the state before step `index`, with its answer.

    Half of them ask whether a goal was completed: the episode's own, which is so at its end only, or another episode's
    instruction; the others ask which objects are in a relation.

    Args:
        demos: steps of lessons.
        index: a training row.
        rng: draws the question, and whether the end of another episode is asked about.
        tokens: motion tokens (rows, tokens) of all rows, None leaves proprioception out.
    """
    ended = rng.random() < 0.6 and len(demos.finals) > 0
    if ended:
        index = int(rng.choice(demos.finals))
    row = demos.reader[int(index)]
    motion = None if tokens is None else tokens[int(index)].tolist()
    if rng.random() < 0.5:
        return _completion_example(demos, row, ended, demos.finals, rng, motion)
    history = history_of(row)
    states = states_from_log(history[-LOG_LENGTH:])
    relation = asked_relation(states, rng)
    prompt = self_ask_prompt(relation, row["visible"], history, motion, demos.style, LOG_LENGTH)
    return Example(with_answer(prompt, answers(states[relation])), (demos.view(row),))


def completion_examples(demos: Demos, count: int, tokens: NDArray[np.int64] | None) -> list[Example]:
    """Held-out conversations whether a goal was completed, the same every time; half of them are at an episode's end.

    Args:
        demos: steps of lessons.
        count: how many; none when nothing is held out.
        tokens: motion tokens of all rows, or None.
    """
    rng, held_out = np.random.default_rng(0), demos.split.test
    finals, others = np.intersect1d(demos.ends, held_out), np.setdiff1d(held_out, demos.ends)
    found: list[Example] = []
    for ended in (rng.random(count if len(held_out) else 0) < 0.5) & (len(finals) > 0):
        index = int(rng.choice(finals if ended else others))
        motion = None if tokens is None else tokens[index].tolist()
        found.append(_completion_example(demos, demos.reader[index], bool(ended), finals, rng, motion))
    return found


def _completion_example(
    demos: Demos,
    row: Mapping[str, Any],
    ended: bool,
    finals: NDArray[np.int64],
    rng: np.random.Generator,
    motion: Sequence[int] | None,
) -> Example:
    """Whether a goal was completed; at the end of an episode the goal is another's now and then, drawn from `finals`."""
    goal, done = row["instruction"], ended
    if ended and rng.random() < 0.3:
        other = demos.reader[int(rng.choice(finals))]["instruction"]
        done, goal = other == goal, other
    prompt = critic_prompt(goal, row["visible"], history_of(row), motion, demos.style, LOG_LENGTH)
    return Example(with_answer(prompt, "yes" if done else "no"), (demos.view(row),))
