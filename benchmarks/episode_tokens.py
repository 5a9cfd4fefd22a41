"""How many tokens a decision costs with a pretrained tokenizer: the whole episode as one sequence, and a prompt of its own.

    python -m benchmarks.episode_tokens tokenizer=/path/to/Qwen2.5-VL-7B-Instruct episodes=200

The teacher acts in episodes in words. A sequence that is only ever added to is read once: a decision then costs what is new in
the log, the state block and the answer. `anew` counts what has to be read where nothing is kept. Pictures and motion are left
out: they are the same in both.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from transformers import Qwen2Tokenizer

from configs.arguments import command, read_arguments
from proprio_mllm.evaluation.lessons import WordsOnly
from proprio_mllm.model.chat import render
from proprio_mllm.model.observing import EpisodeLog
from proprio_mllm.model.prompts import with_answer
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import answer_words
from proprio_mllm.planners.scripted.planner import ScriptedPlanner
from proprio_mllm.report.sft import plan_prompt

_STEPS = 50


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        tokenizer: folder of a tokenizer of Qwen's.
        episodes: how many.
        history: steps of the log that a prompt of its own holds.
    """

    tokenizer: str
    episodes: int = 200
    history: int = 4


def counts(episode: WordsOnly, tokenizer: Qwen2Tokenizer, history: int) -> list[tuple[int, int, int, int]]:
    """Per decision of an episode: new tokens of the log, tokens of state and answer, of the log before, of its own prompt."""
    teacher, log, found = ScriptedPlanner(), EpisodeLog(tokens_of(tokenizer)), list[tuple[int, int, int, int]]()
    while not episode.world.done() and episode.steps < _STEPS:
        shown, before = episode.shown(), len(log.log)
        step, job = teacher.decide(shown)
        now = log.look(shown)
        if job is None:
            break
        said = log.words.tokens(answer_words(job.verb, job.target, step))
        parts = (shown.visible_objects, shown.known_objects, shown.history, len(shown.history), _STEPS, history)
        prompt = with_answer(plan_prompt(shown.instruction, shown.robot, *parts), step.to_text())
        own = len(tokenizer(render(prompt))["input_ids"])
        found.append((len(log.log) - before, len(now) + len(said), before, own))
        episode.take(step)
    return found


@command()
def main(arguments: Sequence[str]) -> int:
    """Prints what each way of asking costs."""
    options = read_arguments(Options, arguments)
    tokenizer = Qwen2Tokenizer.from_pretrained(options.tokenizer)
    rows = np.array([row for k in range(options.episodes) for row in counts(WordsOnly(-1 - k), tokenizer, options.history)])
    fresh, state, before, own = rows.T
    sys.stdout.write(f"{len(rows)} decisions of {options.episodes} episodes; mean and 95th percentile of tokens a decision\n")
    for name, tokens in (("kept", fresh + state), ("anew", before + fresh + state), ("a prompt of its own", own)):
        sys.stdout.write(f"{name}: {tokens.mean():.0f}, {np.percentile(tokens, 95):.0f}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
