"""The episode loop: ends, budgets, invalid replies, and errors that are no scores."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from interface.episode import Outcome
from interface.failures import FailureCategory
from proprio_mllm.evaluation.episode import GoalReport, Limits, Stats, run_episode
from proprio_mllm.evaluation.ledger import Ledger, read_ledger
from proprio_mllm.planners.protocol import Usage

SOLVED = ("GoTo(Mug_1)", "MoveDown(0.2)", "Pick(left, Mug_1)")


def play(session, planner, fields, budget=6, **kwargs):
    return run_episode(lambda: session, planner, fields, "pick up the mug", Limits(budget, budget), 5, **kwargs)


def test_success_ends_the_episode_and_is_counted(session, scripted, fields) -> None:
    planner = scripted(*SOLVED, "MoveAhead()")
    record = play(session(), planner, fields)
    assert record.outcome is Outcome.SUCCESS
    assert record.failure is None
    assert (record.steps, record.planner_calls, record.planner_tokens, record.invalid_output) == (3, 3, 30, 0)
    assert (record.path_length_m, record.makespan_s, record.arm_utilisation) == (3.0, 4.5, 0.25)
    assert record.goal_conditions_met == 1.0
    assert not record.budget_exhausted
    assert [step["step"] for step in record.trace] == list(SOLVED)


def test_half_of_the_goals_is_no_success(session, scripted, fields, monkeypatch) -> None:
    half = session()
    monkeypatch.setattr(half, "goals", lambda: GoalReport((True, half.held), frozenset({"Mug_1"})))
    record = play(half, scripted("GoTo(Mug_1)"), fields)
    assert record.outcome is Outcome.FAILURE and record.failure is not None and not record.in_time
    assert record.goal_conditions_met == 0.5


def test_the_runner_owns_history_step_and_budget(session, scripted, fields) -> None:
    planner = scripted("GoTo(Mug_1)", "gibberish", "Pick(left, Mug_1)", "MoveDown(0.2)")
    play(session(), planner, fields, budget=5)
    assert [o.step for o in planner.seen] == [0, 1, 2, 3, 4]
    assert {o.time_limit for o in planner.seen} == {5}
    assert [item.feedback for item in planner.seen[4].history] == [
        "GoTo(Mug_1) ok",
        "gibberish InvalidOutput",
        "Pick(left, Mug_1) BodyTooHigh",
        "MoveDown(0.2) ok",
    ]
    assert planner.heard[0] is None
    assert planner.heard[2] is None  # after the invalid reply
    assert planner.heard[3] is not None


def test_margins_stay_in_the_trace(session, scripted, fields) -> None:
    planner = scripted("Pick(left, Mug_1)")
    record = play(session(), planner, fields)
    assert record.trace[0]["outcomes"][0]["margins"] == {"reach_m": 0.4}
    assert "0.4" not in " ".join(item.feedback for item in planner.seen[1].history)


def test_budget_and_category(session, scripted, fields) -> None:
    record = play(session(), scripted(*["Pick(left, Mug_1)"] * 9), fields, budget=4)
    assert record.outcome is Outcome.FAILURE
    assert record.failure is FailureCategory.NAVIGATION
    assert record.budget_exhausted
    assert record.steps == 4


def test_a_success_after_the_time_limit_is_late(session, scripted, fields) -> None:
    late = (*["RotateLeft(5)"] * 2, *SOLVED)
    found = [run_episode(session, scripted(*late), fields, "x", Limits(time), 5) for time in (4, 5)]
    assert [(one.outcome, one.in_time, one.steps) for one in found] == [(Outcome.SUCCESS, False, 5), (Outcome.SUCCESS, True, 5)]
    planner = scripted(*late)
    run_episode(session, planner, fields, "x", Limits(4), 5)
    assert {(seen.time_limit, seen.step_limit) for seen in planner.seen} == {(4, 50)}


def test_what_only_repeats_itself_is_ended_as_stuck(session, scripted, fields) -> None:
    def ended(*steps: str, unlucky: int = 0):
        return run_episode(lambda: session(unlucky=unlucky), scripted(*steps), fields, "x", Limits(6, 50, 8), 5)

    refused = ended(*["Pick(left, Mug_1)"] * 60)
    assert (refused.outcome, refused.stuck, refused.budget_exhausted, refused.steps) == (Outcome.FAILURE, True, False, 8)
    assert refused.failure is FailureCategory.NAVIGATION
    turns = ended(*["RotateLeft(45)", "RotateRight(45)"] * 30)
    assert (turns.stuck, turns.steps) == (True, 8)
    assert ended(*["gibberish"] * 60).steps == 8
    varied = ended(*["RotateLeft(45)", "RotateRight(45)", "RotateLeft(5)"] * 20)
    assert (varied.stuck, varied.budget_exhausted, varied.steps) == (False, True, 50)
    # who moves, or meets contingencies that may change, is not stuck
    walks = run_episode(lambda: session(drift=0.1), scripted(*["MoveAhead(0.1)"] * 60), fields, "x", Limits(6, 50, 8), 5)
    assert walks.budget_exhausted
    unlucky = ended("GoTo(Mug_1)", "MoveDown(0.2)", *["Pick(left, Mug_1)"] * 60, unlucky=20)
    assert unlucky.outcome is Outcome.SUCCESS


def test_steps_that_chance_spoils_are_not_charged(session, scripted, fields) -> None:
    plan = (*SOLVED[:2], *["Pick(left, Mug_1)"] * 9)
    planner = scripted(*plan)
    record = play(session(unlucky=4), planner, fields, budget=3)
    assert record.outcome is Outcome.SUCCESS
    assert (record.steps, record.planner_calls) == (7, 7)
    assert [o.step for o in planner.seen] == [0, 1, 2, 2, 2, 2, 2]
    assert [step["outcomes"][0]["contingency"] for step in record.trace][2:6] == ["slipped"] * 4
    assert all(outcome.contingency == "" for heard in planner.heard if heard is not None for outcome in heard.outcomes)
    assert play(session(unlucky=4), scripted("gibberish", *plan), fields, budget=3).budget_exhausted


def test_done_too_early_is_logical_and_not_exhausted(session, scripted, fields) -> None:
    record = play(session(), scripted("GoTo(Mug_1)"), fields)
    assert record.failure is FailureCategory.LOGICAL
    assert not record.budget_exhausted


@pytest.mark.parametrize(
    "text", ["", "Fly(Mug_1)", "Pick(Mug_1)", "\x00\x00", "Pick(left, Mug_1) & GoTo(Mug_1)", "MoveDown(nan)"]
)
def test_invalid_replies_never_crash(session, scripted, fields, text) -> None:
    record = play(session(), scripted(*[text] * 9), fields, budget=3)
    assert record.outcome is Outcome.FAILURE
    assert record.failure is FailureCategory.LOGICAL
    assert (record.invalid_output, record.steps) == (3, 3)


def test_the_trace_of_an_invalid_reply_says_what_it_was(session, scripted, fields) -> None:
    record = play(session(), scripted("Fly(Mug_1)" + "!" * 1000), fields)
    trace: Any = record.trace
    (outcome,) = trace[0]["outcomes"]
    assert (outcome["action"], outcome["ok"], outcome["code"], outcome["category"]) == ("", False, "InvalidOutput", "logical")
    assert outcome["message"] and len(outcome["message"]) <= 200
    assert (trace[0]["step"], trace[0]["duration_s"]) == ("Fly(Mug_1)" + "!" * 390, 0.0)


def test_measured_numbers_are_rounded(session, scripted, fields, monkeypatch) -> None:
    one, third = session(), 1.0 / 3.0
    act = one.step

    def step(asked):
        observation, feedback = act(asked)
        outcomes = tuple(dataclasses.replace(outcome, margins={"reach_m": third}) for outcome in feedback.outcomes)
        return observation, dataclasses.replace(feedback, outcomes=outcomes, duration_s=third)

    monkeypatch.setattr(one, "step", step)
    monkeypatch.setattr(one, "stats", lambda: Stats(third, third, third))
    planner = scripted("MoveAhead()")
    said = planner.step
    planner.step = lambda *seen: dataclasses.replace(said(*seen), latency_s=third / 2, usage=Usage(1, usd=third / 2))
    record = play(one, planner, fields)
    trace: Any = record.trace
    assert trace[0]["duration_s"] == 0.333 and trace[0]["outcomes"][0]["margins"] == {"reach_m": 0.3333}
    assert (record.path_length_m, record.makespan_s, record.arm_utilisation) == (0.333, 0.333, 0.3333)
    assert (record.planner_s, record.planner_usd) == (0.3333, 0.33333333)


def test_errors_are_recorded_not_scored(session, scripted, fields) -> None:
    record = play(session(broken=2), scripted(*SOLVED), fields)
    assert record.outcome is Outcome.INFRASTRUCTURE_ERROR
    assert record.failure is None
    assert "the physics exploded" in record.message
    assert record.steps == 1


@pytest.mark.parametrize(
    ("seconds", "outcome"), [(np.float32(0.5), Outcome.SUCCESS), (float("nan"), Outcome.INFRASTRUCTURE_ERROR)]
)
def test_a_planner_may_count_in_numpy_but_not_in_nan(session, scripted, fields, tmp_path, seconds, outcome) -> None:
    planner = scripted(*SOLVED)
    said = planner.step
    planner.step = lambda *seen: dataclasses.replace(said(*seen), tokens=np.int64(7), latency_s=seconds)
    record = play(session(), planner, fields)
    assert record.outcome is outcome
    with Ledger(tmp_path / "ledger.jsonl") as ledger:
        ledger.append(record)
    if outcome is Outcome.SUCCESS:
        assert (record.planner_tokens, record.planner_s) == (21, 1.5)
    else:
        assert "latency_s is nan" in record.message


@pytest.mark.parametrize(
    ("usage", "message"),
    [
        (Usage(np.int64(1), np.int64(1), np.int8(0), np.float32(0.5), ("a", "b")), ""),
        (Usage(1, usd=None, models=("half \ud83d",)), ""),
        (Usage(1.5), "'float' object cannot be interpreted as an integer"),
        (Usage(-1), "the reply's calls are below 0"),
        (Usage(1, cached=2**63), "the reply's cached are below 0 or above 2**63"),
        (Usage(1, cached=2**63 - 1), ""),
        (Usage(1, usd=float("inf")), "the reply's usage.usd is inf"),
        (Usage(1, models=(3,)), r"usage.models are (3,); allowed: names"),
        (None, "'NoneType' object has no attribute"),
    ],
)
def test_what_a_planner_says_it_cost_never_spoils_the_ledger(session, scripted, fields, tmp_path, usage, message) -> None:
    planner = scripted(*SOLVED)
    said = planner.step
    planner.step = lambda *seen: dataclasses.replace(said(*seen), usage=usage)
    record = play(session(), planner, fields)
    assert record.outcome is (Outcome.INFRASTRUCTURE_ERROR if message else Outcome.SUCCESS)
    assert message in record.message
    path = tmp_path / "ledger.jsonl"
    with Ledger(path) as ledger:
        ledger.append(record)
    (again,) = read_ledger(path)
    assert (again.planner_calls, again.planner_usd, again.cached_calls) == (
        record.planner_calls, record.planner_usd, record.cached_calls
    )  # fmt: skip


def test_a_step_that_forgets_to_answer_is_named(session, scripted, fields) -> None:
    planner = scripted(*SOLVED)
    planner.step = lambda *seen: None
    record = play(session(), planner, fields)
    assert record.outcome is Outcome.INFRASTRUCTURE_ERROR
    assert "the planner's step() gave NoneType; allowed: PlannerReply" in record.message


def test_an_error_while_opening_is_recorded_too(scripted, fields) -> None:
    def broken():
        raise OSError("no display")

    record = run_episode(broken, scripted(), fields, "x", Limits(3), 0)
    assert record.outcome is Outcome.INFRASTRUCTURE_ERROR
    assert "no display" in record.message


def test_watcher_sees_every_observation_and_the_end(session, scripted, fields) -> None:
    seen = []
    play(session(), scripted(*SOLVED), fields, watch=lambda o, reply, feedback: seen.append((o.step, reply, feedback)))
    assert [step for step, _, _ in seen] == [0, 1, 2, 3]
    assert seen[0][1] is None
    assert seen[3][1].text == SOLVED[2]
