"""`stage=alignment` (paper, stage 2): motion, image and text are aligned through LoRA, first apart and then together.

| phase | pairs | trains | frozen |
|---|---|---|---|
| text (2a-i) | motion to text, to body state and back, masked motion, words | motion rows, LoRA | vision, merger, CSE |
| image (2a-ii) | motion and image to text, motion to body state, replay | motion rows, LoRA, CSE, MPE | vision, merger |
| joint (2b) | all of them | motion rows, LoRA, CSE, MPE, merger | vision, backbone unless `alignment.whole` |

"Freeze the image and text weights separately" leaves open which weights; in this reading the vision tower stays as it is while
motion meets text, and while motion and CSE meet images. LoRA trains throughout: what CSE adds to a visual token is of no use
before the language model looks the token up by the object's name, which CSE alone cannot teach it. Besides clip captions,
motion and image to text holds questions about the robot's own body in its scene (which arm reaches an object, how far the body
must go down), and motion to text asks which hands are open and how high the pelvis is, which captions do not say and planning
needs. Wherever LoRA trains, a share of episodes in words keeps what was learnt before, and where images are read, a share of
decisions with pictures, and motion tokens before their answers; the paper does not mention any such replay.

The control `variant=no_proprio` has the same phases, and of their pairs those that need no motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from configs.schema.train import AlignmentConfig
from data.motion import HAND_OPENING, OPEN_HAND, PELVIS_HEIGHT
from proprio_mllm.model.batch import Batch, Collator, Example
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.prompts import Style, body_state_prompt, described_motion, filled_motion, made_motion
from proprio_mllm.training.asking import answer_shares
from proprio_mllm.training.base import EPISODE_ROWS, looking_around
from proprio_mllm.training.judging import state_example
from proprio_mllm.training.loop import Objective, Parts
from proprio_mllm.training.phrases import body_state_words
from proprio_mllm.training.sources import Clips, Demos, Views, grips_of
from proprio_mllm.training.turns import Turns
from proprio_mllm.training.words import WordBatch, WordsObjective

Kind = Literal["say", "feel", "do", "fill", "say_image", "body", "plan", "judge", "text"]


@dataclass(frozen=True, slots=True)
class Phase:
    """What a phase reads and trains (`proprio_mllm.model.groups`)."""

    groups: tuple[str, ...]
    kinds: tuple[Kind, ...]


PHASES: Final[Mapping[str, Phase]] = {
    "text": Phase(("rows", "lora"), ("say", "feel", "feel", "feel", "do", "fill", "text")),
    "image": Phase(("rows", "lora", "cse", "mpe"), ("say_image", "feel", "body", "body", "body", "body", "plan")),
    "joint": Phase(
        ("rows", "lora", "cse", "mpe", "merger"),
        ("say", "feel", "feel", "do", "fill", "say_image", "body", "body", "body", "body", "body", "body", "plan"),
    ),
}


def groups_of(phase: str, cfg: AlignmentConfig) -> tuple[str, ...]:
    """What a phase trains; with `whole` the last one trains the language model's own layers too."""
    return (*PHASES[phase].groups, *(("lm",) if cfg.whole and phase == "joint" else ()))


class AlignmentData:
    """Examples of every kind, with motion tokens computed once."""

    def __init__(
        self,
        model: ProprioMLLM,
        tokenizer: MotionTokenizer,
        clips: Clips,
        views: Views,
        demos: Demos,
        turns: Turns,
        words: WordsObjective,
        cfg: AlignmentConfig,
    ) -> None:
        self.tokenizer, self.clips, self.views, self.demos = tokenizer, clips, views, demos
        self.turns, self.words = turns, words
        self._cfg, self._collator = cfg, Collator(model.processor, model.cfg)
        self._style: Style = model.cfg.prompt
        self._proprioception = model.cfg.proprioception
        self._grips = grips_of(demos)
        with_images = [i for i, images in enumerate(clips.reader.column("image_frames")) if images]
        self._pictured = np.intersect1d(np.asarray(with_images, dtype=np.int64), clips.split.train)
        if self._proprioception and not len(self._pictured):
            raise ValueError("no training clip has pictures; alignment needs stage=data with data.replay.enabled=true")

    def _encode(self, windows: NDArray[np.float32]) -> list[list[int]]:
        return self.tokenizer.encode(torch.from_numpy(windows)).tolist()

    def batch(self, kind: Kind, rng: np.random.Generator, size: int) -> Parts:
        """A batch of one kind from the training rows, in parts."""
        if kind == "text":
            return self.words.batch(rng, max(1, size // EPISODE_ROWS))
        if kind == "plan":
            return Parts((kind, part) for part in self.turns.batch(rng, max(1, size // EPISODE_ROWS)))
        return Parts((kind, part) for part in self._collator.in_parts(self._examples(kind, rng, size)))

    def _examples(self, kind: Kind, rng: np.random.Generator, size: int) -> list[Example]:
        if kind == "judge":
            return [state_example(self.demos, int(i), rng, self.turns.codes) for i in self.demos.draw(rng, size)]
        if kind == "body":
            return [self._body(int(i), rng) for i in rng.choice(self.views.split.train, size)]
        if kind == "feel":
            return self._feel(rng, size)
        if kind == "say_image":
            return [self._say_image(int(i), rng) for i in rng.choice(self._pictured, size)]
        frames = self.tokenizer.cfg.window
        rows = rng.choice(self.clips.split.train, size)
        codes = self._encode(np.stack([self.clips.window(int(i), frames, rng) for i in rows]))
        return [self._motion_text(kind, int(i), code, rng) for i, code in zip(rows, codes, strict=True)]

    def _motion_text(self, kind: Kind, clip: int, codes: Sequence[int], rng: np.random.Generator) -> Example:
        caption = self.clips.caption(clip, rng)
        if kind == "say":
            return Example(described_motion(codes, caption, style=self._style))
        if kind == "do":
            return Example(made_motion(caption, codes, self._style))
        hidden = rng.random(len(codes)) < self._cfg.mask
        return Example(filled_motion([None if h else c for c, h in zip(codes, hidden, strict=True)], codes, self._style))

    def _feel(self, rng: np.random.Generator, size: int) -> list[Example]:
        """Every grip as often: full hands are rare."""
        grips, codes = self._grips, self.turns.codes
        assert codes is not None
        rows = [int(rng.choice(grips[group])) for group in rng.integers(len(grips), size=size)]
        return [Example(body_state_prompt(codes[i].tolist(), *body_state(self.demos.motions[i]), self._style)) for i in rows]

    def _say_image(self, clip: int, rng: np.random.Generator) -> Example:
        view, motion = self.clips.view(clip, rng)
        codes = self.tokenizer.encode_window(motion)
        return Example(described_motion(codes, self.clips.caption(clip, rng), image=True, style=self._style), (view,))

    def _body(self, index: int, rng: np.random.Generator) -> Example:
        row = self.views.row(index)
        codes = self.tokenizer.encode_window(row.motion) if self._proprioception else None
        return looking_around(self.views, row, self._cfg.questions, rng, codes)


def body_state(motion: NDArray[np.floating]) -> tuple[str, str]:
    """Which hands are open at the end of a window (T, F), and the pelvis' height in metres, in words."""
    left, right = motion[-1, HAND_OPENING] >= OPEN_HAND
    return body_state_words(bool(left), bool(right), float(motion[-1, PELVIS_HEIGHT]))


@torch.no_grad()
def body_state_accuracy(model: ProprioMLLM, demos: Demos, codes: NDArray[np.int64], limit: int = 200) -> dict[str, float]:
    """Share of held-out windows whose open hands and pelvis height the model says rightly, with the commonest answer's share.

    The height is asked after the right answer about the hands.

    Args:
        model: in evaluation mode.
        demos: the rows.
        codes: (N, T / stride) their motion tokens.
        limit: most rows.
    """
    rows = [int(i) for i in demos.split.test[:limit]]
    truth = [body_state(demos.motions[i]) for i in rows]
    result: dict[str, float] = {}
    for part, name in enumerate(("hands", "pelvis")):
        asked = [
            Example(body_state_prompt(codes[i].tolist(), hands if part else "", "", model.cfg.prompt))
            for i, (hands, _) in zip(rows, truth, strict=True)
        ]
        result |= answer_shares(model, name, asked, [state[part] for state in truth])
    return result


class AlignmentObjective(Objective):
    """One phase."""

    def __init__(self, model: ProprioMLLM, data: AlignmentData, phase: str, cfg: AlignmentConfig, key: str) -> None:
        if phase not in PHASES:
            raise ValueError(f"alignment phase {phase!r}; allowed: {', '.join(PHASES)}")
        self.name = f"alignment/{phase}"
        self.module: nn.Module = model
        self.key = key
        kinds = PHASES[phase].kinds
        self._data, self._cfg = data, cfg
        feels = model.cfg.proprioception
        self._others: list[Kind] = [kind for kind in kinds if kind == "body" or (feels and kind not in ("plan", "text"))]
        self._text_share = cfg.text_share if "plan" in kinds else 1.0

    def kind(self, rng: np.random.Generator) -> Kind:
        """Drawn anew each step."""
        if not self._others or rng.random() < self._cfg.plan_share:
            if rng.random() < self._text_share:
                return "text"
            return "judge" if rng.random() < self._cfg.judge_share else "plan"
        return self._others[int(rng.integers(len(self._others)))]

    def batch(self, rng: np.random.Generator, size: int, kind: Kind) -> Parts:
        """A batch of a kind."""
        return self._data.batch(kind, rng, size)

    def weight(self, batch: Parts) -> float:
        """Tokens of the answers."""
        first = batch[0]
        return float(first.answers if isinstance(first, WordBatch) else first[1].out_of)

    def loss(
        self, module: nn.Module, batch: tuple[Kind, Batch] | WordBatch, generator: torch.Generator
    ) -> tuple[Tensor, Mapping[str, float]]:
        """Cross-entropy over the answers; nothing is drawn."""
        if isinstance(batch, WordBatch):
            return self._data.words.loss(module, batch, generator)
        kind, inputs = batch
        out = module(inputs)
        return out.loss, {f"{kind}_loss": float(out.loss.detach()), f"{kind}_accuracy": out.correct / max(inputs.out_of, 1)}
