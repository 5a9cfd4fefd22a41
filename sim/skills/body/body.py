"""The robot as skills see it: a composition of parts, each the owner of one kind of fact.

Skills own disjoint sets of joints: an arm skill its arm and hand, a body skill base and legs, a two-arm skill both arms and the
waist. What is commanded is in the simulator's controls and what is held in the objects, so a world snapshot is a snapshot of
the robot too: the parts keep indices and caches alone.
"""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass, field
from typing import Any

from interface.bodies import Arm
from interface.steps import Action
from robots.build_solver import robot_kit
from sim.scene.objects import ObjectInstance
from sim.skills.body.arms import Arms
from sim.skills.body.base import Base
from sim.skills.body.clearance import ClearanceProbe
from sim.skills.body.contacts import Contacts
from sim.skills.body.hands import Hands
from sim.skills.body.hypothesis import Hypothesis
from sim.skills.body.ik import InverseKinematics
from sim.skills.body.joints import JointMap
from sim.skills.body.objects import ObjectGeometry
from sim.skills.body.posture import Posture
from sim.skills.body.workspace import Workspace
from sim.skills.navigation import Stance
from sim.world.world import World


@dataclass(slots=True)
class Plans:
    """Plans of actions from one state, see `sim.skills.plan_cache`."""

    state: object = None
    made: dict[Action, Any] = field(default_factory=dict)


class Body:
    """One robot in a world.

    Attributes:
        world, spec, kit: where it is, and which robot.
        posture: commanded or assumed stance and pelvis height, and their frames.
        base, arms, hands: servos, and what the hands hold.
        ik: inverse kinematics and reach.
        probe: what an arm posture would touch.
        workspace: free floor and comfortable distances.
        objects: points and geoms of objects.
        contacts: what physics says the robot touches.
        plans: plans from the present state.
    """

    def __init__(self, world: World) -> None:
        if world.robot is None:
            raise ValueError("skills need a world with a robot, got one without")
        self.world, self.spec, self.kit = world, world.robot, robot_kit(world.robot)
        joints = JointMap(world.model, self.spec)
        self.posture = Posture(world.data, joints, self.kit, Hypothesis())
        self.base = Base(world, joints, self.kit, self.posture)
        self.ik = InverseKinematics(world.data, joints, self.kit, self.posture)
        self.probe = ClearanceProbe(world, joints, self.kit, self.posture)
        self.hands = Hands(world, joints, self.spec)
        self.arms = Arms(world.data, joints, self.kit, self.probe, self.ik, self.hands)
        self.workspace = Workspace(world, self.kit, self.posture)
        self.objects = ObjectGeometry(world)
        self.contacts = Contacts(world, joints, self.spec)
        self.plans = Plans()

    @property
    def hypothesis(self) -> Hypothesis:
        """What is assumed in place of the commanded posture."""
        return self.posture.hypothesis

    def assuming(
        self, stance: Stance | None = None, pelvis_height_m: float | None = None, diagnose: bool | None = None
    ) -> Body:
        """This body under a hypothesis: queries are answered for another stance or pelvis height; nothing moves.

        Args:
            stance: assumed stance; None keeps what is assumed or commanded already.
            pelvis_height_m: assumed pelvis height, metres; None likewise.
            diagnose: whether refusals say what is wrong; None likewise.
        """
        now, there = self.hypothesis, copy.copy(self)
        there.posture = self.posture.under(
            Hypothesis(
                now.stance if stance is None else stance,
                now.pelvis_height_m if pelvis_height_m is None else pelvis_height_m,
                now.diagnose if diagnose is None else diagnose,
            )
        )
        there.ik, there.probe = self.ik.under(there.posture), self.probe.under(there.posture)
        there.workspace = Workspace(self.world, self.kit, there.posture)
        return there

    def planning_state(self) -> tuple[object, ...]:
        """Everything that a plan depends on: positions, commands, states and holders of objects, the hypothesis."""
        data = self.world.data
        objs = tuple(
            (dataclasses.astuple(obj.state), tuple(obj.held_by), obj.openness, obj.mass_kg)
            for obj in self.world.objects.values()
        )
        numbers = (data.qpos.tobytes(), data.ctrl.tobytes(), data.xpos.tobytes())
        return *numbers, objs, self.hypothesis

    def fits(self, stance: Stance) -> bool:
        """Whether arms and hands in their commanded posture would be collision-free at a stance."""
        there = self.assuming(stance=stance)
        return all(there.probe.free(arm, [self.arms.commanded(arm)]) for arm in Arm)

    def obj(self, object_id: str) -> ObjectInstance:
        """An object of the scene by id."""
        return self.world.objects[object_id]
