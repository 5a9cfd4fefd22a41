"""Leg joints for feet displaced from their neutral place under the pelvis: the kinematics behind the walking motion.

Each leg is a chain of joints from the pelvis to its sole. All poses of a way are solved at once by damped Gauss-Newton steps,
first every eighth of them, then all from what lies between; a sole is where it should be to a millimetre. Feet stay level as
far as the ankles allow. The paper's robots walk by the engine's animation; balance while walking is not simulated here either,
the base is driven.

Frame: pelvis heading frame. Shape letters: N poses, L leg joints, J joints of one leg.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from robots.build_solver import RobotKit

Array = NDArray[np.float64]
#: A sole rather tilts by a radian than to miss its place by this many metres: heels rise behind.
_LEVEL: Final = 0.1
_WEIGHTS: Final = np.array([1.0, 1.0, 1.0, _LEVEL, _LEVEL, 1.0])
_DAMPING: Final = 1e-4
#: Every which pose is solved from the crouch, in how many iterations, and iterations of all poses from those.
_COARSE, _FIRST, _THEN = 8, 10, 2
#: By how much a standing sole may miss its place.
_MISS_M: Final = 0.005
#: Reaches that are tried, as shares of the standing pelvis height, and what a foot steps at least where it has no reach.
_SHARES: Final = np.linspace(0.0, 0.22, 45)[1:]
_LEAST: Final = 0.04
#: Room that is left between two feet that come together.
_APART_M: Final = 0.01


class _Leg:
    """One leg's chain of joints.

    Args:
        kit: the robot.
        side: `left` or `right`.

    Attributes:
        mask: (L,) which leg joints are its own.
    """

    def __init__(self, kit: RobotKit, side: str) -> None:
        robot, spec = kit.model, kit.spec
        model = robot.model
        sole = model.frames[robot.frame_id(f"{side}_sole")]
        ids = [i for i in model.supports[sole.parentJoint] if model.names[i] in spec.leg_joints]
        self.order = [spec.leg_joints.index(model.names[i]) for i in ids]
        index = robot.indices(spec.leg_joints)[self.order]
        self.lower, self.upper = robot.lower[index], robot.upper[index]
        self._places = [model.jointPlacements[i] for i in ids]
        self._sole = sole.placement
        data = model.createData()
        pin.computeJointJacobians(model, data, pin.neutral(model))
        axes = [pin.getJointJacobian(model, data, i, pin.LOCAL)[3:, model.joints[i].idx_v] for i in ids]
        self._skew = [pin.skew(axis) for axis in axes]

    def solve(self, root: pin.SE3, start: Array, goals: Array, yaws: Array, iterations: int) -> Array:
        """(N, J) joints that put the sole at places, from `start` (N, J).

        Args:
            root: the pelvis in its heading frame.
            start: where to start from.
            goals: (N, 3) places of the sole, metres.
            yaws: (N,) headings of the sole, rad.
            iterations: Gauss-Newton steps.
        """
        q = np.clip(start, self.lower, self.upper)
        for _ in range(iterations):
            rotation, sole, jacobian = self._forward(root, q)
            jacobian *= _WEIGHTS[:, None]
            error = _WEIGHTS * np.concatenate([goals - sole, _turn_to(rotation, yaws)], axis=1)  # (N, 6)
            square = jacobian @ jacobian.transpose(0, 2, 1) + _DAMPING * np.eye(6)
            step = jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, error[:, :, None])
            q = np.clip(q + np.clip(step[:, :, 0], -0.3, 0.3), self.lower, self.upper)
        return q

    def sole(self, root: pin.SE3, q: Array) -> Array:
        """(N, 3) places of the sole for joints (N, J)."""
        return self._forward(root, q)[1]

    def _forward(self, root: pin.SE3, q: Array) -> tuple[Array, Array, Array]:
        """Rotation (N, 3, 3) and place (N, 3) of the sole, and the Jacobian (N, 6, J) of place and turn."""
        turn, place = np.broadcast_to(root.rotation, (len(q), 3, 3)), np.broadcast_to(root.translation, (len(q), 3))
        axes, centres = [], []
        for k, (joint, skew) in enumerate(zip(self._places, self._skew, strict=True)):
            place = place + turn @ joint.translation
            turn = turn @ joint.rotation
            centres.append(place)
            axes.append(turn @ np.array([skew[2, 1], skew[0, 2], skew[1, 0]]))
            angle = q[:, k, None, None]
            turn = turn @ (np.eye(3) + np.sin(angle) * skew + (1.0 - np.cos(angle)) * (skew @ skew))
        sole = place + turn @ self._sole.translation
        spins = np.stack(axes, axis=2)  # (N, 3, J)
        arms = sole[:, :, None] - np.stack(centres, axis=2)
        return turn @ self._sole.rotation, sole, np.concatenate([np.cross(spins, arms, axis=1), spins], axis=1)


class Footsteps:
    """Leg joints for displaced feet.

    Args:
        kit: the robot.
    """

    def __init__(self, kit: RobotKit) -> None:
        self._kit = kit
        self._legs = tuple(_Leg(kit, side) for side in ("left", "right"))
        self._reaches = lru_cache(maxsize=64)(self._reach_at)

    def reach_m(self, pelvis_height_m: float) -> tuple[float, float]:
        """How far both soles can be ahead and back, and to either side, of their neutral place on the floor."""
        return self._reaches(round(pelvis_height_m, 3))

    def _reach_at(self, pelvis_height_m: float) -> tuple[float, float]:
        shares = _SHARES * self._kit.spec.standing_pelvis_height_m
        neutral = self._neutral(pelvis_height_m)
        found = []
        for axis in range(2):
            feet = np.zeros((2 * len(shares), 2, 4))
            feet[:, :, axis] = np.concatenate([shares, -shares])[:, None]
            legs = self.joints(pelvis_height_m, feet)
            missed = [
                np.linalg.norm(leg.sole(self._root(pelvis_height_m), legs[:, leg.order]) - sole - feet[:, k, :3], axis=1)
                for k, (leg, sole) in enumerate(zip(self._legs, neutral, strict=True))
            ]
            within = np.all(np.max(missed, axis=0).reshape(2, -1) < _MISS_M, axis=0)
            found.append(shares[int(np.argmin(within)) - 1] if within[0] and not within.all() else shares[-1] * within[0])
        apart = float(neutral[0, 1] - neutral[1, 1]) - 2.0 * self._kit.spec.foot.half_width_m - _APART_M
        least = _LEAST * self._kit.spec.standing_pelvis_height_m
        return max(float(found[0]), least), max(min(float(found[1]), 0.5 * apart), least)

    def joints(self, pelvis_height_m: float, feet: Array) -> Array:
        """(N, L) leg joints for displaced feet of one motion: successive poses are close to each other.

        Args:
            pelvis_height_m: pelvis above the floor.
            feet: (N, 2, 4) displacement of the left and the right sole: ahead, to the left, up (metres) and turn (rad).
        """
        crouch, root = self._kit.crouches.legs(pelvis_height_m), self._root(pelvis_height_m)
        legs = np.repeat(crouch[None], len(feet), axis=0)
        some = np.unique(np.r_[0 : len(feet) : _COARSE, len(feet) - 1])
        for leg, sole, shift in zip(self._legs, self._neutral(pelvis_height_m), feet.transpose(1, 0, 2), strict=True):
            goals, yaws = sole + shift[:, :3], shift[:, 3]
            q = leg.solve(root, legs[some][:, leg.order], goals[some], yaws[some], _FIRST)
            q = np.stack([np.interp(np.arange(len(feet)), some, column) for column in q.T], axis=1)
            legs[:, leg.order] = leg.solve(root, q, goals, yaws, _THEN)
        return legs

    def _root(self, pelvis_height_m: float) -> pin.SE3:
        lean = pin.utils.rotate("y", self._kit.crouches.pitch(pelvis_height_m))
        return pin.SE3(lean, np.array([0.0, 0.0, pelvis_height_m]))

    def _neutral(self, pelvis_height_m: float) -> Array:
        """(2, 3) places of the soles of the standing robot."""
        root, crouch = self._root(pelvis_height_m), self._kit.crouches.legs(pelvis_height_m)
        return np.concatenate([leg.sole(root, crouch[None, leg.order]) for leg in self._legs])


def _turn_to(rotations: Array, yaws: Array) -> Array:
    """(N, 3) turns from rotations (N, 3, 3) to level ones with headings (N,), by the sine of their angle."""
    c, s, zero = np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)
    level = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]]).transpose(2, 0, 1)
    turn = level @ rotations.transpose(0, 2, 1)
    return 0.5 * np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1)


@lru_cache(maxsize=4)
def footsteps(kit: RobotKit) -> Footsteps:
    """The footsteps of a robot."""
    return Footsteps(kit)
