"""Gymnasium environment: plan steps as text in, images and proprioception out, reward when the goals hold.

For users of reinforcement-learning tooling; the evaluation uses `sim.session.session` directly. The action is a plan step in
the textual grammar of `interface.steps` (`Pick(left, Mug_1) & Open(right, Fridge_1)`). Text outside the grammar changes
nothing, costs a step and is reported in `info`. Paper: DualTHOR as an environment; the reward is ours (share of goal
conditions that hold, 1 at success).

`gym.make("sim.interfaces.env:DualTHOR-v0", robot="x1")` makes one with Gymnasium's checker around it, `gym.make_vec` several.
In processes of their own they take `vector_kwargs={"context": "spawn"}`: OpenGL does not survive the fork of a process that has
drawn.
"""

from __future__ import annotations

import string
from collections.abc import Sequence
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from data.motion import N_FEATURES
from interface.bodies import DEFAULT_ROBOT, KEY_BODIES
from interface.episode import STEP_LIMIT
from interface.failures import INVALID_OUTPUT
from interface.observation import Observation
from interface.steps import ActionError, PlanStep
from sim.session.session import FreePlay, Session, TaskLike
from sim.world.recorder import HISTORY_FRAMES

_CHARACTERS = string.ascii_letters + string.digits + " ,.&()_-"


class DualThorEnv(gym.Env[dict[str, Any], str]):
    """One robot, a list of tasks.

    Args:
        robot: robot name.
        tasks: tasks to choose from at each reset; the default kitchen without a goal when empty.
        difficulty: easy, medium, hard or natural.
        image_size: side of the picture, pixels.
        render_mode: None, or `rgb_array` for `render`.
        contingency: name of the outcome distributions.
        step_limit: steps after which an episode is truncated; `info["in_time"]` tells the task's own time limit.

    Observation space: `image` (H, W, 3) uint8, `motion` (64, F) float32, `joints` (J,) float32, `key_bodies` (K, 3) float32.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012  # Gymnasium's own name and form

    def __init__(
        self, robot: str = DEFAULT_ROBOT, tasks: Sequence[TaskLike] = (), difficulty: str = "easy", image_size: int = 112,
        render_mode: str | None = None, contingency: str = "default",
        step_limit: int = STEP_LIMIT,
    ) -> None:  # fmt: skip
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; allowed: rgb_array")
        self.render_mode = render_mode
        self._session = Session(robot, difficulty, image_size, contingency, step_limit=step_limit)
        self._tasks: tuple[TaskLike, ...] = tuple(tasks) or (FreePlay("kitchen_1"),)
        self._last: Observation | None = None
        self._invalid = 0
        joints = len(self._session.robot.joints)
        big = np.float32(1e3)
        self.observation_space = spaces.Dict(
            {
                "image": spaces.Box(0, 255, (image_size, image_size, 3), np.uint8),
                "motion": spaces.Box(-big, big, (HISTORY_FRAMES, N_FEATURES), np.float32),
                "joints": spaces.Box(-big, big, (joints,), np.float32),
                "key_bodies": spaces.Box(-big, big, (len(KEY_BODIES), 3), np.float32),
            }
        )
        self.action_space = spaces.Text(max_length=200, min_length=1, charset=_CHARACTERS)

    @property
    def session(self) -> Session:
        """The session behind the environment."""
        return self._session

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts a task; `options["task"]` gives its index, else one is drawn.

        Raises:
            ValueError: on an index outside the list.
        """
        super().reset(seed=seed)
        index = int((options or {}).get("task", self.np_random.integers(len(self._tasks))))
        if not 0 <= index < len(self._tasks):
            raise ValueError(f"task index {index} outside 0..{len(self._tasks) - 1}")
        self._invalid = 0
        self._last = self._session.reset(self._tasks[index], int(self.np_random.integers(2**31)))
        return self._vector(self._last), self._info("")

    def step(self, action: str) -> tuple[dict[str, Any], SupportsFloat, bool, bool, dict[str, Any]]:
        """Executes a plan step given as text."""
        error = ""
        try:
            plan_step = PlanStep.parse(str(action))
        except ActionError as problem:
            error = str(problem)
            self._invalid += 1
        else:
            self._last, _ = self._session.step(plan_step)
        assert self._last is not None
        goals = self._session.goal_status()
        reward = float(np.mean(goals)) if goals else 0.0
        done = self._session.succeeded or self._session.ended
        truncated = not done and self._session.stats.charged + self._invalid >= self._session.step_limit
        return self._vector(self._last), reward, done, truncated, self._info(error)

    def render(self) -> np.ndarray | None:  # type: ignore[override]  # one render mode, one return type
        """The view from behind the robot, (480, 480, 3) uint8, in `rgb_array` mode."""
        return self._session.world.cameras.render("behind", 480, 480).rgb if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Frees the drawing contexts."""
        self._session.close()

    def _vector(self, seen: Observation) -> dict[str, Any]:
        own = seen.proprioception
        return {
            "image": seen.image.copy(),
            "motion": own.motion.astype(np.float32),
            "joints": own.joint_positions.astype(np.float32),
            "key_bodies": own.key_bodies_in_pelvis.astype(np.float32),
        }

    def _info(self, error: str) -> dict[str, Any]:
        assert self._last is not None
        return {
            "instruction": self._last.instruction,
            "visible_objects": self._last.visible_objects,
            "known_objects": self._last.known_objects,
            "feedback": INVALID_OUTPUT if error else self._last.history[-1].feedback if self._last.history else "",
            "invalid_action": error,
            "goals": self._session.goal_status(),
            "in_time": self._session.stats.charged + self._invalid <= self._session.task.time_limit,
        }


if "DualTHOR-v0" not in gym.registry:
    gym.register("DualTHOR-v0", entry_point=DualThorEnv)  # type: ignore[arg-type]  # a class is a callable that makes it
