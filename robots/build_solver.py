"""Which solver a robot uses: the paper's choice for H1 and X1, per-arm for any other robot with a fixed waist."""

from __future__ import annotations

from robots.arm_ik import PerArmSolver
from robots.crouch_table import CrouchTable
from robots.kinematics import RobotModel
from robots.solver import ArmSolver
from robots.spec import RobotSpec, load_robot
from robots.whole_body_ik import WholeBodySolver

_KITS: dict[tuple[str, str, str], RobotKit] = {}
SOLVERS = {"whole_body": WholeBodySolver, "per_arm": PerArmSolver}


class RobotKit:
    """A robot's kinematics, crouches and solver, built once per process."""

    def __init__(self, spec: RobotSpec) -> None:
        self.spec = spec
        self.model = RobotModel(spec)
        self.crouches = CrouchTable(self.model)
        self.solver: ArmSolver = SOLVERS[spec.solver](self.model, self.crouches)


def robot_kit(robot: str | RobotSpec) -> RobotKit:
    """The kit of a robot, by its description or by name or path (see `load_robot`); one per description and process."""
    spec = load_robot(robot) if isinstance(robot, str) else robot
    key = (spec.name, str(spec.mjcf_path), repr(spec))
    if key not in _KITS:
        _KITS[key] = RobotKit(spec)
    return _KITS[key]
