"""What a worker process does: open a session for a job, let the planner act, hand back the record.

Everything in here is plain data or made inside the process, so that jobs and results can be sent between processes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

from configs.schema.backend import BackendConfig
from configs.schema.eval import DifficultyName, FeedbackName, StartName
from configs.schema.planner import BuiltInPlanner, PlannerConfig
from configs.schema.robot import RobotConfig
from interface.episode import STEP_LIMIT, EpisodeRecord, Outcome
from proprio_mllm.backends.protocol import BackendSetupError, ChatReply, ChatRequest, CostCapError, UnreachableError
from proprio_mllm.evaluation.asking import answer_all
from proprio_mllm.evaluation.episode import (
    Ask,
    Begin,
    Episode,
    EpisodeKeyFields,
    Limits,
    RunnableSession,
    answer,
    episode_steps,
)
from proprio_mllm.evaluation.showing import Showing
from proprio_mllm.planners.bars import without_bar
from proprio_mllm.planners.protocol import BatchPlanner, Planner, PlannerReply
from proprio_mllm.planners.registry import make_chat_planner, make_planner
from sim.tasks.task import Task

if TYPE_CHECKING:
    from proprio_mllm.evaluation.recording import RolloutRecorder

#: Calls in a row that do not reach a server which has answered before, each with its repetitions, until the run stops.
_MOST_UNREACHED: Final = 5


@dataclass(frozen=True, slots=True)
class WorkerSetup:
    """What all episodes of a worker share.

    Attributes:
        planner: who plans.
        difficulty: success of low-level skills.
        start: see `EvalConfig.start`.
        contingency: see `EvalConfig.contingencies`.
        server: gives a planner that asks a model in another process; None makes the planner here.
        backend: the language model that a planner which chats asks.
        folder: of the run, where its processes share what they may spend and how many calls go on at once.
        cap_usd: most money the run may spend.
        steps, stuck: see `EvalConfig`.
        feedback: what planners are told of failures.
    """

    planner: PlannerConfig
    difficulty: DifficultyName
    start: StartName
    contingency: str = "default"
    server: PlannerServer | None = None
    backend: BackendConfig | None = None
    folder: str = ""
    cap_usd: float | None = None
    steps: int | Literal["task"] = STEP_LIMIT
    stuck: int = 0
    feedback: FeedbackName = "codes"


class PlannerServer(Protocol):
    """Where a model runs that many workers ask; `proprio_mllm.evaluation.serving` and `ray_pool` have one each."""

    def connect(self) -> Planner:
        """A planner that asks it."""
        ...


@dataclass(frozen=True, slots=True)
class EpisodeJob:
    """One episode to run.

    Attributes:
        fields: its key.
        robot: which robot acts.
        task: its task.
        episode_seed: its seed.
        record: whether observations are kept for training.
        slot: which of the episodes that go side by side in its process.
    """

    fields: EpisodeKeyFields
    robot: RobotConfig
    task: Task
    episode_seed: int
    record: bool = False
    slot: int = 0


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """A finished episode.

    Attributes:
        record: its line of the ledger.
        rollout: the row for `rollouts` shards when it was asked for.
        stop: why the run cannot go on; the record is then of no worth.
    """

    record: EpisodeRecord
    rollout: Mapping[str, Any] | None = None
    stop: str = ""


#: Opens a session for a job and attaches privileged planners to it.
Opener = Callable[[WorkerSetup, EpisodeJob, Planner], RunnableSession]


def open_simulator(setup: WorkerSetup, job: EpisodeJob, planner: Planner) -> RunnableSession:
    """A session of the simulator: the `Opener` of runs."""
    from proprio_mllm.evaluation.sessions import open_session  # physics and rendering load only where they run

    return open_session(
        job.robot,
        setup.difficulty,
        setup.start,
        job.task,
        job.episode_seed,
        planner,
        contingency=setup.contingency,
        slot=job.slot,
    )


class EpisodeWorker:
    """Runs episodes in this process.

    Args:
        setup: what they share.
        opener: opens sessions; the simulator's by default.
    """

    def __init__(self, setup: WorkerSetup, opener: Opener = open_simulator) -> None:
        logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
        self.setup = setup
        self._opener = opener
        self._chats = _Chats(setup) if setup.backend is not None else None
        self.planner = _planner(setup) if self._chats is None else self._chats.planner()

    def __call__(self, job: EpisodeJob) -> EpisodeResult:
        """Runs one episode."""
        ((_, result),) = self.run(deque([job]), 1)
        return result

    def run(self, queue: deque[EpisodeJob], count: int) -> Iterator[tuple[EpisodeJob, EpisodeResult]]:
        """Runs the episodes of a queue in this thread, up to `count` at a time.

        The simulator's part of the episodes takes turns. A planner that answers several episodes is asked for all of them at
        once; one that asks a backend answers each in a thread of its own, so that a slow model keeps no other episode waiting.

        Args:
            queue: is emptied; what is appended meanwhile is run too.
            count: episodes at a time.

        Yields:
            Each job with its result, in the order they end.

        Raises:
            ValueError: when several at a time are asked of a planner that answers one.
        """
        running: dict[int, _Running] = {}
        with contextlib.closing(self._asker(count)) as asker:
            while queue or running:
                for slot in range(count):
                    if queue and slot not in running:
                        running[slot] = self._started(dataclasses.replace(queue.popleft(), slot=slot))
                asker.ask(running)
                for slot in [slot for slot, one in running.items() if one.record is not None]:
                    one = running.pop(slot)
                    assert one.record is not None
                    yield one.job, self._finished(_result(one.job, one.record, one.recorder, one.opened))

    def _asker(self, count: int) -> _Asker:
        """How the planner is asked."""
        if self._chats is not None and count > 1:
            return _Threads([self._chats.planner() for _ in range(count)])
        if count == 1:
            return _Alone(self.planner)
        if not isinstance(self.planner, BatchPlanner):
            raise ValueError(
                f"planner {self.setup.planner.name!r} answers one episode at a time: it has no begin and step_batch"
            )
        return _Together(self.planner)

    def _finished(self, result: EpisodeResult) -> EpisodeResult:
        """The result, with what keeps the run from going on."""
        stop = "" if self._chats is None else self._chats.stop
        return dataclasses.replace(result, stop=stop) if stop and _broken(result) else result

    def _started(self, job: EpisodeJob) -> _Running:
        recorder, opened = _recorder() if job.record else None, list[RunnableSession]()
        task, watch = job.task, None if recorder is None else recorder.watch
        limits = Limits.of(task.time_limit, self.setup.steps, self.setup.stuck)

        def open_session() -> RunnableSession:
            opened.append(self._opener(self.setup, job, self.planner))
            return opened[-1]

        showing = Showing(getattr(self.setup.planner, "blind", "none"), self.setup.feedback)
        episode = episode_steps(open_session, job.fields, task.instruction, limits, job.episode_seed, watch, showing)
        one = _Running(job, episode, recorder, opened)
        one.go_on(None)
        return one


@dataclass(slots=True)
class _Running:
    """An episode under way: what it asks now, or its record."""

    job: EpisodeJob
    episode: Episode
    recorder: RolloutRecorder | None
    opened: list[RunnableSession]
    request: Begin | Ask | None = None
    state: Any = None
    record: EpisodeRecord | None = None

    def go_on(self, answer: PlannerReply | Exception | None) -> None:
        """Hands over an answer, or the error there was instead, and runs to the next question or the end."""
        try:
            self.request = self.episode.throw(answer) if isinstance(answer, Exception) else self.episode.send(answer)
        except StopIteration as end:
            self.request, self.record = None, end.value

    def begin(self, planner: BatchPlanner) -> None:
        """Starts the planner's side of the episode."""
        assert isinstance(self.request, Begin)
        try:
            self.state = planner.begin(self.request.task, self.request.rng)
        except Exception as error:  # noqa: BLE001  # what breaks in the planner is recorded by the episode
            self.go_on(error)
        else:
            self.go_on(None)


class _Asker(Protocol):
    """Asks a planner what episodes want to know."""

    def ask(self, running: Mapping[int, _Running]) -> None:
        """Answers episodes, by slot, that have a question: at least one, unless another one has ended."""
        ...

    def close(self) -> None:
        """Waits for what is under way."""
        ...


class _Alone:
    """One episode, one planner."""

    def __init__(self, planner: Planner) -> None:
        self._planner = planner

    def ask(self, running: Mapping[int, _Running]) -> None:
        """Answers it."""
        for one in running.values():
            if one.request is not None:
                one.go_on(answer(self._planner, one.request))

    def close(self) -> None:
        """Holds nothing."""


class _Together:
    """A planner that answers all at once; the order of everything is fixed by the queue."""

    def __init__(self, planner: BatchPlanner) -> None:
        self._planner = planner

    def ask(self, running: Mapping[int, _Running]) -> None:
        """Answers all of them."""
        for one in running.values():
            if isinstance(one.request, Begin):
                one.begin(self._planner)
        asked = [one for one in running.values() if isinstance(one.request, Ask)]
        seen = [one.request.observation for one in asked if isinstance(one.request, Ask)]
        for one, reply in zip(asked, answer_all(self._planner, seen, [one.state for one in asked]), strict=True):
            one.go_on(reply)

    def close(self) -> None:
        """Holds nothing."""


class _Threads:
    """A planner per slot, each answering in a thread; whoever is first goes on."""

    def __init__(self, planners: Sequence[Planner]) -> None:
        self._planners = planners
        self._pool = ThreadPoolExecutor(len(planners))
        self._asked: dict[Future[PlannerReply | Exception | None], int] = {}

    def ask(self, running: Mapping[int, _Running]) -> None:
        """Sends new questions off, and waits for an answer unless an episode has ended."""
        for slot in sorted(set(running) - set(self._asked.values())):
            request = running[slot].request
            if request is not None:
                self._asked[self._pool.submit(answer, self._planners[slot], request)] = slot
        if any(one.record is not None for one in running.values()):
            return  # what has ended makes room before anybody is waited for
        for future in wait(self._asked, return_when=FIRST_COMPLETED).done:
            running[self._asked.pop(future)].go_on(future.result())

    def close(self) -> None:
        """Waits for the calls under way."""
        self._pool.shutdown()


class _Chats:
    """Planners of one process that share a backend, and why it can answer no more."""

    def __init__(self, setup: WorkerSetup) -> None:
        from proprio_mllm.backends.factory import make_backend  # clients and models load only where they are asked

        assert setup.backend is not None
        self._setup, self._cfg = setup, setup.backend
        self._backend = make_backend(setup.backend, Path(setup.folder), setup.cap_usd)
        self._answered, self._unreached = False, 0
        self.stop = ""

    def planner(self) -> Planner:
        """Another planner."""
        return make_chat_planner(self._setup.planner, self._cfg, self)

    @property
    def identity(self) -> str:
        """The backend's."""
        return self._backend.identity

    def complete(self, request: ChatRequest) -> ChatReply:
        """The backend's reply; what it says when it can answer no more is kept.

        A server that is not reached before it has answered anything is taken for a wrong address; one that goes away later
        may come back, until so many calls in a row have not reached it.
        """
        try:
            reply = self._backend.complete(request)
        except (BackendSetupError, CostCapError) as error:
            self.stop = str(error)
            raise
        except UnreachableError as error:
            self._unreached += 1
            self.stop = self.stop or ("" if self._answered and self._unreached < _MOST_UNREACHED else str(error))
            raise
        if not reply.cached:
            self._answered, self._unreached = True, 0
        return reply

    def close(self) -> None:
        """Closes the backend."""
        self._backend.close()


def _broken(result: EpisodeResult) -> bool:
    return result.record.outcome is Outcome.INFRASTRUCTURE_ERROR


def _planner(setup: WorkerSetup) -> Planner:
    if setup.server is not None:
        return setup.server.connect()
    if isinstance(setup.planner, BuiltInPlanner) and setup.planner.kind == "expert":
        from proprio_mllm.evaluation.privileged import ExpertPlanner

        return ExpertPlanner(setup.planner.image_size)
    if setup.planner.kind != "mllm":
        return make_planner(setup.planner)
    import torch

    torch.set_num_threads(1)
    with without_bar():
        return make_planner(setup.planner)


def _result(
    job: EpisodeJob, record: EpisodeRecord, recorder: RolloutRecorder | None, opened: Sequence[RunnableSession]
) -> EpisodeResult:
    if recorder is None or record.outcome is Outcome.INFRASTRUCTURE_ERROR:
        return EpisodeResult(record)
    return EpisodeResult(record, recorder.row(job.task, record, opened[-1].relations()))


def _recorder() -> RolloutRecorder:
    from proprio_mllm.evaluation.recording import RolloutRecorder  # training's row format brings torch, which few runs need

    return RolloutRecorder()


def lost_episode(job: EpisodeJob, message: str) -> EpisodeResult:
    """The result of an episode whose process died."""
    record = EpisodeRecord(
        **dataclasses.asdict(job.fields),
        outcome=Outcome.INFRASTRUCTURE_ERROR,
        failure=None,
        invalid_output=0,
        budget_exhausted=False,
        goal_conditions_met=0.0,
        steps=0,
        makespan_s=0.0,
        path_length_m=0.0,
        arm_utilisation=0.0,
        planner_calls=0,
        planner_tokens=0,
        planner_s=0.0,
        wall_s=0.0,
        message=message,
    )
    return EpisodeResult(record)
