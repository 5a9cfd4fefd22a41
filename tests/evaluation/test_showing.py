"""What is hidden from a planner is hidden from it alone: world and ledger stay what they are."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.schema.planner import BuiltInPlanner
from configs.schema.robot import RobotConfig
from configs.validate import ConfigError, build
from interface.observation import HistoryItem
from interface.sightings import Shown
from interface.symbolic import events_of
from proprio_mllm.evaluation.episode import Limits, run_episode
from proprio_mllm.evaluation.naming import options_of
from proprio_mllm.evaluation.run import config_hash
from proprio_mllm.evaluation.showing import Showing
from proprio_mllm.model.building import load_model
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import log_words
from proprio_mllm.planners.scripted.planner import ScriptedPlanner

STEPS = ("Pick(left, Mug_1)", "gibberish", "MoveDown(0.2)", "Pick(left, Mug_1)")


def play(session, planner, fields, showing: Showing) -> Any:
    return run_episode(lambda: session, planner, fields, "pick up the mug", Limits(6, 6), 5, showing=showing)


@pytest.mark.parametrize("blind", ["none", "image", "motion", "both"])
def test_pictures_and_bodies_are_hidden(session, scripted, fields, blind) -> None:
    planner, everything = scripted(*STEPS), scripted(*STEPS)
    record = play(session(), planner, fields, Showing(blind))
    whole = play(session(), everything, fields, Showing())
    assert [step["outcomes"] for step in record.trace] == [step["outcomes"] for step in whole.trace]
    for seen, full in zip(planner.seen, everything.seen, strict=True):
        hidden = blind in ("image", "both"), blind in ("motion", "both")
        assert (
            (np.ptp(seen.image) == 0 and seen.image.shape == full.image.shape)
            if hidden[0]
            else (seen.image == full.image).all()
        )
        body, own = seen.proprioception, full.proprioception
        for name in ("motion", "joint_positions", "key_bodies_in_pelvis"):
            felt, real = getattr(body, name), getattr(own, name)
            assert felt.shape == real.shape and not felt.any() if hidden[1] else np.array_equal(felt, real)
        assert (seen.visible_objects, seen.history, seen.instruction) == (full.visible_objects, full.history, full.instruction)


def test_failures_are_told_as_one_bit_and_kept_with_their_codes(session, scripted, fields) -> None:
    planner = scripted(*STEPS)
    record = play(session(), planner, fields, Showing(feedback="bit"))
    assert [item.feedback for item in planner.seen[3].history] == [
        "Pick(left, Mug_1) Failed",
        "gibberish Failed",
        "MoveDown(0.2) ok",
    ]
    assert planner.heard[1].to_text() == "Pick(left, Mug_1) Failed"
    assert planner.heard[1].outcomes[0].category is None and not planner.heard[1].outcomes[0].message
    assert planner.heard[3].to_text() == "MoveDown(0.2) ok"
    assert [step["outcomes"][0]["code"] for step in record.trace][:3] == ["TooFar", "InvalidOutput", ""]


def test_planners_that_read_logs_read_the_bit() -> None:
    history = (HistoryItem("GoTo(Mug_1)", "GoTo(Mug_1) ok"), HistoryItem("Pick(left, Mug_1)", "Pick(left, Mug_1) Failed"))
    assert [event.code for events in events_of(history) for event in events] == ["ok", "Failed"]
    words = log_words(history[1:], ())
    assert words == ("did", "Pick", "left", "mug", "_1", "fail")
    released = tokens_of(load_model(Path(__file__).parents[2] / "weights/tiny/words").processor.tokenizer)
    assert released.tokens(words)[-1:] == released.tokens(["fail"]) != released.tokens(["blurb"])
    planner, shown = ScriptedPlanner(), Shown("pick up the mug", "h1", ("Mug_1",), ("Mug_1", "CounterTop_1"), ())
    planner.decide(shown)
    for number in (1, 2):
        step, _ = planner.decide(Shown(shown.instruction, "h1", ("Mug_1",), shown.known_objects, history[:number]))
    assert step.actions[0].name == "GoTo", "another stance: what does not say why may be anything"


def test_what_is_hidden_is_in_a_runs_name() -> None:
    def run(*values: str) -> EvalConfig:
        return build(EvalConfig, compose("eval", ["planner=proprio", *values]))

    plain, blind, bit = run(), run("planner.blind=both"), run("feedback=bit")
    assert len({config_hash(cfg, "") for cfg in (plain, blind, bit)}) == 3
    assert [options_of(dataclasses.asdict(cfg)) for cfg in (plain, blind, bit)] == [[], ["blind_both"], ["bit"]]


def test_planners_without_eyes_are_not_blinded() -> None:
    with pytest.raises(ConfigError, match=r"planner\.blind: unknown key with kind 'scripted'"):
        build(EvalConfig, compose("eval", ["planner=scripted", "planner.blind=both"]))
    with pytest.raises(ConfigError, match="feedback"):
        build(EvalConfig, compose("eval", ["planner=scripted", "feedback=none"]))
    assert EvalConfig(BuiltInPlanner("s", "scripted", "S"), RobotConfig("h1"), feedback="bit").feedback == "bit"
