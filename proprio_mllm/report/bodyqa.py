"""BodyQA: what a model sees and feels of its own body, asked without any planning.

    python -m proprio_mllm bodyqa weights=weights/tiny/full [questions=2000] [robots=[h1,x1]] [blind=true]
    python -m proprio_mllm bodyqa backend=gpt4o

Six questions on views of rooms that no stage trains on, with both robots posed anywhere in them: on which side of me is a
thing, how far, how high, which arm reaches it better, which of my hands are open, how high is my pelvis. The answers are the
simulator's own. Beside the share of right answers (with its Wilson interval) stand that of the commonest answer and, with
`blind`, that of the same model with a grey picture and a body of zeros.

A stored model reads motion tokens and answers its own short questions. A model behind a backend is asked in English, with the
picture and, unless `body=false`, its body in words (`proprio_mllm.planners.chat.view.body_text`); blind it gets neither.

Paper: none; it says that proprioception helps, this asks what the model knows of it.
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from configs.arguments import command, read_arguments
from configs.compose import group_file
from configs.schema.backend import BackendConfig
from configs.schema.collect import CollectConfig
from configs.schema.model import ModelConfig
from configs.validate import ConfigError, build
from data.files import write_text
from data.interface.bodies import PAPER_ROBOTS
from data.interface.observation import Proprioception
from data.motion import HAND_OPENING, OPEN_HAND, PELVIS_HEIGHT
from proprio_mllm.backends.factory import make_backend
from proprio_mllm.backends.protocol import Backend, ChatMessage, ChatRequest
from proprio_mllm.model.batch import Example
from proprio_mllm.model.building import load_model, load_motion
from proprio_mllm.model.prompts import body_state_prompt, looking
from proprio_mllm.model.questions import ask
from proprio_mllm.planners.chat.view import body_text, encoded
from proprio_mllm.planners.protocol import check_weights
from proprio_mllm.report.statistics import wilson
from proprio_mllm.report.table import Table
from proprio_mllm.training.asking import replies
from proprio_mllm.training.phrases import body_state_words
from proprio_mllm.training.sources import ViewRow, Views
from sim.collection.collect import collect
from sim.scene.rooms import room_names
from sim.tasks.sample import TRAIN_ROOMS

__all__ = ["BodyQaConfig", "Question", "Score", "main", "questions_of", "scores"]

_ABOUT_THINGS: Final = ("side", "distance", "height", "arm")
_ABOUT_SELF: Final = ("hands", "pelvis")
_KINDS: Final = (*_ABOUT_THINGS, *_ABOUT_SELF)
_FPS: Final = 20.0
_GREY: Final = 128
#: What a model behind a backend may answer, and how it is asked for it.
_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "side": ("left", "ahead", "right"),
    "distance": ("near", "middle", "far"),
    "height": ("low", "level", "high"),
    "arm": ("left", "right", "either"),
    "hands": ("left right", "left", "right", "none"),
}
_METRES: Final = "Answer with the metres alone, rounded to 0.05, such as 0.85."


@dataclass(frozen=True)
class BodyQaConfig:
    """What is asked of whom.

    Attributes:
        weights: folder of a stored model.
        backend: a model in `configs/backend`; in place of weights.
        questions: how many, shared out among six kinds.
        robots: whose bodies.
        blind: whether everything is asked once more without picture and body.
        body: whether a backend's model is told its body in words.
        seed: of poses and things.
        out: folder of views and results.
        workers: processes that draw the views.
    """

    weights: str | None = None
    backend: str | None = None
    questions: int = 2000
    robots: tuple[str, ...] = PAPER_ROBOTS
    blind: bool = True
    body: bool = True
    seed: int = 0
    out: str = "outputs/bodyqa"
    workers: int = 2

    def __post_init__(self) -> None:
        if (self.weights is None) == (self.backend is None):
            raise ValueError(f"weights {self.weights!r} and backend {self.backend!r}; allowed: one of the two")
        if self.questions < len(_KINDS):
            raise ValueError(f"questions {self.questions} must be at least {len(_KINDS)}")


@dataclass(frozen=True, slots=True)
class Question:
    """One question about a view.

    Attributes:
        kind: one of side, distance, height, arm, hands, pelvis.
        thing: the object it is about, empty for questions about oneself.
        answer: the truth, in the words that stored models learn.
        row: the view.
    """

    kind: str
    thing: str
    answer: str
    row: ViewRow


@dataclass(frozen=True, slots=True)
class Score:
    """Right answers to one kind of question.

    Attributes:
        kind: the kind, or `all`.
        count: questions.
        right: right answers.
        commonest: how often the commonest right answer is right.
        blind: right answers without picture and body, None where that was not asked.
    """

    kind: str
    count: int
    right: int
    commonest: int
    blind: int | None


def questions_of(views: Views, count: int, seed: int) -> list[Question]:
    """Up to `count` questions, kinds in turn, one of a kind about a view.

    Args:
        views: every row is asked about; their style is terse, so that a question ends in its thing.
        count: how many.
        seed: of the choice of things.
    """
    rng, found = np.random.default_rng(seed), list[Question]()
    for index in range(len(views.reader)):
        row = views.row(index)
        for kind in _ABOUT_THINGS:
            for text, answer in views.pairs(row, (kind,), 1, rng):
                found.append(Question(kind, text.rpartition(" ")[2], answer, row))
        height = body_state_words(True, True, float(row.motion[-1, PELVIS_HEIGHT]))[1]
        found += [Question("hands", "", _hands(row.motion), row), Question("pelvis", "", height, row)]
    share = {kind: [one for one in found if one.kind == kind] for kind in _KINDS}
    each = -(-count // len(_KINDS))
    return [one for kind in _KINDS for one in share[kind][:each]][:count]


def _hands(motion: NDArray[np.float32]) -> str:
    """Which hands are open at the end of a motion (T, F), in words."""
    left, right = (bool(one >= OPEN_HAND) for one in motion[-1, HAND_OPENING])
    return body_state_words(left, right, 1.0)[0]


def scores(asked: Sequence[Question], answer: Callable[[Sequence[Question], bool], Sequence[str]], blind: bool) -> list[Score]:
    """Right answers by kind, and of all kinds.

    Args:
        asked: the questions.
        answer: answers questions, seeing or blind.
        blind: whether they are asked blind too.
    """
    seeing, dark = answer(asked, False), answer(asked, True) if blind else None
    found: list[Score] = []
    for kind in (*_KINDS, "all"):
        chosen = [number for number, one in enumerate(asked) if kind in (one.kind, "all")]
        if not chosen:
            continue
        right = sum(seeing[number] == asked[number].answer for number in chosen)
        unseen = None if dark is None else sum(dark[number] == asked[number].answer for number in chosen)
        kinds = [[asked[number].answer for number in chosen if asked[number].kind == name] for name in _KINDS]
        commonest = sum(max(Counter(answers).values()) for answers in kinds if answers)
        found.append(Score(kind, len(chosen), right, commonest, unseen))
    return found


def _stored(folder: str) -> tuple[ModelConfig, Callable[[Sequence[Question], bool], Sequence[str]]]:
    """A stored model's configuration, and how it answers."""
    model = load_model(check_weights(folder, "python train.py stage=all model=tiny release=weights"))
    tokens = load_motion(folder) if model.cfg.proprioception else None
    style = model.cfg.prompt
    if not model.cfg.sees:
        raise ConfigError(f"weights {folder!r}: the model has no eyes; allowed: those that see, such as weights/tiny/full")

    def example(one: Question, blind: bool) -> Example:
        motion = np.zeros_like(one.row.motion) if blind else one.row.motion
        codes = None if tokens is None else tokens.encode_window(motion)
        if one.kind in _ABOUT_SELF:
            hands = "" if one.kind == "hands" else _hands(motion)
            return Example(body_state_prompt([] if codes is None else codes, hands, "", style))
        view = one.row.view
        if blind:
            assert view.key_bodies is not None
            view = replace(view, image=np.full_like(view.image, _GREY), key_bodies=np.zeros_like(view.key_bodies))
        return Example(looking([(ask(one.kind, one.thing, style), "")], codes, style), (view,))

    def answer(asked: Sequence[Question], blind: bool) -> list[str]:
        size, said = 64, list[str]()
        for start in tqdm(range(0, len(asked), size), desc="blind" if blind else "seeing", unit="batch"):
            said += replies(model, [example(one, blind) for one in asked[start : start + size]], 10)
        return said

    return model.cfg, answer


def _chatting(backend: Backend, body: bool) -> Callable[[Sequence[Question], bool], Sequence[str]]:
    """How a model behind a backend answers."""

    def request(one: Question, blind: bool) -> ChatRequest:
        system = (
            "You are a humanoid robot and answer questions about what you see and about your own body. Sides, distances and "
            "heights are relative to your pelvis. Reply with the answer alone."
        )
        kind = one.kind
        question = {"hands": "Which of your hands are open?", "pelvis": "How high is your pelvis above the floor?"}.get(kind)
        choices = _METRES if kind == "pelvis" else f"Answer with one of: {', '.join(_CHOICES[kind])}."
        text = f"{question or ask(kind, one.thing, 'full')} {choices}"
        content = [] if blind else [encoded(one.row.view.image)]
        told = [body_text(_felt(one.row))] if body and not blind else []
        return ChatRequest((ChatMessage("system", (system,)), ChatMessage("user", (*content, *told, text))), max_tokens=32)

    def answer(asked: Sequence[Question], blind: bool) -> list[str]:
        bar = tqdm(asked, desc="blind" if blind else "seeing", unit="question")
        return [_read(one.kind, backend.complete(request(one, blind)).text) for one in bar]

    return answer


def _felt(row: ViewRow) -> Proprioception:
    assert row.view.key_bodies is not None
    return Proprioception(row.motion, _FPS, np.zeros(0), np.asarray(row.view.key_bodies, dtype=np.float64))


def _read(kind: str, text: str) -> str:
    """A reply in the words of the truth; as it is where it is none of them."""
    said = " ".join(re.findall(r"[a-z]+|\d+(?:\.\d+)?", text.lower()))
    if kind == "pelvis":
        number = re.search(r"\d+(?:\.\d+)?", said)
        return said if number is None else f"{round(float(number[0]) / 0.05) * 0.05:.2f}"
    words = said.replace("both", "left right").replace(" and ", " ").split()
    named = [word for word in words if any(word in choice.split() for choice in _CHOICES[kind])]
    return " ".join(dict.fromkeys(named))


def _table(title: str, found: Sequence[Score]) -> Table:
    rows = []
    for one in found:
        low, high = wilson(one.right, one.count)
        cells = [
            f"{100 * one.right / one.count:.1f} [{100 * low:.1f}, {100 * high:.1f}]",
            f"{100 * one.commonest / one.count:.1f}",
        ]
        cells.append("" if one.blind is None else f"{100 * one.blind / one.count:.1f}")
        rows.append((one.kind, str(one.count), *cells))
    return Table(title, ("question", "asked", "right %, 95 % interval", "commonest answer %", "blind %"), tuple(rows))


@command()
def main(arguments: Sequence[str]) -> int:
    """Draws the views unless they are there, asks, prints the table and writes it beside them."""
    cfg = read_arguments(BodyQaConfig, arguments)
    rooms = tuple(name for name in room_names() if name not in TRAIN_ROOMS)
    backend_cfg = None if cfg.backend is None else build(BackendConfig, group_file("backend", cfg.backend), "backend")
    if cfg.weights is not None:
        model, answer = _stored(cfg.weights)
        name, size = Path(cfg.weights).resolve().name, model.image_size
    else:
        assert backend_cfg is not None
        model = ModelConfig("asked")
        name, size = backend_cfg.name, backend_cfg.image_size
        answer = _chatting(make_backend(backend_cfg, None), cfg.body)
    count = -(-cfg.questions // len(_KINDS))
    folder = Path(cfg.out) / f"views-{size}-{count}-{cfg.seed}-{'-'.join(cfg.robots)}"
    sys.stdout.write(f"{cfg.questions} questions on {', '.join(rooms)}\n")
    collect(
        CollectConfig("views", str(folder), count, cfg.robots, rooms, cfg.seed, size, part_size=48, workers=cfg.workers),
        lambda done, parts: None,
    )
    views = Views(folder, replace(model, prompt="terse"))
    found = scores(questions_of(views, cfg.questions, cfg.seed), answer, cfg.blind)
    table = _table(f"BodyQA: {name}, {', '.join(cfg.robots)}, seed {cfg.seed}", found)
    table.show()
    record = {"model": name, "seed": cfg.seed, "robots": list(cfg.robots), "rooms": list(rooms), "body": cfg.body}
    record["scores"] = {
        one.kind: {"asked": one.count, "right": one.right, "commonest": one.commonest, "blind": one.blind} for one in found
    }
    write_text(Path(cfg.out) / f"{name}.json", json.dumps(record, indent=1) + "\n")
    write_text(Path(cfg.out) / f"{name}.md", table.to_markdown())
    return 0
