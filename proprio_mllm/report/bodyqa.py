"""BodyQA: what a model sees and feels of its own body, asked without any planning.

    python -m proprio_mllm bodyqa weights=weights/tiny/full [questions=2000] [robots=[h1,x1]] [blind=true]
    python -m proprio_mllm bodyqa backend=gpt4o

Seven questions on views of rooms that no stage trains on, with both robots posed anywhere in them: on which side of me is a
thing, how far, how high, which arm reaches it better, which arms are long enough, which of my hands are open, how high is my
pelvis. The answers are the simulator's own. Beside the share of right answers (with its Wilson interval) stand that of the
commonest answer and, with `blind`, that of the same model with a grey picture and a body of zeros.

A stored model reads motion tokens, is asked its own short questions, and chooses token by token among the answers that there
are: what it knows is measured, not whether it keeps to a form. A model behind a backend is asked in English, with the
picture and, unless `body=false`, its body in words (`proprio_mllm.planners.chat.view.body_text`); blind it gets neither.

Paper: none; it says that proprioception helps, this asks what the model knows of it.
"""

from __future__ import annotations

import contextlib
import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from tqdm import tqdm

from configs.arguments import command, read_arguments
from configs.compose import group_file
from configs.schema.backend import BackendConfig
from configs.schema.collect import TRAIN_ROOMS, CollectConfig
from configs.schema.model import ModelConfig
from configs.validate import ConfigError, build
from data.files import write_text
from data.motion import FPS
from interface.bodies import PAPER_ROBOTS
from interface.observation import Proprioception
from proprio_mllm.backends.factory import make_backend
from proprio_mllm.backends.protocol import Backend, ChatMessage, ChatRequest
from proprio_mllm.evaluation.showing import grey
from proprio_mllm.model.batch import Example
from proprio_mllm.model.building import load_model, load_motion
from proprio_mllm.model.prompts import body_state_prompt, looking
from proprio_mllm.model.questions import ask, spoken
from proprio_mllm.planners.chat.view import body_text, encoded
from proprio_mllm.planners.protocol import check_weights
from proprio_mllm.report.statistics import wilson
from proprio_mllm.report.table import Table
from proprio_mllm.training.alignment import body_state
from proprio_mllm.training.asking import replies
from proprio_mllm.training.sources import ViewRow, Views
from sim.collection.collect import collect
from sim.scene.rooms import room_names

_ABOUT_THINGS: Final = ("side", "distance", "height", "arm", "reach")
_ABOUT_SELF: Final = ("hands", "pelvis")
_KINDS: Final = (*_ABOUT_THINGS, *_ABOUT_SELF)
#: What may be answered; heights of the pelvis are metres.
_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "side": ("left", "ahead", "right"),
    "distance": ("near", "middle", "far"),
    "height": ("low", "level", "high"),
    "arm": ("left", "right", "either"),
    "reach": ("left", "right", "both", "none"),
    "hands": ("left right", "left", "right", "none"),
    "pelvis": tuple(f"{0.05 * step:.2f}" for step in range(4, 26)),
}
_METRES: Final = "Answer with the metres alone, rounded to 0.05, such as 0.85."


@dataclass(frozen=True)
class BodyQaConfig:
    """What is asked of whom.

    Attributes:
        weights: folder of a stored model.
        backend: a model in `configs/backend`; in place of weights.
        questions: how many, shared out among seven kinds.
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
        kind: one of side, distance, height, arm, reach, hands, pelvis.
        thing: the object it is about, empty for questions about oneself.
        answer: the truth, in the words that stored models learn.
        row: the view.
    """

    kind: str
    thing: str
    answer: str
    row: ViewRow


#: Answers questions, seeing or blind.
Answering = Callable[[Sequence[Question], bool], Sequence[str]]


@dataclass(frozen=True, slots=True)
class Score:
    """Right answers to one kind of question.

    Attributes:
        kind: the kind, or `all`.
        asked: questions.
        right: right answers.
        commonest: how often the commonest right answer is right.
        blind: right answers without picture and body, None where that was not asked.
    """

    kind: str
    asked: int
    right: int
    commonest: int
    blind: int | None


def questions_of(views: Views, count: int, seed: int) -> list[Question]:
    """Up to `count` questions, kinds in turn, one of a kind about a view.

    Args:
        views: every row is asked about.
        count: how many.
        seed: of the choice of things.
    """
    rng, found = np.random.default_rng(seed), list[Question]()
    for index in range(len(views.reader)):
        row = views.row(index)
        for kind in _ABOUT_THINGS:
            for one in views.asked(row, (kind,), 1, rng):
                found.append(Question(kind, str(one.thing["id"]), one.answer, row))
        hands, height = body_state(row.motion)
        found += [Question("hands", "", hands, row), Question("pelvis", "", height, row)]
    share = {kind: [one for one in found if one.kind == kind] for kind in _KINDS}
    each, over = divmod(count, len(_KINDS))
    return [one for place, kind in enumerate(_KINDS) for one in share[kind][: each + (place < over)]]


def scores(asked: Sequence[Question], answer: Answering, blind: bool) -> list[Score]:
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


def _stored(folder: str) -> tuple[ModelConfig, Answering]:
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
            hands = "" if one.kind == "hands" else body_state(motion)[0]
            return Example(body_state_prompt([] if codes is None else codes, hands, "", style))
        view = one.row.view
        if blind:
            assert view.key_bodies is not None
            view = replace(view, image=grey(view.image), key_bodies=np.zeros_like(view.key_bodies))
        return Example(looking([(ask(one.kind, spoken(one.thing, style), style), "")], codes, style), (view,))

    def answer(asked: Sequence[Question], blind: bool) -> list[str]:
        size, said = 64, list[str]()
        for start in tqdm(range(0, len(asked), size), desc="blind" if blind else "seeing", unit="batch"):
            part = asked[start : start + size]
            said += replies(model, [example(one, blind) for one in part], 10, [_CHOICES[one.kind] for one in part])
        return said

    return model.cfg, answer


def _chatting(backend: Backend, body: bool) -> Answering:
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
    return Proprioception(row.motion, FPS, np.zeros(0), np.asarray(row.view.key_bodies, dtype=np.float64))


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
        low, high = wilson(one.right, one.asked)
        cells = [
            f"{100 * one.right / one.asked:.1f} [{100 * low:.1f}, {100 * high:.1f}]",
            f"{100 * one.commonest / one.asked:.1f}",
        ]
        cells.append("" if one.blind is None else f"{100 * one.blind / one.asked:.1f}")
        rows.append((one.kind, str(one.asked), *cells))
    return Table(title, ("question", "asked", "right %, 95 % interval", "commonest answer %", "blind %"), tuple(rows))


def _run(cfg: BodyQaConfig, name: str, size: int, model: ModelConfig, answer: Answering) -> None:
    """Asks on views of a size, which are drawn unless they are there; prints the table and writes it."""
    rooms = tuple(room for room in room_names() if room not in TRAIN_ROOMS)
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
    record = {
        "model": name, "seed": cfg.seed, "robots": cfg.robots, "rooms": rooms, "body": cfg.body,
        "scores": {one.kind: asdict(one) for one in found},
    }  # fmt: skip
    write_text(Path(cfg.out) / f"{name}.json", json.dumps(record, indent=1) + "\n")
    write_text(Path(cfg.out) / f"{name}.md", table.to_markdown())


@command()
def main(arguments: Sequence[str]) -> int:
    """Asks a stored model, or one behind a backend."""
    cfg = read_arguments(BodyQaConfig, arguments)
    if cfg.backend is None:
        assert cfg.weights is not None
        model, answer = _stored(cfg.weights)
        _run(cfg, Path(cfg.weights).resolve().name, model.image_size, model, answer)
        return 0
    backend = build(BackendConfig, group_file("backend", cfg.backend), "backend")
    with contextlib.closing(make_backend(backend, None)) as asked:
        _run(cfg, backend.name, backend.image_size, ModelConfig("asked"), _chatting(asked, cfg.body))
    return 0
