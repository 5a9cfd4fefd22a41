"""A whole evaluation: which episodes are planned, which the ledger already has, and running the rest.

Everything that decides an episode's result is in its key: planner, robot, task, difficulty, trial, seed, and a hash over the
planner's configuration, its weights, the robot's description and the tasks. Running the same command again therefore continues
where the last run stopped, and a change of weights starts a new folder.

Paper: evaluation protocol (tasks, trials, temperature 0).
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

import configs
from configs.origin import PROVENANCE, origin
from configs.schema.backend import BackendConfig
from configs.schema.eval import EvalConfig
from configs.schema.planner import AnyPlanner, FilePlanner, MemoryPlanner, ModelPlanner
from data.cluster import import_ray
from data.code_files import source_digest, split_source
from data.files import file_hash, read_json, write_text
from interface.episode import EpisodeRecord, Outcome
from proprio_mllm.backends.factory import check_cap, make_backend, told_revision
from proprio_mllm.backends.identity import identity_of
from proprio_mllm.backends.protocol import BackendSetupError, ChatReply, ChatRequest
from proprio_mllm.evaluation.asking import batch_planner
from proprio_mllm.evaluation.episode import EpisodeKeyFields
from proprio_mllm.evaluation.ledger import EpisodeKey, Ledger, key_of, read_ledger, scored
from proprio_mllm.evaluation.naming import options_of
from proprio_mllm.evaluation.scheduling import scheduled
from proprio_mllm.evaluation.seeds import episode_seed
from proprio_mllm.evaluation.worker import EpisodeJob, EpisodeResult, Opener, WorkerSetup
from proprio_mllm.planners.memory import MEMORY_FILE, check_memory
from proprio_mllm.planners.protocol import check_weights
from proprio_mllm.planners.registry import make_chat_planner, make_planner
from robots.spec import load_robot
from sim.scene.compiler import PHYSICS
from sim.session.contingency import load_contingency
from sim.tasks.task import Task, load_benchmark, read_tasks

logger = logging.getLogger(__name__)

RUN_VERSION: Final = 1
_ROOT: Final = Path(configs.__file__).resolve().parent.parent


@dataclass(frozen=True, slots=True)
class EvalRun:
    """What an evaluation left behind.

    Attributes:
        folder: holds `run.json` and `ledger.jsonl`.
        metadata: contents of `run.json`.
        records: the planned episodes that are scored, in planned order.
        broken: infrastructure errors of the planned episodes, every attempt.
        stopped: why the run could not go on; empty when it did.
    """

    folder: Path
    metadata: dict[str, Any]
    records: tuple[EpisodeRecord, ...]
    broken: tuple[EpisodeRecord, ...]
    stopped: str = ""


def found(path: str) -> Path:
    """A path as given, or relative to the project when it is not found from here."""
    here = Path(path)
    return here if here.exists() or here.is_absolute() else _ROOT / here


def _decides(path: Path) -> bool:
    return path.suffix in (".safetensors", ".json", ".jinja", ".txt") and path.name != PROVENANCE


def weights_digest(folder: Path) -> str:
    """Short hash over the files of a stored model, but not over where it comes from."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and _decides(p)):
        digest.update(path.relative_to(folder).as_posix().encode())
        digest.update(bytes.fromhex(file_hash(path)))
    return digest.hexdigest()[:16]


def select_tasks(cfg: EvalConfig) -> tuple[Task, ...]:
    """The tasks of a run: the file's, of the wanted split and category, the first `limit` of each category.

    Raises:
        ValueError: when the file is not there or no task is left.
    """
    if cfg.tasks == "benchmark":
        tasks = load_benchmark()
    elif Path(cfg.tasks).is_file():
        tasks = read_tasks(Path(cfg.tasks))
    else:
        raise ValueError(f"tasks={cfg.tasks!r}: no such file; allowed: benchmark, or the path of a JSON-lines file")
    chosen: list[Task] = []
    count: dict[str, int] = {}
    of_split = [task for task in tasks if cfg.split in ("all", task.split)]
    if not of_split:
        there = ", ".join(sorted({task.split for task in tasks}))
        raise ValueError(f"tasks={cfg.tasks!r} has no task of split {cfg.split!r}; its tasks are of: {there or 'none'}")
    for task in of_split:
        count[task.category] = count.get(task.category, 0) + 1
        if cfg.category in ("all", task.category) and (cfg.limit is None or count[task.category] <= cfg.limit):
            chosen.append(task)
    if not chosen:
        which = "" if cfg.split == "all" else f" and split {cfg.split!r}"
        raise ValueError(f"tasks={cfg.tasks!r} has no task of category {cfg.category!r}{which}")
    return tuple(chosen)


def config_hash(cfg: EvalConfig, digest: str) -> str:
    """Hash of what decides results besides the rest of the episode's key; `evaluate` derives it once and passes it on.

    Args:
        cfg: what to run.
        digest: of the planner's weights or file, "" when it has none.
    """
    paths = ("label", "train", "weights", "source", "memory")
    planner = {name: value for name, value in dataclasses.asdict(cfg.planner).items() if name not in paths}
    decides = {"planner": planner, "weights": digest, "robot": dataclasses.asdict(cfg.robot), "start": cfg.start}
    decides |= {"steps": cfg.steps, "stuck": cfg.stuck, "physics": PHYSICS, "feedback": cfg.feedback}
    decides["contingencies"] = _contingencies_hash(cfg)
    if cfg.backend is not None:
        own = {name: getattr(cfg.backend, name) for name in ("max_tokens", "temperature", "image_size")}
        decides["backend"] = own | {"identity": identity_of(cfg.backend)}
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:12]


def _contingencies_hash(cfg: EvalConfig) -> str:
    return hashlib.sha256(repr(load_contingency(cfg.contingencies)).encode()).hexdigest()


def task_key(task: Task) -> str:
    """A task's id with a hash of its content, so that an edited task is another one."""
    return task.content_hash()[:6]


def plan_episodes(cfg: EvalConfig, tasks: Sequence[Task], own_hash: str) -> list[EpisodeJob]:
    """Every episode of a run, in the order of tasks and trials.

    Args:
        cfg: what to run.
        tasks: its tasks.
        own_hash: the run's `config_hash`.
    """
    jobs: list[EpisodeJob] = []
    for task in tasks:
        for trial in range(cfg.trials):
            fields = EpisodeKeyFields(
                planner=cfg.planner.name,
                robot=cfg.robot.name,
                task=task.id,
                category=task.category,
                difficulty=cfg.difficulty,
                trial=trial,
                seed=cfg.seed,
                config_hash=f"{own_hash}-{task_key(task)}",
            )
            jobs.append(EpisodeJob(fields, cfg.robot, task, episode_seed(cfg.seed, task.id, cfg.robot.name, trial)))
    return jobs


def run_folder(cfg: EvalConfig, own_hash: str) -> Path:
    """Where a run's files go; equal commands share a folder, other weights or settings have their own.

    Args:
        cfg: what to run.
        own_hash: the run's `config_hash`.
    """
    own = dict.fromkeys([cfg.planner.name, cfg.planner.name if cfg.backend is None else cfg.backend.name])
    parts = [*own, cfg.robot.name, cfg.difficulty, *options_of(dataclasses.asdict(cfg))]
    return Path(cfg.output) / "eval" / "-".join([*parts, own_hash[:6]])


def _label(cfg: EvalConfig) -> str:
    """The planner's label, with the model where that is not the one of the label."""
    backend = cfg.backend
    if backend is None or (backend.name == cfg.planner.name and backend.kind != "local"):
        return cfg.planner.label
    planner = "Plain prompting" if cfg.planner.kind == "plain" else cfg.planner.label
    model = Path(backend.model).resolve().name if backend.kind == "local" else backend.model
    return f"{planner} on {model or backend.name}"


def _metadata(cfg: EvalConfig, jobs: Sequence[EpisodeJob], digest: str, own_hash: str) -> dict[str, Any]:
    return {
        "version": RUN_VERSION,
        "physics": PHYSICS,
        **origin(),
        "planner": cfg.planner.name,
        "label": _label(cfg),
        "privileged": cfg.planner.kind == "expert",
        "robot": cfg.robot.name,
        "difficulty": cfg.difficulty,
        "contingencies": cfg.contingencies,
        "contingencies_hash": _contingencies_hash(cfg),
        "category": cfg.category,
        "trials": cfg.trials,
        "limit": cfg.limit,
        "start": cfg.start,
        "split": cfg.split,
        "steps": cfg.steps,
        "stuck": cfg.stuck,
        "seed": cfg.seed,
        "tasks": cfg.tasks,
        "weights": getattr(cfg.planner, "weights", None),
        "weights_digest": digest,
        "config_hash": own_hash,
        "command": "python " + " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "planned": [[job.fields.task, job.fields.category, job.fields.trial, job.fields.config_hash] for job in jobs],
        "reflection": getattr(cfg.planner, "reflection", "on"),
        "backend": None if cfg.backend is None else dataclasses.asdict(cfg.backend),
        "config": dataclasses.asdict(cfg),
    }


class _Unasked:
    """A backend to make a planner with that is asked nothing yet."""

    identity = "unasked"

    def complete(self, request: ChatRequest) -> ChatReply:
        raise BackendSetupError(f"a planner asks its backend before its first episode: {request.purpose}")

    def close(self) -> None:
        """Holds nothing."""


def _resolved(planner: AnyPlanner, backend: BackendConfig | None) -> tuple[AnyPlanner, str]:
    """The planner with its weights or its file found, and their digest."""
    if isinstance(planner, FilePlanner):
        file, name = split_source(planner.source, "planner.source", "class")
        source = f"{found(str(file)).absolute()}:{name}"
        planner = dataclasses.replace(planner, source=source)
        # what is wrong fails here, with one message, rather than in every worker
        _ = make_planner(planner) if backend is None else make_chat_planner(planner, backend, _Unasked())
        return planner, source_digest(source)
    if isinstance(planner, MemoryPlanner):
        memory = check_memory(found(planner.memory))
        return dataclasses.replace(planner, memory=str(memory.absolute())), file_hash(memory / MEMORY_FILE)[:16]
    if not isinstance(planner, ModelPlanner):
        return planner, ""
    folder = check_weights(found(planner.weights), planner.train)
    learnt_in = read_json(folder / PROVENANCE).get("physics") if (folder / PROVENANCE).is_file() else None
    if learnt_in not in (None, PHYSICS):
        logger.warning("%s learnt from episodes of physics %s, this is physics %s", folder, learnt_in, PHYSICS)
    return dataclasses.replace(planner, weights=str(folder.absolute())), weights_digest(folder)


def _ready(cfg: EvalConfig) -> EvalConfig:
    """The configuration with its robot and the backend that its planner asks known to be there."""
    if cfg.robot.mjcf is not None:
        raise ValueError(
            f"robot.mjcf={cfg.robot.mjcf!r}: episodes take another MJCF through a description, robot.spec=FILE.yaml"
        )
    load_robot(cfg.robot.spec or cfg.robot.name)  # a wrong description stops here, not in every episode
    backend = cfg.backend
    if backend is None:
        return cfg
    if backend.source is not None:
        file, name = split_source(backend.source, "backend.source", "function")
        backend = dataclasses.replace(backend, source=f"{found(str(file)).absolute()}:{name}")
    check_cap(backend, cfg.cost_cap_usd)
    if backend.kind == "local":  # whose weights are loaded once, where they answer
        from proprio_mllm.backends.checkpoint import find_checkpoint  # imports torch

        checkpoint = find_checkpoint(str(found(backend.model)))
        backend = dataclasses.replace(
            backend, model=str(found(backend.model)), revision=backend.revision or checkpoint.fingerprint()
        )
    else:
        backend = dataclasses.replace(backend, revision=backend.revision or told_revision(backend))
        make_backend(backend, None).close()
    return dataclasses.replace(cfg, backend=backend)


def evaluate(cfg: EvalConfig, opener: Opener | None = None, told: bool = True) -> EvalRun:
    """Runs what is missing of an evaluation.

    Args:
        cfg: what to run.
        opener: opens sessions; the simulator's by default.
        told: whether progress is shown.

    Returns:
        All planned episodes, those of earlier runs of the same command included; `stopped` tells when a cost cap or a backend
        that cannot answer ended the run early.

    Raises:
        WeightsError: when the planner's weights are absent.
        MemoryFileError: when the planner's memory is absent.
        BackendError: when the backend cannot be made.
        CodeFileError: when the planner cannot be made from its file.
        ValueError: when there is no task to run, the robot's description is wrong, `robot.mjcf` is given, or the contingency is
            unknown.
    """
    cfg = _ready(cfg)
    planner, digest = _resolved(cfg.planner, cfg.backend)
    _check_scheduler(cfg, planner)
    own_hash = config_hash(cfg, digest)
    jobs = plan_episodes(cfg, select_tasks(cfg), own_hash)
    folder = run_folder(cfg, own_hash)
    folder.mkdir(parents=True, exist_ok=True)
    metadata = _metadata(cfg, jobs, digest, own_hash)
    shared = str(folder.absolute())
    setup = WorkerSetup(
        planner, cfg.difficulty, cfg.start, cfg.contingencies, None, cfg.backend, shared, cfg.cost_cap_usd,
        cfg.steps, cfg.stuck, cfg.feedback,
    )  # fmt: skip
    path = folder / "ledger.jsonl"
    with Ledger(path) as ledger:
        write_text(folder / "run.json", json.dumps(metadata, indent=1) + "\n")  # not while another process runs what it says
        stopped = _run_missing(cfg, setup, jobs, ledger, path, opener, told)
    everything = read_ledger(path)
    scores, wanted = scored(everything), [_fields_key(job) for job in jobs]
    keys = set(wanted)
    broken = [r for r in everything if r.outcome is Outcome.INFRASTRUCTURE_ERROR and key_of(r) in keys]
    return EvalRun(folder, metadata, tuple(scores[key] for key in wanted if key in scores), tuple(broken), stopped)


def _check_scheduler(cfg: EvalConfig, planner: AnyPlanner) -> None:
    """What the schedule needs; a missing extra stops here, before anything is written."""
    if cfg.scheduler == "ray":
        import_ray(cfg.ray_address)
    if cfg.batch > 1 and planner.kind == "file":
        batch_planner(planner)


def _run_missing(
    cfg: EvalConfig,
    setup: WorkerSetup,
    jobs: Sequence[EpisodeJob],
    ledger: Ledger,
    path: Path,
    opener: Opener | None,
    told: bool = True,
) -> str:
    """Runs what the ledger does not have, the longest episodes first, so that workers finish together; why it stopped."""
    scores = scored(read_ledger(path))
    known = [scores[key] for key in map(_fields_key, jobs) if key in scores]
    missing = [job for job in jobs if _fields_key(job) not in scores]
    if known:
        logger.info("%d of %d episodes are already in %s", len(known), len(jobs), path)
    order = sorted(missing, key=lambda job: -job.task.time_limit)
    solved = sum(record.outcome is Outcome.SUCCESS for record in known)
    title = f"{cfg.planner.name} {cfg.robot.name} {cfg.difficulty}"
    with (
        tqdm(total=len(jobs), initial=len(known), desc=title, unit="episode", disable=not told) as bar,
        contextlib.closing(scheduled(cfg, setup, order, _to_repeat, opener, cfg.threads)) as results,
    ):
        for result in results:
            if result.stop:
                return result.stop
            ledger.append(result.record)
            if not _broke(result):
                solved += result.record.outcome is Outcome.SUCCESS
                bar.set_postfix_str(f"success {solved}/{bar.n + 1}", refresh=False)
                bar.update(1)
    return ""


def _to_repeat(result: EpisodeResult) -> bool:
    return _broke(result) and not result.stop


def _broke(result: EpisodeResult) -> bool:
    return result.record.outcome is Outcome.INFRASTRUCTURE_ERROR


def _fields_key(job: EpisodeJob) -> EpisodeKey:
    f = job.fields
    return f.planner, f.robot, f.task, f.difficulty, f.trial, f.seed, f.config_hash
