"""Hands in physics: an object between the fingers is held by contact alone against gravity, and the servos are stable."""

import mujoco
import numpy as np
import pytest

from interface.bodies import SIDES
from robots.spec import available_robots, load_robot
from tools.robot_models.common import ROBOT_AFFINITY, ROBOT_BIT


def _fixed_robot(name: str) -> mujoco.MjSpec:
    """The robot with its pelvis fixed in space."""
    spec = mujoco.MjSpec.from_file(str(load_robot(name).mjcf_path))
    spec.delete(spec.joint("root"))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    return spec


def _reset(name: str, model: mujoco.MjModel, side: str) -> mujoco.MjData:
    data = mujoco.MjData(model)
    arm = load_robot(name).arms[side]
    for joint, value in (*zip(arm.joints, arm.carry, strict=True), *zip(arm.hand_joints, arm.hand_open, strict=True)):
        data.qpos[model.joint(joint).qposadr[0]] = value
    data.ctrl[:] = data.qpos[model.jnt_qposadr[model.actuator_trnid[:, 0]]]
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("name", available_robots())
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("radius_m", "mass_kg"), [(0.012, 0.05), (0.025, 0.5), (0.03, 1.0)])
def test_a_closed_hand_holds_an_object(name, side, radius_m, mass_kg):
    arm = load_robot(name).arms[side]
    bare = _fixed_robot(name).compile()
    site = _reset(name, bare, side).site(arm.grasp_site)
    start, rotation = site.xpos.copy(), np.zeros(4)
    mujoco.mju_mat2Quat(rotation, site.xmat)

    spec = _fixed_robot(name)
    body = spec.worldbody.add_body(name="thing", pos=start, quat=rotation)
    body.add_freejoint()
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[radius_m, 0.05, 0.0],
        mass=mass_kg,
        contype=2,
        conaffinity=7,
        condim=4,
        friction=[1.0, 0.005, 0.0001],
    )
    model = spec.compile()
    data = _reset(name, model, side)
    model.opt.gravity[:] = 0.0
    opened, closed = np.asarray(arm.hand_open), np.asarray(arm.hand_closed)
    servos = [model.actuator(joint).id for joint in arm.hand_joints]
    for share in np.linspace(0.0, 1.0, 300):
        data.ctrl[servos] = opened + share * (closed - opened)
        mujoco.mj_step(model, data)
    for _ in range(150):
        mujoco.mj_step(model, data)
    gripped = data.body("thing").xpos.copy()
    model.opt.gravity[:] = (0.0, 0.0, -9.81)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.linalg.norm(data.body("thing").xpos - gripped) < 0.04
    touched = {model.geom(int(geom)).name for contact in data.contact[: data.ncon] for geom in contact.geom}
    assert all(touched & set(group) for group in arm.finger_groups), touched
    # opened again, the hand lets go
    data.ctrl[servos] = opened
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert data.body("thing").xpos[2] < gripped[2] - 0.3


@pytest.mark.parametrize("name", available_robots())
def test_servos_track_without_oscillation(name):
    spec = load_robot(name)
    model = _fixed_robot(name).compile()
    data = _reset(name, model, "left")
    goal = data.ctrl.copy()
    joints = [*spec.arms["left"].joints, *spec.arms["right"].joints, *spec.waist_joints]
    for joint in joints:
        low, high = model.joint(joint).range
        goal[model.actuator(joint).id] = np.clip(goal[model.actuator(joint).id] + 0.3, low, high)
    start = data.ctrl.copy()
    addresses = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    arm = [model.actuator(joint).id for joint in joints]
    peak = np.zeros(len(arm))
    for step in range(1200):
        data.ctrl[:] = start + min(1.0, step / 400) * (goal - start)
        mujoco.mj_step(model, data)
        peak = np.maximum(peak, np.sign(goal[arm] - start[arm]) * (data.qpos[addresses[arm]] - goal[arm]))
    assert np.abs(data.qpos[addresses[arm]] - goal[arm]).max() < 0.01
    assert peak.max() < 0.03  # overshoot
    assert np.abs(data.qvel).max() < 0.02


@pytest.mark.parametrize("name", available_robots())
def test_only_hands_and_forearms_collide(name):
    spec = load_robot(name)
    model = mujoco.MjModel.from_xml_path(str(spec.mjcf_path))
    fingers = {geom for arm in spec.arms.values() for group in arm.finger_groups for geom in group}
    colliding = {model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]}
    allowed = fingers | {f"{side}_{part}" for side in SIDES for part in ("palm", "forearm")}
    assert fingers <= colliding <= allowed
    for geom in colliding:
        assert int(model.geom(geom).contype[0]) == ROBOT_BIT and int(model.geom(geom).conaffinity[0]) == ROBOT_AFFINITY
    assert not ROBOT_BIT & ROBOT_AFFINITY  # the robot does not touch itself
    assert np.all(model.body_gravcomp[1:] == 1.0)


def test_meshes_are_small():
    folder = load_robot("h1").mjcf_path.parent
    assert sum(path.stat().st_size for path in (folder / "meshes").glob("*.stl")) < 500_000
    assert "BSD" in (folder / "LICENSE").read_text(encoding="utf-8") or "Redistribution" in (folder / "LICENSE").read_text()
