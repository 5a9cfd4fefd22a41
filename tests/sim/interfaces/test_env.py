"""The Gymnasium environment follows Gymnasium's contract."""

import warnings

import gymnasium as gym
import pytest
from gymnasium.utils.env_checker import check_env

from sim.interfaces.env import DualThorEnv
from sim.session.session import FreePlay


@pytest.fixture(scope="module")
def env():
    made = DualThorEnv("x1", tasks=(FreePlay("living_room_1"),), image_size=56, render_mode="rgb_array", step_limit=3)
    yield made
    made.close()


def test_check_env():
    made = DualThorEnv("x1", tasks=(FreePlay("living_room_1"),), image_size=56, step_limit=2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(made, skip_render_check=True)
    assert isinstance(made, gym.Env)
    made.close()


def test_gymnasium_makes_it_by_name():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = gym.make("sim.interfaces.env:DualTHOR-v0", robot="x1", image_size=16)
        observation, info = made.reset(seed=0)
        assert observation["image"].shape == (16, 16, 3) and info["feedback"] == ""
        assert made.step("RotateLeft(5)")[-1]["feedback"] == "RotateLeft(5) ok"
        made.close()


def test_text_actions(env):
    observation, info = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    assert info["instruction"] and info["invalid_action"] == ""
    _, reward, done, truncated, info = env.step("Rotate me please")
    assert "not an action" in info["invalid_action"]
    assert (reward, done, truncated) == (0.0, False, False)
    _, _, done, truncated, info = env.step("RotateLeft(30)")
    assert info["feedback"] == "RotateLeft(30) ok" and not done and not truncated
    assert env.step("dance")[-1]["feedback"] == "InvalidOutput"
    _, _, done, truncated, _ = env.step("RotateRight(30)")
    assert truncated and not done
    assert env.render().shape == (480, 480, 3)


def test_done_terminates(env):
    env.reset(seed=1)
    assert env.step("Done()")[2]


def test_bad_arguments(env):
    with pytest.raises(ValueError, match=r"task index 5 outside 0\.\.0"):
        env.reset(options={"task": 5})
    with pytest.raises(ValueError, match="unknown render_mode 'human'"):
        DualThorEnv(render_mode="human")


def test_invalid_text_uses_up_the_budget():
    env = DualThorEnv("x1", image_size=56)
    env.reset(seed=0)
    budget = env.session.task.time_limit
    ends = [env.step("what?")[3] for _ in range(budget)]
    assert not any(ends[:-1])
    assert ends[-1]
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "context"), [("sync", {}), ("async", {"context": "spawn"})])
def test_several_side_by_side(mode, context):
    envs = gym.make_vec(
        "sim.interfaces.env:DualTHOR-v0", 2, mode, image_size=28, render_mode="rgb_array", vector_kwargs=context
    )
    seen, _ = envs.reset(seed=0)
    assert seen["image"].shape == (2, 28, 28, 3)
    _, rewards, _, _, info = envs.step(("RotateLeft(10)", "Fly()"))
    assert rewards.tolist() == [0.0, 0.0]
    assert next(iter(info["feedback"])) == "RotateLeft(10) ok"
    assert len(envs.render()) == 2
    envs.close()
