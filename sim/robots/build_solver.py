"""Which solver a robot uses: the paper's choice for H1 and X1, per-arm for any other robot with a fixed waist."""

from __future__ import annotations

from functools import lru_cache

from sim.robots.arm_ik import PerArmSolver
from sim.robots.crouch_table import CrouchTable
from sim.robots.kinematics import RobotModel
from sim.robots.solver import ArmSolver
from sim.robots.spec import RobotSpec, load_robot
from sim.robots.whole_body_ik import WholeBodySolver

__all__ = ["SOLVERS", "RobotKit", "robot_kit"]

SOLVERS = {"whole_body": WholeBodySolver, "per_arm": PerArmSolver}


class RobotKit:
    """A robot's kinematics, crouches and solver, built once per process."""

    def __init__(self, spec: RobotSpec) -> None:
        self.spec = spec
        self.model = RobotModel(spec)
        self.crouches = CrouchTable(self.model)
        self.solver: ArmSolver = SOLVERS[spec.solver](self.model, self.crouches)


@lru_cache(maxsize=8)
def robot_kit(name: str) -> RobotKit:
    """The kit of a robot by name or path (see `load_robot`)."""
    return RobotKit(load_robot(name))
