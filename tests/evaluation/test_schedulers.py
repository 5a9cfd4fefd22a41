"""The same run in this process, on two processes, and on Ray, with the model in the workers or in a process of its own."""

from __future__ import annotations

import dataclasses
import functools
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from configs.schema.eval import EvalConfig
from configs.schema.planner import FilePlanner
from configs.schema.robot import RobotConfig
from data.cluster import import_ray, ray_instance
from interface.episode import EpisodeRecord
from interface.observation import Camera, Observation, Proprioception
from proprio_mllm.evaluation.ray_pool import ray_model, run_ray_jobs
from proprio_mllm.evaluation.run import evaluate
from proprio_mllm.evaluation.serving import model_processes, visible_gpus
from proprio_mllm.planners.protocol import Planner, TaskInfo
from sim.tasks.task import load_benchmark, write_tasks

OWN = """
import os
from proprio_mllm.planners.protocol import parse_reply

class Own:
    privileged, image_size = False, 56

    def begin(self, task, rng):
        return rng

    def reset(self, task, rng):
        self.rng = rng

    def step(self, observation, feedback):
        return self.step_batch([observation], [self.rng])[0]

    def step_batch(self, observations, states=None):
        if observations[0].instruction == "die":
            os._exit(1)
        if observations[0].instruction == "fail":
            raise ValueError("no answer to this")
        names = [one.known_objects for one in observations]
        drawn = [str(rng.choice(known)) for rng, known in zip(states, names)]
        turns = ["RotateLeft(45)", "RotateRight(45)"]
        return [parse_reply(turns[int(rng.integers(2))] if rng.random() < 0.7 else f"GoTo({name})", tokens=2)
                for rng, name in zip(states, drawn)]
"""
INFO = TaskInfo("turn", "h1", 3)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> FilePlanner:
    path = tmp_path_factory.mktemp("planner") / "own_of_schedulers.py"
    path.write_text(OWN)
    return FilePlanner("own", "file", "Own", source=f"{path}:Own")


@pytest.fixture(scope="module")
def ray() -> Iterator[Any]:
    """One instance for the file; a run uses the one that is there."""
    with ray_instance(2, None) as module:
        yield module


@pytest.fixture(scope="module")
def cfg(own: FilePlanner, tmp_path_factory: pytest.TempPathFactory) -> EvalConfig:
    folder = tmp_path_factory.mktemp("runs")
    write_tasks([dataclasses.replace(task, time_limit=1) for task in load_benchmark()[:3]], folder / "tasks.jsonl")
    return EvalConfig(own, RobotConfig("h1"), workers=0, tasks=str(folder / "tasks.jsonl"), output=str(folder / "serial"))


@pytest.fixture(scope="module")
def serial(cfg: EvalConfig) -> list[EpisodeRecord]:
    return ledger(cfg)


def ledger(cfg: EvalConfig) -> list[EpisodeRecord]:
    """Records of a run without their times."""
    run = evaluate(cfg)
    assert not run.broken, run.broken[0].message
    return [dataclasses.replace(record, planner_s=0.0, wall_s=0.0) for record in run.records]


def test_processes_write_the_serial_ledger(cfg: EvalConfig, serial: list[EpisodeRecord]) -> None:
    assert ledger(dataclasses.replace(cfg, workers=2, output=f"{cfg.output}-processes")) == serial
    assert len(serial) == 3


@pytest.mark.slow
def test_ray_with_one_model_for_all_writes_the_serial_ledger(cfg: EvalConfig, serial: list[EpisodeRecord], ray: Any) -> None:
    own = dataclasses.replace(cfg, scheduler="ray", workers=2, batch=2, output=f"{cfg.output}-ray")
    assert ledger(own) == serial
    assert ray.is_initialized(), "an instance that was there is left as it is"


class Fragile:
    """Doubles a number; the process dies at the first attempt at an odd one."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, job: int) -> int:
        marker = self.folder / str(job)
        if job % 2 and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return 2 * job


@pytest.mark.slow
def test_killed_ray_workers_are_replaced_and_their_jobs_run_again(ray: Any, tmp_path: Path) -> None:
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    done = run_ray_jobs(ray, functools.partial(Fragile, tmp_path), [1, 2, 4], 2, lambda r: r == 8, lambda job, why: why)
    assert sorted(done) == [2, 4, 8, 8]  # what failed is tried again
    lost = run_ray_jobs(ray, functools.partial(functools.partial, os._exit), [5], 1, lambda r: False, lambda job, why: why)
    assert list(lost) == ["the worker died in 2 attempts"]


@pytest.mark.slow
def test_ray_keeps_to_itself(ray: Any) -> None:
    assert ray.util.get_node_ip_address() == "127.0.0.1"
    assert ray.cluster_resources()["CPU"] == 2
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"

    def environment() -> dict[str, str]:
        return dict(os.environ)

    seen = ray.get(ray.remote(environment).remote())
    assert (seen["OMP_NUM_THREADS"], "MUJOCO_GL" in seen) == ("1", True)


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, cfg: EvalConfig, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"pip install 'proprio-mllm\[ray\]'"):
        import_ray()
    with pytest.raises(ValueError, match="scheduler=ray needs Ray"):
        evaluate(dataclasses.replace(cfg, scheduler="ray", workers=1, output=str(tmp_path / "out")))
    assert not (tmp_path / "out").exists()


def observation(instruction: str) -> Observation:
    body = Proprioception(np.zeros((64, 48), np.float32), 20.0, np.zeros(3), np.zeros((14, 3)))
    camera = Camera(np.eye(3), np.eye(4), 8, 8)
    image = np.zeros((8, 8, 3), np.uint8)
    return Observation(instruction, "h1", image, camera, ("Mug_1",), ("Mug_1",), body, (), 0, 3)


def said(planner: Planner, seed: int) -> list[str]:
    planner.reset(INFO, np.random.default_rng(seed))
    return [planner.step(observation("turn"), None).text for _ in range(4)]


def test_a_models_process_answers_callers_apart_and_is_started_again(own: FilePlanner) -> None:
    with model_processes(own, 2, ()) as models:
        (model,) = models.processes
        one, other = models.server.connect(), models.server.connect()
        assert one.image_size == 56
        assert said(one, 1) == said(other, 1) != said(one, 2)
        with pytest.raises(RuntimeError, match="ValueError: no answer to this"):
            one.step(observation("fail"), None)
        with pytest.raises((EOFError, ConnectionResetError)):
            one.step(observation("die"), None)
        model.process.join(10)
        model.ensure()
        before = said(one, 1)
        assert before == said(models.server.connect(), 1)
        with pytest.raises((EOFError, OSError)):
            other.step(observation("turn"), None)
        with pytest.raises(RuntimeError, match="has begun no episode here"):
            other.step(observation("turn"), None)  # connected again, but its episode is gone
        assert said(other, 1) == before
    assert not Path(model.server.path).exists()


def test_callers_are_spread_over_the_gpus(own: FilePlanner) -> None:
    with model_processes(own, 2, ("0", "1")) as models:
        callers = [models.server.connect() for _ in range(4)]
        assert len({tuple(said(one, 1)) for one in callers}) == 1
        first, second = models.processes
        with pytest.raises((EOFError, ConnectionResetError)):
            callers[0].step(observation("die"), None)  # the others of its process are two
        died = [one for one in models.processes if not (one.process.join(3) or one.process.is_alive())]
        assert len(died) == 1
        broken = 0
        for one in callers[1:]:
            try:
                one.step(observation("turn"), None)
            except (EOFError, OSError):
                broken += 1
        assert broken == 1
        models.ensure()
        assert first.process.is_alive() and second.process.is_alive()
        assert len({tuple(said(one, 1)) for one in callers}) == 1


def test_gpus_are_those_that_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    assert visible_gpus() == ("3", "5")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert visible_gpus() == ("0", "1")


@pytest.mark.slow
def test_a_models_actor_is_started_again(own: FilePlanner, ray: Any) -> None:
    class Caller:
        def __init__(self, server: Any) -> None:
            self.planner = server.connect()

        def __call__(self, instruction: str) -> str:
            self.planner.reset(INFO, np.random.default_rng(0))
            try:
                return self.planner.step(observation(instruction), None).text
            except Exception as error:  # noqa: BLE001  # whatever Ray makes of a dead actor
                return f"broken: {type(error).__name__}"

    server = ray_model(ray, own, 2)
    make = functools.partial(Caller, server)
    results = list(
        run_ray_jobs(ray, make, ["turn", "die", "turn", "turn"], 1, lambda r: r.startswith("broken"), lambda j, w: w, 0)
    )
    assert results[1].startswith("broken: ")
    assert results[0] == results[-1]
