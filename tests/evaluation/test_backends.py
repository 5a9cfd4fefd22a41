"""Chat planners in the harness: threads, a cost cap that stops a run and its continuation, broken and dead backends."""

from __future__ import annotations

import dataclasses
import json
import threading
from pathlib import Path

import pytest

from configs.schema.backend import BackendConfig
from configs.schema.eval import EvalConfig
from configs.schema.planner import FilePlanner, PlainPlanner
from configs.schema.robot import RobotConfig
from data.code_files import CodeFileError
from interface.episode import EpisodeRecord, Outcome
from proprio_mllm.backends.protocol import BackendSetupError, ChatReply, ChatRequest
from proprio_mllm.backends.server import ChatServer
from proprio_mllm.evaluation.run import _ready, config_hash, evaluate, run_folder
from sim.tasks.task import write_tasks

#: Answers by the request alone, a little later for some, so that threads overtake each other.
SCRIPT = """
import hashlib, json, time
from proprio_mllm.backends.protocol import BackendError, BackendSetupError, ChatReply, CostCapError, UnreachableError

calls = []

def answer(request):
    text = request.messages[-1].text
    number = int(hashlib.sha256(request.messages[-1].content[-1].data + text.encode()).hexdigest(), 16)
    calls.append(number)
    time.sleep(number % 5 / 100)
    step = ("GoTo(Mug_1)", "MoveDown(0.2)", "Pick(left, Mug_1)", "walk")[number % 4]
    return ChatReply(json.dumps({"cause": "", "change": "", "steps": [step]}), 100, 10, model="script-1", cost_usd=0.25)

def brief(request):
    reply = answer(request)
    return ChatReply(json.dumps({"step": json.loads(reply.text)["steps"][0]}), 50, 5, model="script-2", cost_usd=0.5)

def dear(request):
    if len(calls) >= 6:
        raise CostCapError("spent 1.50 of 1.50 USD")
    return answer(request)

def keyless(request):
    raise BackendSetupError("script: the key is wrong")

def nowhere(request):
    raise UnreachableError("script: no connection")

def away(request):
    if len(calls) >= 3:
        raise UnreachableError("script: no connection")
    return answer(request)

def gone(request):
    if len(calls) == 3:
        calls.append(0)
        raise UnreachableError("script: no connection")
    return answer(request)

def flaky(request):
    calls.append(0)
    if len(calls) % 31 == 3:
        raise BackendError("script: timed out")
    return answer(request)
"""


def plain(records: tuple[EpisodeRecord, ...]) -> list[EpisodeRecord]:
    return [dataclasses.replace(record, planner_s=0.0, wall_s=0.0) for record in records]


@pytest.fixture
def cfg(tmp_path: Path, task) -> EvalConfig:
    (tmp_path / "script.py").write_text(SCRIPT)
    write_tasks([task(f"t{i}", "single", budget=4 + i % 3) for i in range(9)], tmp_path / "tasks.jsonl")
    backend = BackendConfig("scripted", "script", source=f"{tmp_path / 'script.py'}:answer", cache=None)
    return EvalConfig(
        PlainPlanner("gpt4o", "plain", "GPT-4o"),
        RobotConfig("h1"),
        workers=0,
        steps="task",
        tasks=str(tmp_path / "tasks.jsonl"),
        output=str(tmp_path / "out"),
        backend=backend,
    )


def run(cfg: EvalConfig, session, **change):
    return evaluate(dataclasses.replace(cfg, **change), lambda setup, job, planner: session())


def script(cfg: EvalConfig, name: str) -> BackendConfig:
    assert cfg.backend is not None
    assert cfg.backend.source is not None
    return dataclasses.replace(cfg.backend, source=cfg.backend.source.replace(":answer", f":{name}"))


def test_one_and_eight_threads_write_equal_ledgers(cfg, session, tmp_path) -> None:
    one = run(cfg, session)
    eight = run(cfg, session, threads=8, output=str(tmp_path / "eight"))
    assert plain(one.records) == plain(eight.records)
    assert len(one.records) == 9
    assert {record.models for record in one.records} == {("script-1",)}
    assert all(record.planner_usd == 0.25 * record.planner_calls for record in one.records)
    assert any(record.reflections for record in one.records)
    assert one.folder.name == eight.folder.name


def test_processes_agree_with_threads(cfg, session, tmp_path) -> None:
    assert cfg.backend is not None
    backend = dataclasses.replace(cfg.backend, cache=str(tmp_path / "replies.sqlite"))
    first = run(cfg, session, threads=3, backend=backend)
    again = run(cfg, session, threads=2, backend=backend, output=str(tmp_path / "again"))
    assert [record.cached_calls for record in again.records] == [record.planner_calls for record in again.records]
    uncached = [dataclasses.replace(record, cached_calls=0) for record in plain(again.records)]
    assert uncached == [dataclasses.replace(record, cached_calls=0) for record in plain(first.records)]


@pytest.mark.parametrize("threads", [1, 4])
def test_a_cap_stops_the_run_which_then_goes_on(cfg, session, threads: int) -> None:
    stopped = run(cfg, session, backend=script(cfg, "dear"), threads=threads)
    assert stopped.stopped == "spent 1.50 of 1.50 USD"
    assert len(stopped.records) < 9
    assert not stopped.broken
    ledger = (stopped.folder / "ledger.jsonl").read_text().splitlines()
    assert len(ledger) == len(stopped.records)
    whole = run(cfg, session, threads=threads)
    assert not whole.stopped
    assert len(whole.records) == 9


def test_a_backend_that_no_repetition_mends_stops_the_run(cfg, session) -> None:
    stopped = run(cfg, session, backend=script(cfg, "keyless"), threads=4)
    assert stopped.stopped == "script: the key is wrong"
    assert not stopped.records
    assert not stopped.broken


def test_a_server_that_was_never_reached_stops_the_run_and_one_that_goes_away_does_not(cfg, session) -> None:
    stopped = run(cfg, session, backend=script(cfg, "nowhere"), threads=4)
    assert stopped.stopped == "script: no connection"
    assert not stopped.records
    assert not stopped.broken
    whole = run(cfg, session, backend=script(cfg, "gone"))
    assert not whole.stopped
    assert (len(whole.records), len(whole.broken)) == (9, 1)


def test_an_outage_is_never_a_score(cfg, session) -> None:
    result = run(cfg, session, backend=script(cfg, "flaky"), retries=8)
    assert result.broken
    assert all(record.outcome is Outcome.INFRASTRUCTURE_ERROR for record in result.broken)
    assert all("timed out" in record.message for record in result.broken)
    assert len(result.records) == 9
    assert {record.outcome for record in result.records} <= {Outcome.SUCCESS, Outcome.FAILURE}


def test_a_backend_that_cannot_be_made_stops_before_anything_is_written(cfg, session, tmp_path) -> None:
    assert cfg.backend is not None
    wrong = dataclasses.replace(cfg.backend, source=f"{tmp_path / 'script.py'}:nothing")
    with pytest.raises(BackendSetupError, match="has no function 'nothing'; it has: answer, away, brief, dear"):
        run(cfg, session, backend=wrong)
    assert not (tmp_path / "out").exists()


def test_what_was_run_and_what_it_cost_is_in_the_metadata(cfg, session) -> None:
    result = run(cfg, session, threads=2)
    stored = json.loads((result.folder / "run.json").read_text())
    assert stored["backend"]["name"] == "script"
    assert stored["reflection"] == "on"
    assert run(cfg, session, backend=script(cfg, "flaky")).folder != result.folder
    assert result.folder.name.startswith("gpt4o-script-h1-easy-steps_task-tasks-")
    told = dataclasses.replace(cfg.planner, body=True, horizon=2, reflection="off")
    assert "-easy-steps_task-no_reflection-body-horizon2-tasks-" in run_folder(dataclasses.replace(cfg, planner=told), "").name


OWN_PROMPT = Path(__file__).parents[2] / "examples" / "own_prompt.py"


@pytest.mark.parametrize("threads", [1, 4])
def test_a_prompt_of_ones_own_asks_the_runs_backend(cfg, session, threads: int) -> None:
    own = FilePlanner("brief", "file", "Brief", source=f"{OWN_PROMPT}:Brief")
    result = run(cfg, session, planner=own, backend=script(cfg, "brief"), threads=threads)
    assert not result.broken
    assert len(result.records) == 9
    assert result.folder.name.startswith("brief-script-h1-easy-")
    assert result.metadata["label"] == "Brief on script"
    for record in result.records:
        assert record.planner_calls == record.steps > 0, "one call per step"
        assert (record.planner_tokens, record.planner_usd) == (55 * record.planner_calls, 0.5 * record.planner_calls)
        assert record.models == ("script-2",)
    assert any(record.invalid_output for record in result.records), "`walk` is no action"


def test_samples_of_a_prompt_of_ones_own_are_its_episodes(cfg, session, tmp_path) -> None:
    own = FilePlanner("brief", "file", "Brief", source=f"{OWN_PROMPT}:Brief")
    warm = dataclasses.replace(script(cfg, "brief"), temperature=0.7, cache=str(tmp_path / "replies.sqlite"))
    first = run(cfg, session, planner=own, backend=warm, trials=2)
    again = run(cfg, session, planner=own, backend=warm, trials=2, threads=3, output=str(tmp_path / "again"))
    assert not any(record.cached_calls for record in first.records), "no trial repeats the samples of another"
    assert all(record.cached_calls == record.planner_calls for record in again.records)


def test_a_planner_of_a_file_that_takes_no_backend_is_refused_with_one(cfg, session, tmp_path) -> None:
    own = FilePlanner("near", "file", "Near", source=f"{OWN_PROMPT.with_name('own_planner.py')}:Nearby")
    with pytest.raises(CodeFileError, match=r"Nearby\(backend, options\) failed: TypeError"):
        run(cfg, session, planner=own)
    with pytest.raises(ValueError, match=r"planner\.body True with planner kind 'file' without a backend; allowed: False"):
        dataclasses.replace(cfg, planner=dataclasses.replace(own, body=True), backend=None)
    with pytest.raises(ValueError, match=r"batch 2 with planner kind 'file'"):
        dataclasses.replace(cfg, planner=own, batch=2)


class Silent:
    """Never asked: it only has a name."""

    identity = "silent"

    def complete(self, request: ChatRequest) -> ChatReply:
        raise AssertionError(request)

    def close(self) -> None:
        pass


def test_other_weights_behind_a_server_are_another_run(cfg, tmp_path) -> None:
    folders, told = [], []
    asked = BackendConfig("openai", "serve", model="base", cache=str(tmp_path / "replies.sqlite"), retries=0)
    for revision in ("one", "two", "two", ""):
        with ChatServer(Silent(), "base", 0, revision=revision) as server:
            thread = threading.Thread(target=server.serve_forever, args=(0.02,))
            thread.start()
            backend = _ready(dataclasses.replace(cfg, backend=dataclasses.replace(asked, base_url=server.url))).backend
            server.shutdown()
            thread.join(30)
        assert backend is not None
        told.append(backend.revision)
        served = dataclasses.replace(cfg, backend=backend)
        folders.append(run_folder(served, config_hash(served, "")))
    assert told == ["one", "two", "two", ""]
    assert folders[0] != folders[1] == folders[2] != folders[3]


def test_a_server_that_stays_away_stops_the_run(cfg, session) -> None:
    stopped = run(cfg, session, backend=script(cfg, "away"), retries=3)
    assert stopped.stopped == "script: no connection"
    assert 0 < len(stopped.records) + len(stopped.broken) < 9
