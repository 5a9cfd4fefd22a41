"""Path-length weighting, steps against the expert's, recovery and regret, each in closed form."""

from __future__ import annotations

import json
import math

import pytest

from interface.episode import Outcome
from proprio_mllm.evaluation.run import task_key
from proprio_mllm.report.metrics import Certificate, References, extras_of, first_tries, path_efficiency, recoveries
from proprio_mllm.report.references import read_certificates, references_of
from proprio_mllm.report.runs import write_report
from proprio_mllm.report.stored import load_run
from sim.tasks.task import load_benchmark


@pytest.mark.parametrize(
    ("own", "shortest", "expected"),
    [(4.0, 2.0, 0.5), (2.0, 2.0, 1.0), (1.0, 2.0, 1.0), (0.0, 0.0, 1.0), (0.05, 0.0, 1.0), (1.0, 0.0, 0.1), (0.0, 3.0, 1.0)],
)
def test_path_efficiency(own: float, shortest: float, expected: float) -> None:
    assert path_efficiency(own, shortest) == pytest.approx(expected)


def test_negative_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match=r"-1\.0 and 2\.0 m"):
        path_efficiency(-1.0, 2.0)


def test_success_by_path_length_and_step_optimality(record) -> None:
    certificates = {"a": Certificate(2, 3.0), "b": Certificate(4, 3.0), "c": Certificate(5, 1.0)}
    records = [
        record("a", "single", True, path_length_m=6.0, steps=4),  # 0.5, 0.5
        record("b", "single", True, path_length_m=2.0, steps=4),  # 1, 1
        record("c", "single", False, path_length_m=1.0, steps=5),  # 0, not solved
        record("d", "single", True, path_length_m=1.0, steps=5),  # no certificate
    ]
    extras = extras_of(records, References(certificates))
    assert (extras.certified, extras.spl, extras.step_optimality) == (3, pytest.approx(0.5), pytest.approx(0.75))
    assert 0.0 <= extras.spl_low < 0.5 < extras.spl_high <= 1.0
    assert math.isnan(extras_of(records, References()).spl)
    everyone = extras_of([record("a", "single", True, path_length_m=3.0)], References(certificates))
    assert (everyone.spl, everyone.spl_low, everyone.spl_high) == (1.0, 1.0, 1.0)


def step(*outcomes: tuple[str, bool, str]) -> dict:
    return {"outcomes": [{"action": a, "ok": ok, "code": "", "contingency": draw} for a, ok, draw in outcomes]}


SLIPPED = ("Pick(left, Mug_1)", False, "slipped")
GOT = ("Pick(right, Mug_1)", True, "")
MISSED = ("Place(right, Table_1)", False, "nothing")
TOO_FAR = ("Pick(left, Cup_1)", False, "")
INVALID = ("", False, "")


@pytest.mark.parametrize(
    ("trace", "expected"),
    [
        ([], []),
        ([step(TOO_FAR), step(INVALID)], []),  # failures without a contingency are no events
        ([step(SLIPPED)], [False]),
        ([step(SLIPPED), step(GOT)], [True]),  # the other arm makes it good
        ([step(GOT), step(SLIPPED)], [False]),  # an earlier success does not
        ([step(SLIPPED), step(("Pick(left, Cup_1)", True, "")), step(("Hold(left, Mug_1)", True, ""))], [False]),  # nor another
        ([step(SLIPPED), step(SLIPPED), step(GOT), step(MISSED)], [True, True, False]),
        ([step(SLIPPED, MISSED), step(GOT)], [True, False]),
    ],
)
def test_recoveries(trace, expected) -> None:
    assert recoveries(trace) == expected


def coded(*outcomes: tuple[str, str]) -> dict:
    return {"outcomes": [{"action": a, "ok": not code, "code": code, "contingency": ""} for a, code in outcomes]}


LEFT, RIGHT, WALK = ("Pick(left, Mug_1)", ""), ("Pick(right, Mug_1)", ""), ("MoveAhead(0.5)", "")
FAR, HIGH = ("Pick(left, Mug_1)", "TooFar"), ("Pick(left, Mug_1)", "BodyTooHigh")


@pytest.mark.parametrize(
    ("trace", "expected"),
    [
        ([coded(LEFT)], ["reached"]),
        ([coded(("Pick(left, Mug_1)", "GraspMissed"))], ["reached"]),  # the hand came to it
        ([coded(("Pick(left, Mug_1)", "HandOccupied")), coded(LEFT)], ["reached"]),  # refused before anything was tried
        ([coded(HIGH), coded(LEFT)], ["height"]),  # only the first try counts
        ([coded(FAR), coded(WALK), coded(RIGHT)], ["stance"]),
        ([coded(FAR), coded(RIGHT)], ["arm"]),
        ([coded(FAR), coded(("MoveAhead(1)", "BlockedPath")), coded(RIGHT)], ["arm"]),
        ([coded(FAR), coded(("Pick(right, Mug_1)", "TooFar")), coded(LEFT)], ["stance"]),
        ([coded(("Lift(Box_1)", "BodyTooLow")), coded(("Lift(Box_1)", ""))], ["height"]),
        ([coded(LEFT, ("Open(right, Fridge_1)", "")), coded(("Place(left, Fridge_1)", ""))], ["reached"] * 3),
        ([coded(WALK, ("fly!", "InvalidOutput")), coded(("GoTo(Mug_1)", "")), coded(("Release(left)", ""))], []),
    ],
)
def test_first_tries(trace, expected) -> None:
    assert first_tries(trace) == expected


def test_first_tries_are_shared_out(record) -> None:
    traces = [(coded(LEFT),), (coded(FAR),), (coded(HIGH), coded(LEFT)), (coded(FAR), coded(RIGHT)), (coded(WALK),)]
    extras = extras_of([record(str(n), "single", True, trace=trace) for n, trace in enumerate(traces)], References())
    assert extras.first_tries == 4
    assert extras.first_try_rate == extras.wrong_stance == extras.wrong_height == extras.wrong_arm == pytest.approx(0.25)


def test_recovery_counts_events_and_their_episodes(record) -> None:
    records = [
        record("a", "single", True, trace=(step(SLIPPED), step(GOT), step(MISSED))),
        record("b", "single", False, trace=(step(SLIPPED), step(GOT))),
        record("c", "single", False, trace=(step(SLIPPED),)),
    ]
    extras = extras_of(records, References())
    assert extras.contingencies == 4
    assert extras.recovery == pytest.approx(2 / 4)  # both events of the episode that succeeded
    assert extras.made_good == pytest.approx(2 / 4)


def test_regret(record) -> None:
    records = [record(name, "single", name in "ab", steps=7) for name in "abcd"]
    references = References(
        easy={("a", 0): True, ("b", 0): False, ("c", 0): True, ("d", 0): True, ("d", 1): True},
        expert={("a", 0): 5, ("c", 0): 2},
    )
    extras = extras_of(records, references)
    assert (extras.regret_episodes, extras.regret) == (4, pytest.approx((0 - 1 + 1 + 1) / 4))
    assert (extras.regret_steps_episodes, extras.regret_steps) == (1, 2.0)


@pytest.fixture
def benchmark_records(record):
    """The first four tasks of the benchmark, as if acted out by a planner."""
    tasks = load_benchmark()[:4]

    def make(planner: str, difficulty: str, solved: int, **change):
        own = {"planner": planner, "difficulty": difficulty} | change
        return [
            record(task.id, task.category, i < solved, config_hash=f"c-{task_key(task)}", **own) for i, task in enumerate(tasks)
        ]

    return make


def test_references_are_found_beside_the_run(tmp_path, store, benchmark_records) -> None:
    hard = store(tmp_path / "eval" / "hard", benchmark_records("random", "hard", 1, steps=9))
    alone = references_of(load_run(hard))
    assert (len(alone.certificates), alone.easy, alone.expert) == (4, {}, {})
    store(tmp_path / "eval" / "easy", benchmark_records("random", "easy", 3))
    store(tmp_path / "eval" / "expert", benchmark_records("expert", "hard", 4, steps=3), config_hash="e")
    store(tmp_path / "eval" / "other_seed", benchmark_records("random", "easy", 4), seed=9)
    write_report(load_run(hard))
    row = json.loads((hard / "summary.json").read_text())["rows"][-1]
    assert (row["regret_episodes"], row["regret"]) == (4, 0.5)
    assert (row["regret_steps_episodes"], row["regret_steps"]) == (1, 6.0)
    assert row["certified"] == 4
    assert 0.0 < row["spl"] <= 0.25
    assert row["recovery"] is None


def test_certificates_stand_for_the_same_task_start_and_robot_only(tmp_path, store, benchmark_records, record) -> None:
    made = benchmark_records("random", "easy", 4)
    turned = load_run(store(tmp_path / "turned", made, start="turned"))
    own = load_run(store(tmp_path / "own", made, config={"robot": {"name": "h1", "spec": "own.yaml"}}))
    edited = load_run(store(tmp_path / "edited", [record(made[0].task, "single", True, config_hash="c-edited")]))
    unknown = load_run(store(tmp_path / "unknown", made, robot="r2"))
    assert [references_of(run).certificates for run in (turned, own, edited, unknown)] == [{}, {}, {}, {}]


def test_every_benchmark_task_has_certificates(tmp_path) -> None:
    certificates = read_certificates()
    assert {(task.id, robot) for task in load_benchmark() for robot in ("h1", "x1")} <= set(certificates)
    assert all(one.steps > 0 and one.path_length_m >= 0.0 for one in certificates.values())
    path = tmp_path / "certificates.jsonl"
    path.write_text('{"task": "a", "robot": "h1", "steps": 2}\n')
    with pytest.raises(ValueError, match=r"line 1: .*path_length_m"):
        read_certificates(path)


def test_broken_episodes_are_no_part_of_it(record) -> None:
    from proprio_mllm.report.summary import rows_of

    broken = record("a", "single", False, outcome=Outcome.INFRASTRUCTURE_ERROR, failure=None)
    (*_, everything) = rows_of([broken], references=References({"a": Certificate(1, 1.0)}))
    assert everything.extras.certified == 0
