"""Plans with a stored model: Proprio-MLLM, its ablations, the base model, and the language model alone, through the same class.

What sets them apart is stored with the weights (`config.json`): whether they see, MPE mode, CSE switch, and whether motion
tokens stand before an answer. All read whole episodes in words (`proprio_mllm.model.wording`).

The episode's log is kept as it grows; before each answer comes the block of what is known now. Answers are held to the grammar
of actions and to known ids, so no reply is invalid. Steps that are bound to be refused are not taken, nor a third time what was
refused twice from the same stance: the model's second choice is.

Paper: Proprio-MLLM as embodied planner, with reflection or without (Table III). The paper's prompt is not published. Here a
model that reflects says after a failure of which of the paper's types it is and what changes, before it plans; half of its
lessons are so. The log, in which failed steps stand with their codes, is the same without.
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from peft import PeftModel
from torch import Tensor
from transformers import DynamicCache

from interface.effects import Walk
from interface.feedback import Feedback
from interface.observation import Observation
from interface.sightings import Seen
from interface.steps import PlanStep
from interface.symbolic import events_of
from proprio_mllm.model.batch import Collator, Example
from proprio_mllm.model.building import load_model, load_motion, merge_adapter
from proprio_mllm.model.chat import Encoded
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.observing import EpisodeLog, turn_example, view_of
from proprio_mllm.model.placing import Placing, finder_of, stands_alone
from proprio_mllm.model.word_tokens import WordTokens, tokens_of
from proprio_mllm.model.wording import Words, read_step
from proprio_mllm.planners.answers import AnswerGrammar
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo, Usage, check_weights

logger = logging.getLogger(__name__)

#: Refusals of a step from one stance after which another one is taken.
_REFUSALS: Final = 2
_CHOICES: Final = 4

#: Tokens that may follow: the word that each closes, and the words that it begins or goes on with, spelt.
_Following = dict[int, tuple[str | None, dict[str, list[int]]]]


@dataclass(slots=True, kw_only=True)
class WordsState(EpisodeLog):
    """One episode, as far as it was read.

    Attributes:
        generator: draws the tokens where a temperature asks for it.
        cache: keys and values of the first `cached` tokens of the log.
        cached: how many.
        refused: how often each step was refused, or walked to where one stood, since the last one that changed something.
    """

    generator: torch.Generator
    cache: DynamicCache = field(default_factory=DynamicCache)
    cached: int = 0
    refused: dict[str, int] = field(default_factory=dict)

    def look(self, observation: Seen) -> list[int]:
        """As the log does; counts what was refused."""
        known, steps = self.told, len(self.sizes)
        now = EpisodeLog.look(self, observation)
        if len(self.sizes) <= steps and self.cached > self.sizes[0]:  # the oldest were dropped
            self.cached = self.sizes[0]
            self.cache.crop(self.cached - self.cache.get_seq_length())
        if self.told > known:
            self._count(observation)
        return now

    def _count(self, observation: Seen) -> None:
        before, last = [None, *observation.history][-2:]
        assert last is not None
        done = [event.action for events in events_of([last]) for event in events if event.ok]
        again = before is not None and before.step == last.step and not self.sightings.new
        if done and not (again and done[0].spec.has_effect(Walk)):
            self.refused.clear()
        else:
            self.refused[last.step] = self.refused.get(last.step, 0) + 1


class WordsPlanner:
    """A model in this process.

    Args:
        model: in evaluation mode.
        motion: the motion tokenizer; needed when the model sees and its answers stand after motion tokens.
        temperature: 0 takes the most likely word.
        insist: whether steps may be taken that are bound to bring nothing (`AnswerGrammar`), or were refused twice.
        reflection: whether the model says what went wrong after a failure; one that has not learnt to never does.
    """

    privileged = False

    def __init__(
        self,
        model: ProprioMLLM,
        motion: MotionTokenizer | None = None,
        temperature: float = 0.0,
        insist: bool = False,
        reflection: bool = True,
    ) -> None:
        self.model, self.motion, self.temperature, self.insist = model, motion, temperature, insist
        words = tokens_of(model.processor.tokenizer)
        learnt = not isinstance(words, WordTokens) or "why" in words.known
        if not (learnt or reflection):
            logger.warning("reflection=off changes nothing: this model has not learnt to reflect")
        self.reflection = reflection and learnt
        self.image_size = model.cfg.image_size if model.cfg.sees else 0
        self._tokenizer = model.processor.tokenizer
        self._collator = Collator(model.processor, model.cfg)
        finder = finder_of(model)
        self._placing = None if finder is None else Placing(model, finder)
        self._state: WordsState | None = None
        self._pad = int(self._tokenizer.pad_token_id)

    @staticmethod
    def load(
        folder: str | Path,
        temperature: float = 0.0,
        train: str = "",
        insist: bool = False,
        adapter: str | None = None,
        reflection: bool = True,
    ) -> WordsPlanner:
        """Reads a stored model.

        Args:
            folder: what `save_model` wrote.
            temperature: see the class.
            train: command that makes the weights, for the message when they are absent.
            insist: see the class.
            adapter: adapter to activate; None takes the first.
            reflection: see the class.

        Raises:
            WeightsError: when the folder has no model.
        """
        model = load_model(check_weights(folder, train), adapter)
        if isinstance(model.vlm, PeftModel) and model.table.dtype == torch.float32 and not model.cfg.four_bit:
            merge_adapter(model)  # halves a reply; at half precision it would round the adapter off
        device = "cuda" if torch.cuda.is_available() else "cpu"
        return WordsPlanner(model.to(device), load_motion(folder), temperature, insist, reflection)

    def begin(self, task: TaskInfo, rng: np.random.Generator) -> WordsState:
        """The state of a new episode."""
        generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        return WordsState(words=tokens_of(self._tokenizer), reflects=self.reflection, generator=generator)

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Forgets the last episode."""
        self._state = self.begin(task, rng)

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The model's next step; earlier feedback is in the observation's history."""
        assert self._state is not None
        return self.step_batch([observation], [self._state])[0]

    def step_batch(self, observations: Sequence[Seen], states: Sequence[WordsState] | None = None) -> list[PlannerReply]:
        """One reply per observation; the latency is the batch's, shared equally."""
        assert states is not None
        started = time.perf_counter()
        answers = [self._answer(one, state) for one, state in zip(observations, states, strict=True)]
        open_rows = answers
        for choice in range(_CHOICES):
            self._write(open_rows)
            if self.insist or choice == _CHOICES - 1:
                break
            open_rows = [answer for answer in open_rows if answer.refused() and answer.reconsider()]
            if not open_rows:
                break
        each_s = (time.perf_counter() - started) / len(answers)
        replies: list[PlannerReply] = []
        for answer in answers:
            step, reflection = answer.step(), answer.reflection
            text, usage = f"{reflection}\n{step.to_text()}".strip(), Usage(calls=1, reflections=int(bool(reflection)))
            replies.append(PlannerReply(text, step, "", answer.read + len(answer.words), each_s, usage))
        return replies

    def _answer(self, observation: Seen, state: WordsState) -> _Answer:
        now = state.look(observation)
        seen = observation if isinstance(observation, Observation) else None
        turn = turn_example(self.model, state.log, now, seen, self.motion)
        belief = state.sightings.belief
        reflects = state.reflects and belief.failed is not None
        known, places = observation.known_objects, self.model.cfg.places
        place = None if seen is None or self._placing is None else functools.cache(functools.partial(self._place, seen))
        return _Answer(AnswerGrammar(known, None if self.insist else belief, reflects, places, place), state, turn)

    def _place(self, observation: Observation, thing: Words) -> Words:
        """Where a thing is by the point map, in words; none where it is not seen, or not alone of its name."""
        assert self._placing is not None
        return self._placing([view_of(observation)], [thing])[0] if stands_alone(thing, observation.visible_objects) else ()

    def _write(self, answers: Sequence[_Answer]) -> None:
        """Continues every answer to its end; what has been read of a log before is not read again for an answer alone."""
        state = answers[0].state if len(answers) == 1 else None
        cache = DynamicCache() if state is None else state.cache
        for answer in answers:
            answer.skip()
        batch = self._collator([answer.example(0 if state is None else state.cached) for answer in answers], padding="left")
        batch = self.model.look(batch.to(self.model.device))
        while True:
            scores = self.model.following(batch, cache).cpu()
            taken = [answer.choose(row, self.temperature) for answer, row in zip(answers, scores, strict=True)]
            if state is not None:  # in a batch all rows grow by as much
                taken[0] += answers[0].skip()
            if all(answer.ended for answer in answers):
                break
            batch = batch.then(torch.tensor([tokens or [self._pad] for tokens in taken], device=self.model.device))
        if state is not None:
            state.cached = len(state.log)
            state.cache.crop(state.cached - state.cache.get_seq_length())  # minus what is no log


class _Answer:
    """An answer under way: its words and their tokens, how sure each was, and the tokens of the word that is being written."""

    def __init__(self, grammar: AnswerGrammar, state: WordsState, turn: Example) -> None:
        self._grammar, self.state, self._turn = grammar, state, turn
        self.words: list[str] = []
        self._tokens: list[list[int]] = []
        self._margins: list[float] = []
        self._begun: list[int] = []
        self._margin = float("inf")
        self._forbidden: dict[Words, set[str]] = {}
        self._next: _Following | None = None

    @property
    def read(self) -> int:
        """Tokens before it."""
        return 0 if self._turn.tokens is None else len(self._turn.tokens.ids)

    def begun(self) -> list[int]:
        """Its tokens so far."""
        return [token for tokens in (*self._tokens, self._begun) for token in tokens]

    def example(self, read: int) -> Example:
        """What stands before it and its tokens so far, without the first tokens."""
        assert self._turn.tokens is not None
        ids = (*self._turn.tokens.ids, *self.begun())[read:]
        return replace(self._turn, tokens=Encoded(ids, (False,) * len(ids)), start=read)

    @property
    def ended(self) -> bool:
        """Whether nothing may follow."""
        return not self._following()

    def choose(self, scores: Tensor, temperature: float) -> list[int]:
        """Takes the next token by the scores (V,) of tokens; none when the answer has ended."""
        tokens = list(self._following())
        if not tokens:
            return []
        values = scores[tokens]
        if temperature > 0.0:
            index = int(torch.multinomial((values / temperature).softmax(-1), 1, generator=self.state.generator))
        else:
            index = int(values.argmax())
        if len(tokens) > 1:
            self._margin = min(self._margin, float(values[index] - values[torch.arange(len(tokens)) != index].max()))
        self._take(tokens[index])
        return [tokens[index]]

    def skip(self) -> list[int]:
        """Takes tokens as long as one alone may follow, for which no scores are needed."""
        taken: list[int] = []
        while len(following := self._following()) == 1:
            taken += following
            self._take(taken[-1])
        return taken

    def _following(self) -> _Following:
        """The tokens that may follow, each with the word that it closes, if any, and the spelling of those it goes on with.

        Words may be of several tokens, and one may begin as another does (`_1` and `_10`): such a word ends with the first
        token of the word that follows it.
        """
        if self._next is None:
            self._next, size = {}, len(self._begun)
            spelt = self._options(self.words)
            live = {word: tokens for word, tokens in spelt.items() if tokens[:size] == self._begun}
            for word, tokens in live.items():
                if len(tokens) > size:
                    self._next.setdefault(tokens[size], (None, {}))[1][word] = tokens
            ended = next((word for word, tokens in live.items() if len(tokens) == size), None)
            for word, tokens in ({} if ended is None else self._options([*self.words, ended])).items():
                closed, others = self._next.setdefault(tokens[0], (ended, {}))
                if closed is not None:
                    others[word] = tokens
        return self._next

    def _take(self, token: int) -> None:
        closed, live = self._following()[token]
        if closed is not None:
            self._close(closed)
        self._begun.append(token)
        if len(live) == 1 and next(iter(live.values())) == self._begun:
            self._close(next(iter(live)))
        self._next = None

    def _options(self, words: Sequence[str]) -> dict[str, list[int]]:
        """Spelling of every word that may follow."""
        forbidden = self._forbidden.get(tuple(words), ())
        return {word: self.state.words.tokens([word]) for word in self._grammar.allowed(words) if word not in forbidden}

    def _close(self, word: str) -> None:
        self.words.append(word)
        self._tokens.append(self._begun)
        self._margins.append(self._margin)
        self._begun, self._margin = [], float("inf")

    def step(self) -> PlanStep:
        """The step of a finished answer."""
        return read_step(self.words, self._grammar.ids)

    @property
    def reflection(self) -> str:
        """What it says of a failure, empty where it does not."""
        return " ".join(self.words[: self._grammar.reflected])

    def refused(self) -> bool:
        """Whether this step was refused as often as it may be."""
        return self.state.refused.get(self.step().to_text(), 0) >= _REFUSALS

    def reconsider(self) -> bool:
        """Goes back to the word of the step that was least certain, and rules it out; false where there was no other."""
        first = self.words.index("do") + 1
        place = min(range(first, len(self.words)), key=lambda index: self._margins[index])
        if self._margins[place] == float("inf"):
            return False
        self._forbidden.setdefault(tuple(self.words[:place]), set()).add(self.words[place])
        del self.words[place:], self._tokens[place:], self._margins[place:]
        self._next = None
        return True
