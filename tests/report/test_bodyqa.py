"""BodyQA: true answers, whoever is asked; a perfect model is right, a blind one gets neither picture nor body."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from configs.schema.collect import CollectConfig
from configs.schema.model import ModelConfig
from data.motion import PELVIS_HEIGHT
from proprio_mllm.backends.protocol import ChatImage, ChatReply, ChatRequest
from proprio_mllm.report import bodyqa
from proprio_mllm.report.bodyqa import _CHOICES, Answering, Question, Score, _chatting, _read, main, questions_of, scores
from proprio_mllm.training.sources import Views
from sim.collection.collect import collect

WEIGHTS = Path(__file__).parents[2] / "weights/tiny"


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> list[Question]:
    folder = tmp_path_factory.mktemp("views")
    collect(CollectConfig("views", str(folder), 6, rooms=("kitchen_3",), image_size=56, part_size=6))
    return questions_of(Views(folder, ModelConfig("m", image_size=56)), 30, 0)


class _Told:
    """A backend that reads its body from words and does not know the rest."""

    identity = "told"

    def __init__(self) -> None:
        self.requests: list[ChatRequest] = []

    def complete(self, request: ChatRequest) -> ChatReply:
        self.requests.append(request)
        text = request.messages[-1].text
        if "pelvis above" in text:
            height = text.partition("Your pelvis is ")[2].partition(" m")[0]
            return ChatReply(f"It is {height} metres.", 1, 1)
        if "hands are open" in text:
            opened = [side for side in ("left", "right") if f"{side} hand is open" in text]
            return ChatReply(" and ".join(opened).capitalize() or "None.", 1, 1)
        return ChatReply("I cannot tell.", 1, 1)

    def close(self) -> None:
        """Holds nothing."""


def test_the_truth_is_the_simulators(asked: list[Question]) -> None:
    assert {one.kind for one in asked} == {"side", "distance", "height", "arm", "reach", "hands", "pelvis"}
    for one in asked:
        if one.kind == "pelvis":
            assert float(one.answer) == pytest.approx(one.row.motion[-1, PELVIS_HEIGHT], abs=0.026)
        elif one.kind in ("side", "arm"):
            (thing,) = (obj for obj in one.row.objects if obj["id"] == one.thing)
            across = thing["center_in_pelvis"][1]
            assert one.answer not in ("left", "right") or (one.answer == "left") == (across > 0)


def test_scores_by_kind_and_of_all(asked: list[Question]) -> None:
    def answer(questions: Sequence[Question], blind: bool) -> list[str]:
        return ["left" if blind else one.answer for one in questions]

    found = scores(asked, answer, blind=True)
    assert [one.kind for one in found] == ["side", "distance", "height", "arm", "reach", "hands", "pelvis", "all"]
    assert all(one.right == one.asked for one in found) and found[-1].asked == len(asked) == sum(o.asked for o in found[:-1])
    assert found[0].blind == sum(one.answer == "left" for one in asked if one.kind == "side")
    assert found[-1].commonest == sum(one.commonest for one in found[:-1]) < len(asked)
    assert scores(asked, answer, blind=False)[0].blind is None


def test_a_backend_is_shown_picture_and_body_or_neither(asked: list[Question]) -> None:
    backend = _Told()
    found = {one.kind: one for one in scores(asked, _chatting(backend, True), blind=True)}
    assert found["pelvis"].right == found["pelvis"].asked and found["hands"].right == found["hands"].asked
    assert found["side"].right == 0 and found["pelvis"].blind == 0
    pictures = [any(isinstance(part, ChatImage) for part in one.messages[-1].content) for one in backend.requests]
    assert pictures == [True] * len(asked) + [False] * len(asked)
    assert not any("Your pelvis is" in one.messages[-1].text for one in backend.requests[len(asked) :])
    untold = _Told()
    scores(asked, _chatting(untold, False), blind=False)
    assert not any("Your pelvis is" in one.messages[-1].text for one in untold.requests)


@pytest.mark.parametrize(
    ("kind", "text", "read"),
    [
        ("side", "To the LEFT.", "left"),
        ("arm", "Either", "either"),
        ("reach", "None of them.", "none"),
        ("hands", "Both hands", "left right"),
        ("hands", "none of them", "none"),
        ("pelvis", "about 0.87 m", "0.85"),
        ("height", "High", "high"),
        ("side", "left or right", "left right"),
        ("distance", "no idea", ""),
    ],
)
def test_replies_are_read(kind: str, text: str, read: str) -> None:
    assert _read(kind, text) == read


def test_the_released_model_is_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[tuple[Question, str]] = []

    def scored(asked: Sequence[Question], answer: Answering, blind: bool) -> list[Score]:
        said.extend(zip(asked, answer(asked, True), strict=True))
        return scores(asked, answer, blind)

    monkeypatch.setattr(bodyqa, "scores", scored)
    assert main([f"weights={WEIGHTS}/full", "questions=60", f"out={tmp_path}", "workers=1"]) == 0
    record = json.loads((tmp_path / "full.json").read_text())["scores"]
    assert record["all"]["asked"] == 60 and record["all"]["right"] > record["all"]["blind"]
    assert "BodyQA: full, h1, x1" in capsys.readouterr().out
    assert all(one.answer in _CHOICES[one.kind] and answer in _CHOICES[one.kind] for one, answer in said)
    assert "kitchen_3" in json.loads((tmp_path / "full.json").read_text())["rooms"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "allowed: one of the two"),
        (["weights=a", "backend=b"], "allowed: one of the two"),
        ([f"weights={WEIGHTS}/words"], "the model has no eyes"),
        (["backend=nobody"], "backend"),
    ],
)
def test_wrong_arguments(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert said in capsys.readouterr().err
