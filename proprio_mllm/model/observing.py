"""From an observation to an example: the one place where a planner at run time and a demonstration in training meet.

Both go through `turn_example`, so that the model sees the same text, image and robot state in training and in use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from configs.schema.model import ModelConfig
from interface.observation import Observation
from interface.sightings import Seen, Sightings
from proprio_mllm.model.batch import Example, View
from proprio_mllm.model.chat import IMAGE, Encoded
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.vocabulary import motion_text
from proprio_mllm.model.word_tokens import Tokens, opening
from proprio_mllm.model.wording import log_words, prefix_words, state_words

#: Longest log that is learnt from, words.
LONGEST_LOG: Final = 320


@dataclass(slots=True)
class EpisodeLog:
    """An episode's log as tokens, observation by observation.

    A log that would become longer than any that is learnt from loses its oldest steps, about half of it at once: what came of
    them is in the state.

    Attributes:
        words: the episode's tokens.
        sightings: what has been seen, and what the log says.
        log: tokens of prefix and log.
        told: how many steps were told.
        reflects: whether failures are reflected on.
        sizes: tokens of the prefix and of each step that is in the log.
    """

    words: Tokens
    sightings: Sightings = field(default_factory=Sightings)
    log: list[int] = field(default_factory=list)
    told: int = 0
    reflects: bool = False
    sizes: list[int] = field(default_factory=list)

    def look(self, observation: Seen) -> list[int]:
        """Takes in an observation, at most one step after the last; the tokens of the state, which follow the log."""
        self.sightings.look(observation)
        steps = observation.history[self.told :]
        more = self.words.tokens(log_words(steps, self.sightings.new) if self.log else prefix_words(observation))
        self.log += more
        self.sizes.append(len(more))
        self.told = len(observation.history)
        longest = round(LONGEST_LOG * self.words.length)
        if len(self.log) > longest:
            self._forget(longest // 2)
        return self.words.tokens(state_words(self.sightings, self.reflects))

    def _forget(self, kept: int) -> None:
        """Drops the oldest steps, the newest apart, until so many tokens are left."""
        prefix = self.sizes[0]
        while len(self.log) > kept and len(self.sizes) > 2:
            del self.log[prefix : prefix + self.sizes.pop(1)]


def view_of(observation: Observation) -> View:
    """The observation's image with its camera and the robot's own body."""
    return View(observation.image, observation.camera, observation.proprioception.key_bodies_in_pelvis)


def motion_codes(observation: Observation, cfg: ModelConfig, motion: MotionTokenizer | None) -> tuple[int, ...] | None:
    """Motion tokens of the observation's window, or None when the configuration shows no proprioception.

    Raises:
        ValueError: when proprioception is on without a motion tokenizer.
    """
    if not cfg.proprioception:
        return None
    if motion is None:
        raise ValueError("proprioception=true needs a motion tokenizer, got None")
    return motion.encode_window(observation.proprioception.motion)


def turn_example(
    model: ProprioMLLM,
    log: Sequence[int],
    now: Sequence[int],
    observation: Observation | None,
    motion: MotionTokenizer | None = None,
    answer: Sequence[int] = (),
    read: int = 0,
) -> Example:
    """One decision of an episode (`proprio_mllm.model.wording`).

    A picture and motion tokens stand before the word that opens the answer, so that the log, which is told in words alone, has
    to be read once only.

    Args:
        model: gives the tokenizer, and says whether it sees and feels.
        log: tokens of prefix and log.
        now: tokens of the state, with the word that opens the answer.
        observation: what is seen; None for models that do not see.
        motion: the motion tokenizer.
        answer: tokens of the answer, or its beginning; learnt in training.
        read: tokens of the log to leave out because they have been read.
    """
    if not model.cfg.sees:
        return pictured_turn(model, log, now, None, None, answer, read)
    assert observation is not None
    return pictured_turn(model, log, now, view_of(observation), motion_codes(observation, model.cfg, motion), answer, read)


def pictured_turn(
    model: ProprioMLLM,
    log: Sequence[int],
    now: Sequence[int],
    view: View | None,
    codes: Sequence[int] | None,
    answer: Sequence[int] = (),
    read: int = 0,
    told: slice = slice(0),
) -> Example:
    """`turn_example` with its parts at hand: the view, None for none, and the motion tokens, None for none.

    What is `told` of the answer is not learnt.
    """
    tokens = [*log, *now]
    if view is not None:
        text = IMAGE + (motion_text(codes) if codes is not None else "")
        sight = model.processor.tokenizer(text, add_special_tokens=False)["input_ids"]
        before = len(now) - opening(model.processor.tokenizer)
        tokens = [*log, *now[:before], *sight, *now[before:]]
    learnt = [True] * len(answer)
    learnt[told] = [False] * len(answer[told])
    learnt = [False] * len(tokens) + learnt
    encoded = Encoded(tuple([*tokens, *answer][read:]), tuple(learnt[read:]))
    return Example(views=() if view is None else (view,), tokens=encoded, start=read)
