"""The ledger: round trip, cut lines, unknown versions, what counts as done."""

from __future__ import annotations

import dataclasses
import json

import pytest

from interface.episode import Outcome
from interface.failures import FailureCategory
from proprio_mllm.evaluation.episode import Limits, run_episode
from proprio_mllm.evaluation.ledger import Ledger, LedgerError, from_json, key_of, read_ledger, scored, to_json
from proprio_mllm.evaluation.seeds import episode_seed, stream


@pytest.fixture
def record(session, scripted, fields):
    return run_episode(session, scripted("Pick(left, Mug_1)", "ünlesbar"), fields, "pick up the mug", Limits(4, 4), 1)


def test_round_trip(tmp_path, record) -> None:
    path = tmp_path / "not" / "yet" / "there" / "ledger.jsonl"
    with Ledger(path) as ledger:
        ledger.append(record)
    (again,) = read_ledger(path)
    assert again == record and again.failure is FailureCategory.LOGICAL  # a step too far, then a reply that is none


LACKING = {1: ("in_time", "stuck", "cached_calls", "reflections", "planner_usd", "models"), 2: ("in_time", "stuck"), 3: ()}


@pytest.mark.parametrize("version", LACKING)
def test_lines_of_earlier_versions_are_read(record, version) -> None:
    now = to_json(record)
    line = {name: value for name, value in now.items() if name not in LACKING[version]} | {"version": version}
    assert from_json(line) == from_json(now)
    with pytest.raises(LedgerError, match=r"missing fields \[\], unknown fields \['mood'\]"):
        from_json(line | {"mood": 1})
    with pytest.raises(LedgerError, match=r"missing fields \['steps'\]"):
        from_json({name: value for name, value in line.items() if name != "steps"})


def test_half_a_character_is_a_question_mark(tmp_path, record) -> None:
    path = tmp_path / "ledger.jsonl"
    with Ledger(path) as ledger:
        ledger.append(dataclasses.replace(record, message="no file \udcff.png"))
    assert [again.message for again in read_ledger(path)] == ["no file ?.png"]


def test_no_file_is_no_record(tmp_path) -> None:
    assert read_ledger(tmp_path / "none.jsonl") == []


def test_a_cut_line_is_dropped_and_overwritten(tmp_path, record) -> None:
    path = tmp_path / "ledger.jsonl"
    with Ledger(path) as ledger:
        ledger.append(record)
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:37])
    assert read_ledger(path) == [record]
    with Ledger(path) as ledger:
        ledger.append(record)
    assert path.read_bytes() == whole * 2


def test_two_writers_are_one_too_many(tmp_path, record) -> None:
    path = tmp_path / "ledger.jsonl"
    with Ledger(path) as ledger:
        ledger.append(record)
        with pytest.raises(LedgerError, match=r"ledger\.jsonl is being written by another process"):
            Ledger(path)
    Ledger(path).close()
    assert read_ledger(path) == [record]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 9}, "version 9"),
        ({"steps2": 1}, "steps2"),
        ({"outcome": "won"}, "won"),
        ({"planner_tokens": None}, "planner_tokens: expected int, got None"),
        ({"steps": "7"}, "steps: expected int, got '7'"),
        ({"planner_s": float("nan")}, "NaN is no JSON number"),
        ({"goal_conditions_met": 5.0}, r"goal_conditions_met 5\.0 outside"),
        ({"steps": -1}, "steps -1 is below 0"),
        ({"outcome": "success", "failure": "logical"}, "outcome 'success' with failure"),
        ({"outcome": "failure", "failure": None}, "outcome 'failure' with failure None"),
        ({"trace": ["Done()"]}, r"trace\[0\]: expected a mapping, got 'Done\(\)'"),
    ],
)
def test_refuses_what_it_does_not_know(tmp_path, record, change, message) -> None:
    path = tmp_path / "ledger.jsonl"
    with Ledger(path) as ledger:
        ledger.append(record)
    path.write_text(json.dumps(json.loads(path.read_text()) | change) + "\n")
    with pytest.raises(LedgerError, match=f"line 1.*{message}"):
        read_ledger(path)


def test_first_score_counts_and_errors_never_do(record) -> None:
    broken = dataclasses.replace(record, outcome=Outcome.INFRASTRUCTURE_ERROR, failure=None)
    other = dataclasses.replace(record, steps=99)
    assert scored([broken]) == {}
    assert scored([broken, record, other]) == {key_of(record): record}


def test_seeds_are_stable_and_differ() -> None:
    assert episode_seed(0, "a", "h1", 0) == 976892428  # ledgers of earlier versions stay valid
    keys = [(s, t, r, k) for s in (0, 1) for t in "ab" for r in ("h1", "x1") for k in (0, 1)]
    assert len({episode_seed(*key) for key in keys}) == len(keys)
    assert stream(3, "planner").integers(2**31) == stream(3, "planner").integers(2**31)
    assert stream(3, "planner").integers(2**31) != stream(3, "start").integers(2**31)
