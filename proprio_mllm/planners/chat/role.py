"""What the prompts of language models say of the robot's body.

Paper: baselines, prompt contents (robot type). The paper gives its prompts in part; the wording here is ours.
"""

from __future__ import annotations

from data.robot_facts import robot_facts


def role(robot: str) -> str:
    """Who the model is: the robot's body in numbers."""
    facts = robot_facts(robot)
    low, high = facts.pelvis_height_m
    down, up = facts.reach_height_m
    return (
        f"You plan the steps of a household robot, the dual-arm humanoid {facts.name.upper()}. It has a left and a right arm "
        f"of {facts.arm_joints} joints and {facts.arm_length_m:g} m each, with a {facts.hand} at the end, and a camera in its "
        f"head. By bending its legs it moves its pelvis between {low:g} and {high:g} m above the floor; its hands then reach "
        f"from {down:.2g} to {up:.2g} m up. An arm carries {facts.arm_load_kg:g} kg, both {facts.two_arm_load_kg:g} kg."
    )
