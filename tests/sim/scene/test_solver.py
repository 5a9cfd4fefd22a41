"""MuJoCo's solver: Newton's method with dense Jacobians, as scenes have it, gives what conjugate gradients give."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sim.world.world import World


def stack(count: int) -> mujoco.MjModel:
    """Boxes on each other, heavier upwards."""
    boxes = "".join(
        f'<body pos="0 0 {0.05 + 0.1 * i}"><freejoint/><geom type="box" size=".05 .05 .05" mass="{0.2 + 0.1 * i}"/></body>'
        for i in range(count)
    )
    return mujoco.MjModel.from_xml_string(f'<mujoco><worldbody><geom type="plane" size="1 1 .1"/>{boxes}</worldbody></mujoco>')


def acceleration(
    model: mujoco.MjModel, data: mujoco.MjData, solver: mujoco.mjtSolver, jacobian: mujoco.mjtJacobian, iterations: int
) -> np.ndarray:
    own = mujoco.MjData(model)
    own.qpos[:], own.qvel[:], own.ctrl[:] = data.qpos, data.qvel, data.ctrl
    own.eq_active[:] = data.eq_active
    option = model.opt
    before = option.solver, option.jacobian, option.iterations, option.ls_iterations, option.tolerance, option.enableflags
    option.solver, option.jacobian, option.iterations = int(solver), int(jacobian), iterations
    option.ls_iterations, option.tolerance, option.enableflags = 50, 0.0, 0
    mujoco.mj_forward(model, own)
    option.solver, option.jacobian, option.iterations, option.ls_iterations, option.tolerance, option.enableflags = before
    return own.qacc.copy()


@pytest.mark.parametrize("scene", ["stack", "kitchen_1", "living_room_1", "bedroom_1"])
def test_newton_with_dense_jacobians_agrees_with_conjugate_gradients(scene: str) -> None:
    """In MuJoCo 4.0.0 sparse ones build a wrong Hessian (google-deepmind/mujoco #3767)."""
    rng = np.random.default_rng(0)
    if scene == "stack":
        model = stack(12)
        data = mujoco.MjData(model)
    else:
        world = World(None, scene)
        model, data = world.model, world.data
        assert model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    for _ in range(3):
        mujoco.mj_step(model, data, 10)
        data.qvel[:] += rng.normal(scale=0.01, size=model.nv)
        newton = acceleration(model, data, mujoco.mjtSolver.mjSOL_NEWTON, mujoco.mjtJacobian.mjJAC_DENSE, 100)
        gradient = acceleration(model, data, mujoco.mjtSolver.mjSOL_CG, mujoco.mjtJacobian.mjJAC_DENSE, 5000)
        assert np.abs(newton - gradient).max() < 1e-4 * max(1.0, float(np.abs(gradient).max()))
