"""How plausible the physics of certified plans is, measured from outside: `python -m benchmarks.plausibility --plans 20`.

Replays every n-th certified plan of each robot and asks, at every control tick of 20 ms, what a person would see in a film:
grasps with a gap, held objects that shift in the hand or fly, things inside the robot or its fingers inside things, feet that
slip or sink; and after every set-down, and after the plan, whether it lasts for two seconds. Poses, contacts and constraints
are read; nothing that a skill reports is believed. `--disturb` adds noise to all positions and speeds before every step.

Lengths are of primitives and meshes' convex hulls. Not part of any experiment.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import PAPER_ROBOTS, SIDES
from interface.steps import PlanStep
from sim.benchmark.certificates import load_certificates
from sim.session.session import Session
from sim.tasks.task import load_benchmark
from sim.world.world import World

Array = NDArray[np.float64]
_TICK_S: Final = 0.02
#: Ticks between two measurements of what is inside what, which cost more than a tick.
_EVERY: Final = 5
#: What moves farther in a tick has not moved but jumped; metres.
_JUMP_M: Final = 0.1
#: A base slower than this does not walk.
_WALKS_M_S: Final = 0.05
_LASTS_S: Final = 2.0
_MM: Final = 1000.0


@dataclass
class Findings:
    """What one plan shows.

    Attributes:
        task, robot: which plan.
        failed: steps of the plan that do not succeed, with their codes.
        solved: whether the goals hold after the last step; `lasted`: two seconds later.
        ticks: measured.
        jumps: objects that moved farther than 10 cm within a tick.
        gaps_mm: distance of the farther finger group (of two hands: of the farther hand) when a grasp is made.
        shift_mm, turn_deg: largest error of each grasp against the pose in which it was made.
        carried_m_s: largest speed of each held object.
        inside_robot_mm: depth of held objects in trunk, head, legs and arms, the largest per plan.
        inside_things_mm: depth of trunk, head and legs in furniture and objects.
        fingers_mm: depth of the hands in what they hold, the largest per grasp.
        slip_m, path_m: way of the lower sole over the floor; of the base.
        slip_m_s: speeds of the lower sole while the base moves.
        sunk_mm: depth of the soles below the floor.
        set_downs, lasting: successful set-downs; those after which the thing, two seconds later, rests there.
        tilts_deg: of what was set down, then, from its nearest resting attitude; 0 in a container, where things lean.
    """

    task: str
    robot: str
    failed: list[str] = field(default_factory=list)
    solved: bool = False
    lasted: bool = False
    ticks: int = 0
    jumps: int = 0
    gaps_mm: list[float] = field(default_factory=list)
    shift_mm: list[float] = field(default_factory=list)
    turn_deg: list[float] = field(default_factory=list)
    carried_m_s: list[float] = field(default_factory=list)
    inside_robot_mm: float = 0.0
    inside_things_mm: float = 0.0
    fingers_mm: list[float] = field(default_factory=list)
    slip_m: float = 0.0
    path_m: float = 0.0
    slip_m_s: list[float] = field(default_factory=list)
    sunk_mm: float = 0.0
    set_downs: int = 0
    lasting: int = 0
    tilts_deg: list[float] = field(default_factory=list)


class _Observer:
    """Looks at a world after every tick."""

    def __init__(self, session: Session, findings: Findings) -> None:
        self.found, self.world = findings, session.world
        model, scene = self.world.model, self.world.scene
        solid = (model.geom_group < 4) & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
        mine = np.isin(model.geom_bodyid, list(scene.robot_bodies)) & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_MESH))
        constraints = self.world.grasps.constraints
        self.hands = {side: constraints.hand_geoms(side) for side in SIDES}
        fore = [model.geom(f"{side}_forearm").id for side in SIDES if _has_geom(model, f"{side}_forearm")]
        limbs = np.concatenate([*self.hands.values()])
        self.body = np.array([g for g in np.flatnonzero(mine & solid) if g not in limbs and g not in fore])
        arm_bodies = {int(b) for side in SIDES for b in _chain(model, int(model.geom_bodyid[self.hands[side][0]]))}
        self.trunk = np.array([g for g in self.body if int(model.geom_bodyid[g]) not in arm_bodies])
        groups = {side: self.world.scene.the_robot().arms[side].finger_groups for side in SIDES}
        self.groups = {side: [np.array([model.geom(name).id for name in group]) for group in groups[side]] for side in SIDES}
        self.feet = [int(model.site(f"{side}_sole").id) for side in SIDES]
        spec = self.world.scene.the_robot().foot
        self.half = np.array([spec.half_length_m, spec.half_width_m])
        self.last = self._positions()
        self.soles = self._soles()
        self.base = self.world.servos.base_pose.copy()
        self.grasped: dict[str, tuple[str, Array, int]] = {}

    def __call__(self, world: World, _text: str) -> None:
        found, data = self.found, self.world.data
        mujoco.mj_kinematics(world.model, data)
        found.ticks += 1
        now = self._positions()
        moved = {name: float(np.linalg.norm(now[name] - self.last[name])) for name in now}
        found.jumps += sum(way > _JUMP_M for way in moved.values())
        self._grasps(moved)
        self._feet()
        if found.ticks % _EVERY == 0:
            self._insides()
        self.last = now

    def _positions(self) -> dict[str, Array]:
        objects = self.world.objects.items()
        return {name: self.world.data.xpos[obj.body_id].copy() for name, obj in objects if obj.movable}

    def _soles(self) -> Array:
        """(2, 4, 3) corners of the soles."""
        data, corners = self.world.data, np.array([(a, b) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]) * self.half
        local = np.column_stack([corners, np.zeros(4)])
        return np.stack([data.site_xpos[s] + local @ data.site_xmat[s].reshape(3, 3).T for s in self.feet])

    def _grasps(self, moved: dict[str, float]) -> None:
        found, world = self.found, self.world
        model, data = world.model, world.data
        held = {side: world.grasps.held(side) for side in SIDES}
        for side in SIDES:
            name = held[side]
            if name is None or not world.objects[name].movable or world.objects[name].body_id != _tied(world, side):
                self.grasped.pop(side, None)
                continue
            hand = world.servos.grasp_pose(side)
            relative = np.linalg.inv(hand) @ world.poses.pose(name)
            if side not in self.grasped or self.grasped[side][0] != name:
                geoms = _solid(model, world, name)
                gaps = [_gap(model, data, group, geoms) for group in self.groups[side]]
                both = len(world.objects[name].held_by) == 2
                found.gaps_mm.append(_MM * (min(gaps) if both else max(gaps)))
                for values in (found.shift_mm, found.turn_deg, found.carried_m_s, found.fingers_mm):
                    values.append(0.0)
                self.grasped[side] = (name, relative, len(found.gaps_mm) - 1)
            _, made, index = self.grasped[side]
            error = np.linalg.inv(made) @ relative
            turn = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(error[:3, :3]) - 1.0), -1.0, 1.0))))
            found.shift_mm[index] = max(found.shift_mm[index], _MM * float(np.linalg.norm(error[:3, 3])))
            found.turn_deg[index] = max(found.turn_deg[index], turn)
            found.carried_m_s[index] = max(found.carried_m_s[index], moved[name] / _TICK_S)

    def _insides(self) -> None:
        found, world = self.found, self.world
        model, data = world.model, world.data
        held = {name for name, obj in world.objects.items() if obj.movable and obj.held_by}
        for name in held:
            geoms = _solid(model, world, name)
            found.inside_robot_mm = max(found.inside_robot_mm, -_MM * _gap(model, data, self.body, geoms))
            for side in world.objects[name].held_by:
                if side in self.grasped:
                    index = self.grasped[side][2]
                    depth = -_MM * _gap(model, data, self.hands[side], geoms)
                    found.fingers_mm[index] = max(found.fingers_mm[index], depth)
        for name in world.objects:
            if name not in held:
                depth = -_MM * _gap(model, data, self.trunk, _solid(model, world, name))
                found.inside_things_mm = max(found.inside_things_mm, depth)

    def _feet(self) -> None:
        soles, base, found = self._soles(), self.world.servos.base_pose.copy(), self.found
        way = float(np.linalg.norm(base[:2] - self.base[:2]))
        lows = soles[:, :, 2].min(axis=1)
        found.sunk_mm = max(found.sunk_mm, -_MM * float(lows.min()))
        if way / _TICK_S > _WALKS_M_S:
            lower = int(np.argmin(lows))
            slip = float(np.linalg.norm((soles[lower] - self.soles[lower]).mean(axis=0)[:2]))
            found.slip_m += slip
            found.slip_m_s.append(slip / _TICK_S)
            found.path_m += way
        self.soles, self.base = soles, base


def _has_geom(model: mujoco.MjModel, name: str) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name) >= 0


def _chain(model: mujoco.MjModel, body: int) -> list[int]:
    """A hand's body and the arm above it, as far as the body that both arms share."""
    chain = [body]
    while (parent := int(model.body_parentid[chain[-1]])) > 0 and _one_arm(model, parent):
        chain.append(parent)
    return chain


def _one_arm(model: mujoco.MjModel, body: int) -> bool:
    name = str(model.body(body).name)
    return "left" in name or "right" in name


def _tied(world: World, side: str) -> int | None:
    return world.grasps.constraints.held_body(side)


def _solid(model: mujoco.MjModel, world: World, name: str) -> NDArray[np.int64]:
    """Geoms that are drawn, switched-off colliders included."""
    geoms = np.asarray(world.objects[name].geom_ids)
    return geoms[model.geom_rgba[geoms, 3] > 0.0]


def _gap(model: mujoco.MjModel, data: mujoco.MjData, ours: NDArray[np.int64], theirs: NDArray[np.int64]) -> float:
    """Smallest signed distance between two sets of geoms, at most 5 cm."""
    best = 0.05
    reach = model.geom_rbound[ours][:, None] + model.geom_rbound[theirs][None]
    apart = np.linalg.norm(data.geom_xpos[ours][:, None] - data.geom_xpos[theirs][None], axis=-1)
    for i, j in np.argwhere(apart < reach + best):
        best = min(best, float(mujoco.mj_geomDistance(model, data, int(ours[i]), int(theirs[j]), best, None)))
    return best


def measure(task_id: str, robot: str, disturb: float = 0.0, seed: int = 0) -> Findings:
    """Replays a certified plan and measures."""
    task = next(task for task in load_benchmark() if task.id == task_id)
    (proof,) = [one for one in load_certificates() if (one.task, one.robot) == (task_id, robot)]
    found, rng = Findings(task_id, robot), np.random.default_rng(seed)
    session = Session(robot, "easy", image_size=0)
    session.reset(task, seed=task.seed)
    session.watchers.append(_Observer(session, found))
    for text in proof.plan:
        step = PlanStep.parse(text)
        if disturb:
            data = session.world.data
            data.qpos[:] += disturb * rng.standard_normal(len(data.qpos))
            data.qvel[:] += disturb * rng.standard_normal(len(data.qvel))
        held = {side: session.world.grasps.held(side) for side in SIDES}
        _, feedback = session.step(step)
        for outcome in feedback.outcomes:
            if not outcome.success:
                found.failed.append(f"{outcome.action.to_text()}: {outcome.code}")
            elif outcome.action.name in ("Place", "PlaceBoth"):
                name = held[outcome.action.arm.value if outcome.action.arm is not None else "left"]
                _set_down(session, found, str(name), str(outcome.action.object_id))
    found.solved = session.succeeded
    session.watchers.clear()
    session.world.advance(_LASTS_S)
    found.lasted = session.succeeded
    session.close()
    return found


def _set_down(session: Session, found: Findings, name: str, receptacle: str) -> None:
    """Whether a thing, two seconds after it was put down, is at rest on what it was put on, and by itself."""
    world = session.world
    with session.imagining():
        world.advance(_LASTS_S)
        robot, own = world.scene.robot_bodies, set(map(int, world.objects[name].geom_ids))
        pairs = [(int(c.geom1), int(c.geom2)) for c in world.data.contact[: world.data.ncon]]
        touched = any(int(world.model.geom_bodyid[b if a in own else a]) in robot for a, b in pairs if (a in own) != (b in own))
        tilt = 0.0 if world.objects[receptacle].walled else world.poses.tilt_deg(name)
        there = receptacle in world.containment.parents(name)
        found.set_downs += 1
        found.lasting += there and not touched and world.poses.speed_m_s(name) < 0.02 and tilt < 10.0
        found.tilts_deg.append(tilt)


def _one(job: tuple[str, str, float]) -> dict[str, Any]:
    return asdict(measure(*job))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per figure, one column per robot."""

    def each(name: str, robot: str) -> Array:
        values = [row[name] for row in rows if row["robot"] == robot]
        return np.array([x for value in values for x in (value if isinstance(value, list) else [value])], dtype=float)

    def of(values: Array, limit: float, digits: int = 1) -> str:
        if not len(values):
            return "none"
        beyond = f"{np.sum(values > limit)} of {len(values)}"
        return f"{np.max(values):.{digits}f} (95 %: {np.quantile(values, 0.95):.{digits}f}; {beyond})"

    lines = [
        "| largest (95 % quantile; above the limit) | " + " | ".join(PAPER_ROBOTS) + " |",
        "|---|" + "---|" * len(PAPER_ROBOTS),
    ]
    figures: list[tuple[str, Any]] = [
        ("plans; ticks of 20 ms", lambda r: f"{len(each('ticks', r))}; {int(each('ticks', r).sum())}"),
        ("plans with a failed step", lambda r: sum(bool(x["failed"]) for x in rows if x["robot"] == r)),
        (
            "goals hold at the end; two seconds later",
            lambda r: f"{int(each('solved', r).sum())}; {int(each('lasted', r).sum())}",
        ),
        ("set-downs; that last", lambda r: f"{int(each('set_downs', r).sum())}; {int(each('lasting', r).sum())}"),
        ("tilt of what was set down, degrees (10)", lambda r: of(each("tilts_deg", r), 10.0)),
        ("objects that jump 10 cm in a tick", lambda r: int(each("jumps", r).sum())),
        ("gap of the farther fingers at a grasp, mm (2)", lambda r: of(each("gaps_mm", r), 2.0)),
        ("shift in the hand, mm (5)", lambda r: of(each("shift_mm", r), 5.0)),
        ("turn in the hand, degrees (3)", lambda r: of(each("turn_deg", r), 3.0)),
        ("speed of what is carried, m/s (1.5)", lambda r: of(each("carried_m_s", r), 1.5, 2)),
        ("fingers inside what they hold, mm (3)", lambda r: of(each("fingers_mm", r), 3.0)),
        ("held things inside the robot, mm (3)", lambda r: of(each("inside_robot_mm", r), 3.0)),
        ("trunk and legs inside things, mm (3)", lambda r: of(each("inside_things_mm", r), 3.0)),
        (
            "slip of standing feet, share of the path",
            lambda r: f"{100 * each('slip_m', r).sum() / each('path_m', r).sum():.1f} %",
        ),
        ("their speed, 95 %, m/s", lambda r: f"{np.quantile(each('slip_m_s', r), 0.95):.2f}"),
        ("soles below the floor, mm (3)", lambda r: of(each("sunk_mm", r), 3.0)),
    ]
    lines += [f"| {name} | " + " | ".join(str(figure(robot)) for robot in PAPER_ROBOTS) + " |" for name, figure in figures]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Measures every n-th certified plan of both robots; prints the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plans", type=int, default=20, help="per robot")
    parser.add_argument("--family", default="", help="only tasks whose id contains this")
    parser.add_argument("--disturb", type=float, default=0.0, help="noise before every step: metres, radians and their rates")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="findings of every plan, JSON")
    options = parser.parse_args()
    jobs: list[tuple[str, str, float]] = []
    for robot in PAPER_ROBOTS:
        ids = [one.task for one in load_certificates() if one.robot == robot and options.family in one.task]
        jobs += [(name, robot, options.disturb) for name in ids[:: max(1, len(ids) // options.plans)][: options.plans]]
    with ProcessPoolExecutor(options.workers, multiprocessing.get_context("spawn")) as pool:
        rows = list(pool.map(_one, jobs))
    if options.out is not None:
        options.out.write_text(json.dumps(rows) + "\n", encoding="utf-8")
    sys.stdout.write(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
