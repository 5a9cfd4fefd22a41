"""Judging questions from the logs of lessons: was the goal completed, and which objects are in a state.

A released model can answer such questions; the tiny one has to learn it. The answers come from what the log itself says (an
action with `ok`, or the end of a successful episode), never from privileged simulator state, so a judge learns to
read its inputs only.
"""

from __future__ import annotations

from typing import Final

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
    style = demos.style
    ended = rng.random() < 0.6 and len(demos.finals) > 0
    if ended:
        index = int(rng.choice(demos.finals))
    row = demos.reader[int(index)]
    motion = None if tokens is None else tokens[int(index)].tolist()
    history = history_of(row)
    if rng.random() < 0.5:
        goal, done = row["instruction"], ended
        if ended and rng.random() < 0.3:
            other = demos.reader[int(rng.choice(demos.finals))]["instruction"]
            done, goal = other == goal, other
        prompt = critic_prompt(goal, row["visible"], history, motion, style, LOG_LENGTH)
        return Example(with_answer(prompt, "yes" if done else "no"), (demos.view(row),))
    states = states_from_log(history[-LOG_LENGTH:])
    relation = asked_relation(states, rng)
    prompt = self_ask_prompt(relation, row["visible"], history, motion, style, LOG_LENGTH)
    return Example(with_answer(prompt, answers(states[relation])), (demos.view(row),))
