"""Certificates: what the expert needed for a task on each robot, with both arms and with one.

A certificate states facts: that the expert solves the task at difficulty easy, in how many steps, and in how many with one arm
disabled. Its plan, simulated time, path and use of the arms are information: their last digits differ between processors. It
says with which physics (`sim.scene.compiler.PHYSICS`) it was made, and may be older than the present one. With one arm
essential tasks fail with either arm, single-arm tasks still succeed with one of them, and optional tasks succeed too, but not
within the time limit. The one-armed figures are the expert's, not proven optima.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from interface.bodies import PAPER_ROBOTS, Arm
from interface.episode import STEP_LIMIT
from sim.scene.compiler import PHYSICS
from sim.tasks.families import family_of
from sim.tasks.task import BENCHMARK_PATH, Task

CERTIFICATES_PATH: Final = BENCHMARK_PATH.with_name("certificates.jsonl")
#: Steps beyond the family's typical number that a certified plan may take.
_EXTRA_STEPS: Final = 6
#: Stances that a certified plan may need to try in thought; only draws that fail in the end need more, and long for it.
_LOOKAHEADS: Final = 12


class Refusal(ValueError):  # noqa: N818 - it reports that a draw is no task of the benchmark
    """A task that is not what its category says, on some robot; the message says why."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """Proof that a robot can solve a task, and what it needs both arms for.

    Attributes:
        task: task id.
        robot: robot name.
        plan: the expert's steps.
        makespan_s: simulated seconds.
        path_length_m: length of the base's path.
        arm_utilisation: mean fraction of arm-steps in which an arm acted.
        one_arm_steps: steps with that arm only, None where it does not succeed within 50.
        physics: version of the physics that it was made with.
    """

    task: str
    robot: str
    plan: tuple[str, ...]
    makespan_s: float
    path_length_m: float
    arm_utilisation: float
    one_arm_steps: Mapping[str, int | None] = field(default_factory=dict)
    physics: int = PHYSICS

    @property
    def stale(self) -> bool:
        """Whether the physics has changed since."""
        return self.physics != PHYSICS

    def to_json(self) -> dict[str, Any]:
        """Plain form; simulated quantities are rounded, steps are exact."""
        return {
            "task": self.task,
            "robot": self.robot,
            "physics": self.physics,
            "steps": len(self.plan),
            "plan": list(self.plan),
            "makespan_s": round(self.makespan_s, 1),
            "path_length_m": round(self.path_length_m, 1),
            "arm_utilisation": round(self.arm_utilisation, 3),
            "one_arm_steps": dict(self.one_arm_steps),
        }

    @staticmethod
    def from_json(record: Mapping[str, Any]) -> Certificate:
        """Reads `to_json` back."""
        values = {key: value for key, value in record.items() if key != "steps"}
        return Certificate(**{"physics": 1, **values, "plan": tuple(values["plan"])})


def time_limit_of(steps: Sequence[int], one_arm: Sequence[int | None] = ()) -> int:
    """Time limit: 1.5 times the longest plan, rounded up, plus 2, but fewer than one arm takes.

    Args:
        steps: the expert's steps on each robot.
        one_arm: least steps of one arm on each robot that the limit has to stay below; none for other categories.
    """
    limit = min(STEP_LIMIT, int(np.ceil(1.5 * max(steps))) + 2)
    return min([limit, *(steps - 1 for steps in one_arm if steps is not None)])


def certify(
    task: Task, robot: str, arms: Sequence[Arm] = (Arm.RIGHT, Arm.LEFT), step_limit: int = STEP_LIMIT
) -> Certificate | None:
    """The expert's solution on a robot at difficulty easy within so many steps, None when it fails."""
    from sim.expert.expert import Expert
    from sim.session.session import Session

    session = Session(robot, "easy", image_size=0, step_limit=step_limit)
    try:
        session.reset(task, seed=task.seed)
        expert = Expert(session, _LOOKAHEADS if len(arms) == len(Arm) else None, arms)
        expert.reset()
        while not session.finished:
            session.step(expert.next_step())
        stats = session.stats
        plan = tuple(item.step for item in session.history)
        if not session.succeeded or plan[-1] == "Done()":
            return None
        return Certificate(task.id, robot, plan, stats.makespan_s, stats.path_length_m, stats.arm_utilisation)
    finally:
        session.close()


def one_armed_steps(task: Task, certificate: Certificate) -> dict[str, int | None]:
    """Steps that the expert takes with each arm alone on the certificate's robot, None where it does not succeed."""
    used = {arm for arm in Arm if any(f"({arm.value}" in step for step in certificate.plan)}
    both = any("Lift(" in step or "PlaceBoth(" in step for step in certificate.plan)
    found: dict[str, int | None] = {}
    for arm in Arm:
        if not both and used <= {arm} and not any(" & " in step for step in certificate.plan):
            found[arm.value] = len(certificate.plan)
            continue
        alone = certify(task, certificate.robot, (arm,))
        found[arm.value] = None if alone is None else len(alone.plan)
    return found


def certified(
    task: Task, old: Mapping[str, Certificate] | None = None, robots: Sequence[str] = PAPER_ROBOTS
) -> tuple[Task, tuple[Certificate, ...]]:
    """The task with its time limit, and a certificate per robot.

    Args:
        task: what is solved.
        old: certificates by robot: one-armed steps are taken from them where the plan is still the same.
        robots: robots that solve it now; for others the old certificate stands.

    Raises:
        Refusal: when some robot fails, needs too long, or does not need, or gain from, its arms as the category says.
    """
    limit = min(STEP_LIMIT, family_of(task.family).steps + _EXTRA_STEPS)
    proofs: list[Certificate] = []
    steps: list[int] = []
    alone: list[int | None] = []
    for robot in sorted(PAPER_ROBOTS, reverse=True):  # x1, which fails more often, first
        before = (old or {}).get(robot)
        proof = certify(task, robot, step_limit=limit) if robot in robots else before
        if proof is None:
            raise Refusal(f"{robot} does not solve it within {limit} steps")
        if before is not None and proof.plan == before.plan:
            proof = replace(proof, one_arm_steps=before.one_arm_steps)
        else:
            proof = replace(proof, one_arm_steps=one_armed_steps(task, proof))
        least = min((n for n in proof.one_arm_steps.values() if n is not None), default=None)
        if task.category == "essential" and least is not None:
            raise Refusal(f"{robot} solves it with one arm in {least} steps")
        if task.category != "essential" and least is None:
            raise Refusal(f"{robot} does not solve it with one arm")
        if task.category == "optional" and least is not None and least <= len(proof.plan):
            raise Refusal(f"two arms of {robot} take {len(proof.plan)} steps, one arm {least}")
        proofs.append(proof)
        steps.append(len(proof.plan))
        alone.append(least)
    time_limit = time_limit_of(steps, alone if task.category == "optional" else ())
    if time_limit < max(steps):
        raise Refusal(f"two arms take {max(steps)} steps, one arm {min(n for n in alone if n is not None)}")
    ordered = sorted(proofs, key=lambda proof: PAPER_ROBOTS.index(proof.robot))
    return replace(task, time_limit=time_limit), tuple(ordered)


def certificates_text(certificates: Iterable[Certificate]) -> str:
    """One JSON object per line, byte-stable."""
    return "".join(json.dumps(certificate.to_json()) + "\n" for certificate in certificates)


def certificates_table(tasks: Sequence[Task], certificates: Sequence[Certificate]) -> str:
    """Markdown: per family and robot the means of steps, makespan, path, use of the arms, and least steps of one arm."""
    family = {task.id: (task.category, task.family) for task in tasks}
    rows: dict[tuple[str, str, str], list[Certificate]] = {}
    for proof in certificates:
        rows.setdefault((*family[proof.task], proof.robot), []).append(proof)
    lines = [
        "| category | family | robot | tasks | steps | one arm | makespan (s) | path (m) | arms in use |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for (category, name, robot), proofs in rows.items():
        alone = [min(done) for done in ([n for n in p.one_arm_steps.values() if n is not None] for p in proofs) if done]
        figures = [
            f"{np.mean([len(p.plan) for p in proofs]):.1f}",
            f"{np.mean(alone):.1f}" if alone else "none",
            f"{np.mean([p.makespan_s for p in proofs]):.1f}",
            f"{np.mean([p.path_length_m for p in proofs]):.1f}",
            f"{100.0 * np.mean([p.arm_utilisation for p in proofs]):.0f} %",
        ]
        lines.append(f"| {category} | {name} | {robot} | {len(proofs)} | " + " | ".join(figures) + " |")
    return "\n".join(lines) + "\n"


def load_certificates() -> tuple[Certificate, ...]:
    """The benchmark's certificates, in file order."""
    lines = CERTIFICATES_PATH.read_text(encoding="utf-8").splitlines()
    return tuple(Certificate.from_json(json.loads(line)) for line in lines)
