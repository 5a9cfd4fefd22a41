"""Differential inverse kinematics on pin-pink, iterated to convergence, shared by the two arm solvers.

Each iteration solves Pink's quadratic program: minimise the weighted task errors subject to joint position and velocity limits
and to the rows that keep the robot out of itself (`self_collision`),
    min_v  sum_i || J_i v dt + alpha e_i ||^2_{W_i} + lambda || v ||^2  s.t.  q_min <= q + v dt <= q_max, |v| <= v_max, C v <= c
with frame tasks for the grasp sites, a posture task that keeps redundant joints near their start, and, for whole-body solves, a
centre-of-mass task. Legs and lean are those of the crouch at the given pelvis height. Thousands of solves precede a grasp, so
tasks and limits are Pink's classes with what is constant kept, and DAQP is called directly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import c_int
from dataclasses import dataclass

import daqp
import numpy as np
import pink
import pinocchio as pin
import qpsolvers
from numpy.typing import NDArray
from pink.limits import ConfigurationLimit, Limit, VelocityLimit
from pink.tasks import ComTask, FrameTask, PostureTask, Task

from robots.crouch_table import CrouchTable
from robots.kinematics import RobotModel, root_quaternion
from robots.self_collision import SELF_TOUCH_M, SelfLimit
from robots.solver import IkResult, ReachTarget

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
#: Heights whose reduced models are kept.
_CACHED = 256
#: What the solver takes for minus infinity.
_UNBOUNDED = -1e30
_NO_ROWS = np.zeros((0, 64))
_NO_BOUNDS = np.zeros(0)


class _JointLimits:
    """Pink's limits of joint positions and velocities, as one interval per joint: the solver takes those as such."""

    def __init__(self, model: pin.Model) -> None:
        position, velocity = ConfigurationLimit(model), VelocityLimit(model)
        if len(position.indices) != model.nv or len(velocity.indices) != model.nv:
            raise ValueError("a robot whose movable joints have no limits cannot be solved for")
        self._model = model
        self._gain = position.config_limit_gain
        self._step: Array = _DT_S * velocity.velocity_limit

    def interval(self, q: Array) -> tuple[Array, Array]:
        """(N,) least and largest change of each joint in one iteration from the positions `q`."""
        down = self._gain * pin.difference(self._model, q, self._model.lowerPositionLimit)
        up = self._gain * pin.difference(self._model, q, self._model.upperPositionLimit)
        return np.maximum(down, -self._step), np.minimum(up, self._step)


class _HandTask(FrameTask):
    """Pink's frame task with its frame looked up once and its error computed once per configuration: the same numbers."""

    def __init__(self, frame: str, frame_id: int, cost: Array, target: pin.SE3) -> None:
        super().__init__(frame, position_cost=1.0, orientation_cost=0.0, lm_damping=_LM_DAMPING)
        self.cost = self._cost = cost
        self.set_target(target)
        self._id, self._goal = frame_id, target
        self._at: Array | None = None
        self._error: Array = np.zeros(6)

    def compute_error(self, configuration: pink.Configuration) -> Array:
        """See `pink.tasks.FrameTask`. A configuration that moves on has another array of positions."""
        if self._at is not configuration.q:
            self._at = configuration.q
            self._error = pin.log(configuration.data.oMf[self._id].actInv(self._goal)).vector
        return self._error

    def compute_qp_objective(self, configuration: pink.Configuration) -> tuple[Array, Array]:
        """See `pink.tasks.Task`."""
        inward = self._goal.actInv(configuration.data.oMf[self._id])
        local = pin.getFrameJacobian(configuration.model, configuration.data, self._id, pin.ReferenceFrame.LOCAL)
        jacobian = self._cost[:, None] * (-pin.Jlog6(inward) @ local)
        weighted = self._cost * -self.compute_error(configuration)
        damping = self.lm_damping * weighted @ weighted
        return jacobian.T @ jacobian + damping * configuration.tangent.eye, -weighted.T @ jacobian


class _RestTask(PostureTask):
    """Pink's posture task for joints that turn or slide: its Hessian does not change."""

    def __init__(self, cost: Array, target: Array) -> None:
        super().__init__(cost=_POSTURE_COST)
        self.cost = self._cost = cost
        self.set_target(target)
        self._target, self._hessian = target.copy(), np.diag(cost * cost)

    def compute_qp_objective(self, configuration: pink.Configuration) -> tuple[Array, Array]:
        """See `pink.tasks.Task`."""
        weighted = self._cost * -pin.difference(configuration.model, self._target, configuration.q)
        return self._hessian, -(weighted * self._cost)


@dataclass(frozen=True, slots=True)
class _Reduced:
    """The movable joints' own model at one pelvis height.

    Attributes:
        model, data: Pinocchio's.
        order: (movable,) where each movable joint is in the model's configuration.
        limits: of the model.
        own: what keeps the robot out of itself.
    """

    model: pin.Model
    data: pin.Data
    order: NDArray[np.int64]
    limits: _JointLimits
    own: SelfLimit


@dataclass(frozen=True, slots=True)
class _Found:
    """Where a start led to.

    Attributes:
        error_m, angle_rad: largest errors of position and pointing over the targeted arms.
        clearance_m: distance of the robot to itself, negative inside.
        posture: (movable,) joints.
    """

    error_m: float
    angle_rad: float
    clearance_m: float
    posture: Array

    def reached(self, tolerance_m: float) -> bool:
        """Whether the position is, without running into the robot itself."""
        return self.error_m <= tolerance_m and self.clearance_m >= -SELF_TOUCH_M

    @property
    def cost_m(self) -> float:
        """What makes one outcome worse than another."""
        return self.error_m + 0.002 * self.angle_rad + max(0.0, -SELF_TOUCH_M - self.clearance_m)


class PinkCore:
    """Solves for the grasp sites of the given arms with the given movable joints."""

    def __init__(
        self, robot: RobotModel, crouches: CrouchTable, movable: Sequence[str], balance: bool, avoid_self: bool = True
    ) -> None:
        self.robot = robot
        self._crouches = crouches
        self._movable = robot.indices(tuple(movable))
        self._balance = balance
        model = robot.model
        locked = [model.getJointId(name) for name in model.names[2:] if name not in set(movable)]
        self._full_names = list(movable)
        self._locked = locked
        self._reduced: dict[float, _Reduced] = {}
        low, high = robot.lower[self._movable], robot.upper[self._movable]
        centre = robot.arm_posture(robot.posture(), "carry")[self._movable]
        spread = np.random.default_rng(0).uniform(-1.6, 1.6, (_BANK_SIZE, len(low)))
        self._bank: Array = np.clip(centre + spread, low + 1e-3, high - 1e-3)  # (B, movable) postures to restart from
        self._owner = np.array([self._arm_of(name) for name in self._full_names])
        self._arms = sorted(set(self._owner) - {""})
        self._avoid_self = avoid_self

    def _model_at(self, pelvis_height_m: float) -> _Reduced:
        """Reduced model with the root and all other joints locked at the crouch.

        The cache asks for the very same height: what is solved must not depend on what was solved before.
        """
        height = self._crouches.clamp(pelvis_height_m)
        if height not in self._reduced:
            root = np.array([0.0, 0.0, 0.0, *root_quaternion(0.0, self._crouches.pitch(height))])
            reference = self.robot.configuration(root, self._crouches.posture(height))
            root_id = 1
            geometry = self.robot.own_body.geometry
            reduced, solids = pin.buildReducedModel(self.robot.model, geometry, [root_id, *self._locked], reference)
            self.robot.own_body.leave_pairs(solids, self._arms)
            reduced.velocityLimit = np.full(reduced.nv, _STEP_RAD / _DT_S)
            order = np.array([reduced.joints[reduced.getJointId(name)].idx_q for name in self._full_names])
            if len(self._reduced) >= _CACHED:
                self._reduced.clear()
            data = reduced.createData()
            self._reduced[height] = _Reduced(reduced, data, order, _JointLimits(reduced), SelfLimit(reduced, data, solids))
        return self._reduced[height]

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
        reduced = self._model_at(pelvis_height_m)
        q = np.asarray(q, dtype=float)
        lower, upper = self.robot.lower[self._movable], self.robot.upper[self._movable]
        warm = np.clip(q[self._movable], lower + 1e-4, upper - 1e-4)
        if dq is not None:  # start where the arm will be after one control period
            warm = np.clip(warm + 0.02 * np.asarray(dq)[self._movable], lower + 1e-4, upper - 1e-4)
        self._pose_others(reduced, q, pelvis_height_m)
        ranked: dict[str, NDArray[np.int64]] | None = None
        best: _Found | None = None
        iterations = 0
        for attempt in range(restarts + 1):
            if attempt >= 2 and ranked is None:
                ranked = self._rank_bank(reduced, targets)
            start = warm if attempt == 0 else self._restart(warm, lower, upper, ranked, attempt)
            found, used = self._attempt(reduced, targets, start, tolerance_m, oriented_first=attempt == 0)
            iterations += used
            if best is None or (found.reached(tolerance_m), -found.cost_m) > (best.reached(tolerance_m), -best.cost_m):
                best = found
            if best.reached(tolerance_m) and (best.angle_rad < 0.9 or attempt >= 1):
                break
        if best is None:
            raise AssertionError("at least one attempt is made")
        out = self._crouches.apply(q, pelvis_height_m)
        out[self._movable] = best.posture
        margin = self._crouches.balance_margin(out, pelvis_height_m)
        success = best.reached(tolerance_m) and margin > 0.0
        return IkResult(out, success, best.error_m, best.angle_rad, margin, iterations, best.clearance_m)

    def _pose_others(self, reduced: _Reduced, q: Array, pelvis_height_m: float) -> None:
        """An arm that does not move here is where `q` has it, not where the reduced model was locked."""
        if len(self._arms) == len(self.robot.spec.arms):
            return
        height = self._crouches.clamp(pelvis_height_m)
        posture = self._crouches.posture(height)
        for arm, spec in self.robot.spec.arms.items():
            if arm not in self._arms:
                columns = self.robot.indices(spec.joints)
                posture[columns] = q[columns]
        root = np.array([0.0, 0.0, 0.0, *root_quaternion(0.0, self._crouches.pitch(height))])
        self.robot.own_body.pose_others(reduced.own.geometry, root, posture, self._arms)
        reduced.own.forget()

    def _arm_of(self, joint: str) -> str:
        return next((arm for arm, spec in self.robot.spec.arms.items() if joint in spec.joints), "")

    def _rank_bank(self, reduced: _Reduced, targets: Mapping[str, ReachTarget]) -> dict[str, NDArray[np.int64]]:
        """Per targeted arm, the bank's postures from the nearest grasp site to the farthest."""
        model, data, order = reduced.model, reduced.data, reduced.order
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
        reduced: _Reduced,
        targets: Mapping[str, ReachTarget],
        start: Array,
        tolerance_m: float,
        *,
        oriented_first: bool,
    ) -> tuple[_Found, int]:
        """One start. Position goes before orientation: where both cannot be had, the hand turns as far as it must.

        The warm start relaxes the orientation until the position is reached; a restart first finds the position, then the
        best orientation that keeps it, so that a target out of reach is given up early.
        """
        oriented = any(target.rotation is not None for target in targets.values())
        ladder = (1.0,) if not oriented else _RELAXATIONS if oriented_first else _RELAXATIONS[::-1]
        found, iterations = self._descend(reduced, targets, start, tolerance_m, ladder[0])
        for relaxation in ladder[1:]:
            if found.reached(tolerance_m) == oriented_first:
                break
            following, used = self._descend(reduced, targets, found.posture, tolerance_m, relaxation)
            iterations += used
            if not oriented_first and not following.reached(tolerance_m):
                break
            found = following
        return found, iterations

    def _descend(
        self,
        reduced: _Reduced,
        targets: Mapping[str, ReachTarget],
        start: Array,
        tolerance_m: float,
        relaxation: float,
    ) -> tuple[_Found, int]:
        model, order = reduced.model, reduced.order
        full = pin.neutral(model)
        full[order] = start
        configuration = pink.Configuration(model, reduced.data, full, copy_data=False)
        hands: list[tuple[_HandTask, ReachTarget]] = []
        for arm, target in targets.items():
            pointing = relaxation * target.pointing_weight if target.rotation is not None else 0.0
            roll = relaxation * target.roll_weight if target.rotation is not None else 0.0
            rotation = np.eye(3) if target.rotation is None else target.rotation
            site = self.robot.spec.arms[arm].grasp_site
            task = _HandTask(
                site,
                model.getFrameId(site),
                np.array([1.0, 1.0, 1.0, roll * 0.3 + 1e-6, pointing * 0.3 + 1e-6, pointing * 0.3 + 1e-6]),
                pin.SE3(np.asarray(rotation, dtype=float), np.asarray(target.position, dtype=float)),
            )
            hands.append((task, target))
        cost = np.full(model.nv, _POSTURE_COST)
        for column, owner in zip(order, self._owner, strict=True):  # revolute joints: positions and velocities share indices
            if owner not in targets:
                cost[column] = _IDLE_COST
        tasks: list[Task] = [*(task for task, _ in hands), _RestTask(cost, full)]
        if self._balance:
            com = ComTask(cost=0.05)
            com.set_target_from_configuration(configuration)
            tasks.append(com)
        limits: list[Limit] = [reduced.own] if self._avoid_self else []
        previous, error = np.inf, np.inf
        before, clearance = -np.inf, -np.inf
        step = 0
        while step < _MAX_ITERATIONS:
            step += 1
            problem = pink.build_ik(configuration, tasks, _DT_S, damping=1e-8, limits=limits)
            low, high = reduced.limits.interval(configuration.q)
            velocity = _solved(problem, low, high) / _DT_S
            configuration.integrate_inplace(velocity, _DT_S)
            error = max(float(np.linalg.norm(task.compute_error(configuration)[:3])) for task, _ in hands)
            if error < 0.1 * tolerance_m or abs(previous - error) < max(_STALL_M, _STALL_FRACTION * error):
                clearance = reduced.own.clearance_m(configuration)
                leaving = clearance < -SELF_TOUCH_M and clearance > before + _STALL_M
                if not (self._avoid_self and leaving):
                    break
                before = clearance
            previous = error
        angle = 0.0
        for task, target in hands:
            if target.rotation is not None and target.pointing_weight > 0.0:
                reached = configuration.get_transform_frame_to_world(task.frame).rotation[:, 0]
                angle = max(angle, float(np.arccos(np.clip(reached @ np.asarray(target.rotation)[:, 0], -1.0, 1.0))))
        clearance = reduced.own.clearance_m(configuration)
        return _Found(error, angle, clearance, np.asarray(configuration.q)[order].copy()), step


def _solved(problem: qpsolvers.Problem, low: Array, high: Array) -> Array:
    """(N,) minimum of Pink's quadratic program between `low` and `high` (N,).

    Bounds of rows below zero, which drive overlapping shapes apart, are given up where they contradict the others.
    The solver is asked directly: the checks and copies around it in `pink.solve_ik` took as long as the solution.
    """
    rows = _NO_ROWS[:, : len(low)] if problem.G is None else np.asarray(problem.G)
    bounds = _NO_BOUNDS if problem.h is None else np.asarray(problem.h)
    below, kind = np.full(len(bounds), _UNBOUNDED), np.zeros(len(low) + len(bounds), dtype=c_int)
    lower = np.concatenate([low, below])
    x, _, flag, _ = daqp.solve(problem.P, problem.q, rows, np.concatenate([high, bounds]), lower, kind)
    if flag <= 0:
        upper = np.concatenate([high, np.maximum(bounds, 0.0)])
        x, _, flag, _ = daqp.solve(problem.P, problem.q, rows, upper, lower, kind)
    if flag <= 0:
        raise ArithmeticError(f"inverse kinematics: the quadratic program has no solution (exit flag {flag})")
    return x
