"""Differential inverse kinematics on pin-pink, iterated to convergence, shared by the two arm solvers.

Each iteration solves Pink's quadratic program: minimise the weighted task errors subject to joint position and velocity limits,
    min_v  sum_i || J_i v dt + alpha e_i ||^2_{W_i} + lambda || v ||^2    s.t.  q_min <= q + v dt <= q_max,  |v| <= v_max
with frame tasks for the grasp sites, a posture task that keeps redundant joints near their start, and, for whole-body solves, a
centre-of-mass task. Legs and lean are those of the crouch at the given pelvis height.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pink
import pinocchio as pin
from numpy.typing import NDArray
from pink.limits import ConfigurationLimit, VelocityLimit
from pink.tasks import ComTask, FrameTask, PostureTask

from sim.robots.crouch_table import CrouchTable
from sim.robots.kinematics import RobotModel, root_quaternion
from sim.robots.solver import IkResult, ReachTarget

__all__ = ["PinkCore"]

Array = NDArray[np.float64]
_DT_S = 0.1
#: Largest change of a joint in one iteration, and Levenberg-Marquardt damping: both keep far targets from oscillating.
_STEP_RAD = 0.6
_LM_DAMPING = 0.1
#: Posture costs per radian of the joints of targeted arms, and of waist and idle arm, which move only when it pays.
_POSTURE_COST = 3e-3
_IDLE_COST = 3e-2
_MAX_ITERATIONS = 40
_STALL_M = 2e-5
_STALL_FRACTION = 4e-3
#: Orientation weights are scaled by these in turn while the position is not reached: a hand may turn in order to reach.
_RELAXATIONS = (1.0, 0.1, 0.0)
_BANK_SIZE = 160


class PinkCore:
    """Solves for the grasp sites of the given arms with the given movable joints."""

    def __init__(self, robot: RobotModel, crouches: CrouchTable, movable: Sequence[str], balance: bool) -> None:
        self.robot = robot
        self._crouches = crouches
        self._movable = robot.indices(tuple(movable))
        self._balance = balance
        model = robot.model
        locked = [model.getJointId(name) for name in model.names[2:] if name not in set(movable)]
        self._full_names = list(movable)
        self._locked = locked
        self._reduced: dict[int, tuple[pin.Model, pin.Data, NDArray[np.int64]]] = {}
        low, high = robot.lower[self._movable], robot.upper[self._movable]
        centre = robot.arm_posture(robot.posture(), "carry")[self._movable]
        spread = np.random.default_rng(0).uniform(-1.6, 1.6, (_BANK_SIZE, len(low)))
        self._bank: Array = np.clip(centre + spread, low + 1e-3, high - 1e-3)  # (B, movable) postures to restart from
        self._owner = np.array([self._arm_of(name) for name in self._full_names])

    def _model_at(self, pelvis_height_m: float) -> tuple[pin.Model, pin.Data, NDArray[np.int64], float]:
        """Reduced model with the root and all other joints locked at the crouch; cached by height."""
        crouch = self._crouches.at(pelvis_height_m)
        key = round(pelvis_height_m * 1e6)
        if key not in self._reduced:
            root = np.array([0.0, 0.0, 0.0, *root_quaternion(0.0, crouch.pelvis_pitch_rad)])
            reference = self.robot.configuration(root, crouch.q)
            root_id = 1
            reduced = pin.buildReducedModel(self.robot.model, [root_id, *self._locked], reference)
            reduced.velocityLimit = np.full(reduced.nv, _STEP_RAD / _DT_S)
            order = np.array([reduced.joints[reduced.getJointId(name)].idx_q for name in self._full_names])
            if len(self._reduced) > 256:
                self._reduced.clear()
            self._reduced[key] = (reduced, reduced.createData(), order)
        model, data, order = self._reduced[key]
        return model, data, order, crouch.pelvis_pitch_rad

    def solve(
        self,
        targets: Mapping[str, ReachTarget],
        q: Array,
        dq: Array | None,
        pelvis_height_m: float,
        tolerance_m: float,
        restarts: int,
    ) -> IkResult:
        """See `ArmSolver.solve`."""
        unknown = sorted(set(targets) - set(self.robot.spec.arms))
        if unknown or not targets:
            raise ValueError(f"targets for arms {unknown or 'none'}; allowed: left, right")
        model, data, order, _ = self._model_at(pelvis_height_m)
        q = np.asarray(q, dtype=float)
        lower, upper = self.robot.lower[self._movable], self.robot.upper[self._movable]
        warm = np.clip(q[self._movable], lower + 1e-4, upper - 1e-4)
        if dq is not None:  # start where the arm will be after one control period
            warm = np.clip(warm + 0.02 * np.asarray(dq)[self._movable], lower + 1e-4, upper - 1e-4)
        ranked: dict[str, NDArray[np.int64]] | None = None
        best: tuple[float, float, float, Array] | None = None
        iterations = 0
        for attempt in range(restarts + 1):
            if attempt >= 2 and ranked is None:
                ranked = self._rank_bank(model, data, order, targets)
            start = warm if attempt == 0 else self._restart(warm, lower, upper, ranked, attempt)
            found, used = self._attempt(model, data, order, targets, start, tolerance_m, oriented_first=attempt == 0)
            iterations += used
            error, angle, posture = found
            cost = max(error, 0.0) + 0.002 * angle
            if best is None or (error <= tolerance_m, -cost) > (best[0] <= tolerance_m, -best[2]):
                best = (error, angle, cost, posture)
            if best[0] <= tolerance_m and (best[1] < 0.9 or attempt >= 1):
                break
        if best is None:
            raise AssertionError("at least one attempt is made")
        out = self._crouches.apply(q, pelvis_height_m)
        out[self._movable] = best[3]
        margin = self._crouches.balance_margin(out, pelvis_height_m)
        return IkResult(out, best[0] <= tolerance_m and margin > 0.0, best[0], best[1], margin, iterations)

    def _arm_of(self, joint: str) -> str:
        return next((arm for arm, spec in self.robot.spec.arms.items() if joint in spec.joints), "")

    def _rank_bank(
        self, model: pin.Model, data: pin.Data, order: NDArray[np.int64], targets: Mapping[str, ReachTarget]
    ) -> dict[str, NDArray[np.int64]]:
        """Per targeted arm, the bank's postures from the nearest grasp site to the farthest."""
        full = pin.neutral(model)
        frames = {arm: model.getFrameId(self.robot.spec.arms[arm].grasp_site) for arm in targets}
        distance = {arm: np.zeros(len(self._bank)) for arm in targets}
        for row, posture in enumerate(self._bank):
            full[order] = posture
            pin.framesForwardKinematics(model, data, full)
            for arm, target in targets.items():
                pose = data.oMf[frames[arm]]
                cost = float(np.linalg.norm(pose.translation - target.position))
                if target.rotation is not None:
                    cost += 0.1 * target.pointing_weight * (1.0 - float(pose.rotation[:, 0] @ target.rotation[:, 0]))
                distance[arm][row] = cost
        return {arm: np.argsort(values) for arm, values in distance.items()}

    def _restart(
        self, warm: Array, lower: Array, upper: Array, ranked: dict[str, NDArray[np.int64]] | None, attempt: int
    ) -> Array:
        """First the carry posture, then for each targeted arm the nearest postures of the bank."""
        if ranked is None:
            base = self.robot.arm_posture(self.robot.posture(), "carry")[self._movable]
            return np.clip(base, lower + 1e-3, upper - 1e-3)
        start = warm.copy()
        for arm, rows in ranked.items():
            own = self._owner == arm
            start[own] = self._bank[rows[attempt - 2], own]
        return start

    def _attempt(
        self,
        model: pin.Model,
        data: pin.Data,
        order: NDArray[np.int64],
        targets: Mapping[str, ReachTarget],
        start: Array,
        tolerance_m: float,
        *,
        oriented_first: bool,
    ) -> tuple[tuple[float, float, Array], int]:
        """One start. Position goes before orientation: where both cannot be had, the hand turns as far as it must.

        The warm start relaxes the orientation until the position is reached; a restart first finds the position, then the
        best orientation that keeps it, so that a target out of reach is given up early.
        """
        oriented = any(target.rotation is not None for target in targets.values())
        ladder = (1.0,) if not oriented else _RELAXATIONS if oriented_first else _RELAXATIONS[::-1]
        found, iterations = self._descend(model, data, order, targets, start, tolerance_m, ladder[0])
        for relaxation in ladder[1:]:
            reached = found[0] <= tolerance_m
            if reached == oriented_first:
                break
            following, used = self._descend(model, data, order, targets, found[2], tolerance_m, relaxation)
            iterations += used
            if not oriented_first and following[0] > tolerance_m:
                break
            found = following
        return found, iterations

    def _descend(
        self,
        model: pin.Model,
        data: pin.Data,
        order: NDArray[np.int64],
        targets: Mapping[str, ReachTarget],
        start: Array,
        tolerance_m: float,
        relaxation: float,
    ) -> tuple[tuple[float, float, Array], int]:
        full = pin.neutral(model)
        full[order] = start
        configuration = pink.Configuration(model, data, full, copy_data=False)
        tasks: list[FrameTask | PostureTask | ComTask] = []
        frame_tasks: list[tuple[FrameTask, ReachTarget]] = []
        for arm, target in targets.items():
            pointing = relaxation * target.pointing_weight if target.rotation is not None else 0.0
            roll = relaxation * target.roll_weight if target.rotation is not None else 0.0
            task = FrameTask(
                self.robot.spec.arms[arm].grasp_site,
                position_cost=1.0,
                orientation_cost=[roll * 0.3 + 1e-6, pointing * 0.3 + 1e-6, pointing * 0.3 + 1e-6],
                lm_damping=_LM_DAMPING,
            )
            rotation = np.eye(3) if target.rotation is None else target.rotation
            task.set_target(pin.SE3(np.asarray(rotation, dtype=float), np.asarray(target.position, dtype=float)))
            tasks.append(task)
            frame_tasks.append((task, target))
        posture = PostureTask(cost=_POSTURE_COST)
        cost = np.full(model.nv, _POSTURE_COST)
        for column, owner in zip(order, self._owner, strict=True):  # revolute joints: positions and velocities share indices
            if owner not in targets:
                cost[column] = _IDLE_COST
        posture.cost = cost
        posture.set_target(full)
        tasks.append(posture)
        if self._balance:
            com = ComTask(cost=0.05)
            com.set_target_from_configuration(configuration)
            tasks.append(com)
        limits = [ConfigurationLimit(model), VelocityLimit(model)]
        previous, error = np.inf, np.inf
        step = 0
        while step < _MAX_ITERATIONS:
            step += 1
            velocity = pink.solve_ik(
                configuration, tasks, _DT_S, solver="daqp", damping=1e-8, limits=limits, safety_break=False
            )
            configuration.integrate_inplace(velocity, _DT_S)
            error = max(float(np.linalg.norm(task.compute_error(configuration)[:3])) for task, _ in frame_tasks)
            if error < 0.1 * tolerance_m or abs(previous - error) < max(_STALL_M, _STALL_FRACTION * error):
                break
            previous = error
        angle = 0.0
        for task, target in frame_tasks:
            if target.rotation is not None and target.pointing_weight > 0.0:
                reached = configuration.get_transform_frame_to_world(task.frame).rotation[:, 0]
                angle = max(angle, float(np.arccos(np.clip(reached @ np.asarray(target.rotation)[:, 0], -1.0, 1.0))))
        return (error, angle, np.asarray(configuration.q)[order].copy()), step
