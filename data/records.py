"""Plain records that cross layer boundaries: motions, actions, observations, feedback, episodes.

Everything here is numpy and dataclasses: no torch, no mujoco, no Hydra. The simulator produces an `Observation`, a planner
answers with a `PlanStep`, the simulator answers with `Feedback`, and the evaluation writes an `EpisodeRecord`.

Frames: `pelvis heading frame` has its origin at the pelvis, x forward and z up, rotated with the pelvis' yaw only.
Shape letters: T frames, F motion features, J robot joints, H and W image rows and columns.

Paper: section on problem formulation (observation, proprioception, dual-arm action). What the paper leaves open and is fixed
here: the textual action grammar (`PlanStep.to_text`), and the content of an observation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "ACTIONS",
    "Action",
    "ActionError",
    "ActionKind",
    "ActionOutcome",
    "ActionSpec",
    "Arm",
    "Camera",
    "EpisodeRecord",
    "FailureCategory",
    "Feedback",
    "HistoryItem",
    "Motion",
    "Observation",
    "Outcome",
    "PlanStep",
    "Proprioception",
]


class ActionError(ValueError):
    """A plan step that does not follow the action grammar; the message names the text and what is allowed."""


class Arm(StrEnum):
    """One of the robot's two arms."""

    LEFT = "left"
    RIGHT = "right"

    @property
    def other(self) -> Arm:
        """The opposite arm."""
        return Arm.RIGHT if self is Arm.LEFT else Arm.LEFT


class ActionKind(StrEnum):
    """What an action occupies: the whole body, one arm, both arms, or nothing (episode control)."""

    BODY = "body"
    ARM = "arm"
    TWO_ARM = "two_arm"
    EPISODE = "episode"


@dataclass(frozen=True, slots=True)
class ActionSpec:
    """Signature of one action of the grammar.

    Attributes:
        name: AI2-THOR-style verb.
        kind: what the action occupies while it runs.
        takes_object: whether an object id is required.
        amount_unit: unit of the optional amount (`m` or `deg`), or None when there is no amount.
        amount_range: closed range of the amount in that unit.
        amount_default: amount used when the text gives none.
    """

    name: str
    kind: ActionKind
    takes_object: bool
    amount_unit: str | None = None
    amount_range: tuple[float, float] = (0.0, 0.0)
    amount_default: float | None = None


def _spec(
    name: str,
    kind: ActionKind,
    takes_object: bool,
    unit: str | None = None,
    low: float = 0.0,
    high: float = 0.0,
    default: float | None = None,
) -> ActionSpec:
    return ActionSpec(name, kind, takes_object, unit, (low, high), default)


#: Every action that a planner may use, by name. GoTo's amount is the distance between pelvis and object, its second amount
#: (`bearing_deg`, optional) the object's bearing in the heading frame, positive to the left.
ACTIONS: Final[Mapping[str, ActionSpec]] = {
    spec.name: spec
    for spec in (
        _spec("GoTo", ActionKind.BODY, True, "m", 0.2, 2.0),
        _spec("MoveAhead", ActionKind.BODY, False, "m", 0.05, 5.0, 0.25),
        _spec("MoveBack", ActionKind.BODY, False, "m", 0.05, 5.0, 0.25),
        _spec("MoveLeft", ActionKind.BODY, False, "m", 0.05, 5.0, 0.25),
        _spec("MoveRight", ActionKind.BODY, False, "m", 0.05, 5.0, 0.25),
        _spec("RotateLeft", ActionKind.BODY, False, "deg", 5.0, 180.0, 90.0),
        _spec("RotateRight", ActionKind.BODY, False, "deg", 5.0, 180.0, 90.0),
        _spec("MoveUp", ActionKind.BODY, False, "m", 0.01, 1.0, 0.1),
        _spec("MoveDown", ActionKind.BODY, False, "m", 0.01, 1.0, 0.1),
        _spec("Pick", ActionKind.ARM, True),
        _spec("Place", ActionKind.ARM, True),
        _spec("Open", ActionKind.ARM, True),
        _spec("Close", ActionKind.ARM, True),
        _spec("ToggleOn", ActionKind.ARM, True),
        _spec("ToggleOff", ActionKind.ARM, True),
        _spec("Hold", ActionKind.ARM, True),
        _spec("Release", ActionKind.ARM, False),
        _spec("Slice", ActionKind.ARM, True),
        _spec("Clean", ActionKind.ARM, True),
        _spec("UseUp", ActionKind.ARM, True),
        _spec("Pour", ActionKind.ARM, True),
        _spec("Fill", ActionKind.ARM, True),
        _spec("ResetArm", ActionKind.ARM, False),
        _spec("Lift", ActionKind.TWO_ARM, True),
        _spec("PlaceBoth", ActionKind.TWO_ARM, True),
        _spec("Done", ActionKind.EPISODE, False),
    )
}

_CALL = re.compile(r"^([A-Za-z]{1,32})\(([^()]{0,160})\)$")
_OBJECT_ID = re.compile(r"^[A-Za-z][A-Za-z0-9_]{0,47}$")


def _format_amount(value: float) -> str:
    return f"{round(value, 3):g}"


@dataclass(frozen=True, slots=True)
class Action:
    """One action of a plan step.

    Attributes:
        name: a key of `ACTIONS`.
        arm: the arm that acts; required for arm actions, None for all others.
        object_id: target object, or the receptacle for Place and PlaceBoth.
        amount: metres or degrees, see `ActionSpec.amount_unit`; None takes the action's default.
        bearing_deg: GoTo only, the object's bearing in the heading frame after arrival, positive to the left.

    Raises:
        ActionError: on an unknown name, a missing or superfluous argument, or an amount out of range.
    """

    name: str
    arm: Arm | None = None
    object_id: str | None = None
    amount: float | None = None
    bearing_deg: float | None = None

    def __post_init__(self) -> None:
        spec = ACTIONS.get(self.name)
        if spec is None:
            raise ActionError(f"unknown action {self.name!r}; allowed: {', '.join(ACTIONS)}")
        if (self.arm is not None) != (spec.kind is ActionKind.ARM):
            need = "needs an arm (left or right)" if spec.kind is ActionKind.ARM else "takes no arm"
            raise ActionError(f"{self.name} {need}, got {self.arm!r}")
        if (self.object_id is not None) != spec.takes_object:
            need = "needs an object id" if spec.takes_object else "takes no object"
            raise ActionError(f"{self.name} {need}, got {self.object_id!r}")
        if self.object_id is not None and not _OBJECT_ID.match(self.object_id):
            raise ActionError(f"{self.name}: object id {self.object_id!r} is not of the form Type_1")
        if self.amount is not None:
            low, high = spec.amount_range
            if spec.amount_unit is None:
                raise ActionError(f"{self.name} takes no amount, got {self.amount!r}")
            if not low <= self.amount <= high:  # also refuses NaN
                raise ActionError(f"{self.name}: amount {self.amount!r} outside [{low:g}, {high:g}] {spec.amount_unit}")
        if self.bearing_deg is not None and (self.name != "GoTo" or not -180.0 <= self.bearing_deg <= 180.0):
            raise ActionError(f"{self.name}: bearing {self.bearing_deg!r} is for GoTo only, within [-180, 180] deg")

    @property
    def spec(self) -> ActionSpec:
        """Signature of this action."""
        return ACTIONS[self.name]

    def to_text(self) -> str:
        """The action in the grammar, for example `Pick(left, Mug_1)`, `MoveDown(0.2)`, `GoTo(Fridge_1, 0.6, 15)`."""
        parts: list[str] = []
        if self.arm is not None:
            parts.append(self.arm.value)
        if self.object_id is not None:
            parts.append(self.object_id)
        if self.amount is not None:
            parts.append(_format_amount(self.amount))
        if self.bearing_deg is not None:
            if self.amount is None:
                parts.append("auto")
            parts.append(_format_amount(self.bearing_deg))
        return f"{self.name}({', '.join(parts)})"

    @staticmethod
    def parse(text: str) -> Action:
        """Reads one action, the inverse of `to_text`.

        Raises:
            ActionError: when the text is not of the grammar; the message quotes it.
        """
        match = _CALL.match(text.strip())
        if match is None:
            raise ActionError(f"not an action: {text[:80]!r}; expected Name(arguments), for example Pick(left, Mug_1)")
        name = match.group(1)
        spec = ACTIONS.get(name)
        if spec is None:
            raise ActionError(f"unknown action {name!r}; allowed: {', '.join(ACTIONS)}")
        parts = [part.strip() for part in match.group(2).split(",")] if match.group(2).strip() else []
        arm: Arm | None = None
        object_id: str | None = None
        if spec.kind is ActionKind.ARM:
            word = parts.pop(0).lower() if parts else ""
            if word not in ("left", "right"):
                raise ActionError(f"{name} needs an arm first (left or right), got {word!r}")
            arm = Arm(word)
        if spec.takes_object:
            if not parts:
                raise ActionError(f"{name} needs an object id, got {text[:80]!r}")
            object_id = parts.pop(0)
        limit = 2 if name == "GoTo" else int(spec.amount_unit is not None)
        if len(parts) > limit:
            raise ActionError(f"{name}: superfluous arguments {parts[limit:]} in {text[:80]!r}")
        numbers: list[float | None] = []
        for part in parts:
            if part == "auto" and name == "GoTo":
                numbers.append(None)
                continue
            try:
                numbers.append(float(part))
            except ValueError:
                raise ActionError(f"{name}: {part[:40]!r} is not a number in {text[:80]!r}") from None
        amount = numbers[0] if numbers else None
        bearing = numbers[1] if len(numbers) > 1 else None
        return Action(name, arm=arm, object_id=object_id, amount=amount, bearing_deg=bearing)


@dataclass(frozen=True, slots=True)
class PlanStep:
    """One environment step: a body action, a two-arm action, an episode action, or one arm action per arm in parallel.

    Raises:
        ActionError: on no action, more than two, two for the same arm, or a parallel pair that is not two arm actions.
    """

    actions: tuple[Action, ...]

    def __post_init__(self) -> None:
        if len(self.actions) not in (1, 2):
            raise ActionError(f"a plan step has one or two actions, got {len(self.actions)}")
        if len(self.actions) == 2:
            if any(action.spec.kind is not ActionKind.ARM for action in self.actions):
                raise ActionError(f"only arm actions run in parallel, got {self.to_text()!r}")
            if self.actions[0].arm is self.actions[1].arm:
                raise ActionError(f"both actions use the {self.actions[0].arm} arm: {self.to_text()!r}")

    def to_text(self) -> str:
        """The step in the grammar; parallel actions are joined by ` & `."""
        return " & ".join(action.to_text() for action in self.actions)

    @staticmethod
    def parse(text: str) -> PlanStep:
        """Reads a step from text, the inverse of `to_text`.

        Raises:
            ActionError: when the text is not of the grammar.
        """
        return PlanStep(tuple(Action.parse(part) for part in text.strip().split("&")))


class FailureCategory(StrEnum):
    """The paper's three failure types (Table IV)."""

    NAVIGATION = "navigation"
    BODY_ADJUSTMENT = "body_adjustment"
    LOGICAL = "logical"


@dataclass(frozen=True, slots=True)
class ActionOutcome:
    """What became of one action.

    Attributes:
        action: the action as it was asked for.
        success: whether its effect was reached in the physics.
        code: failure code of `sim.skills.failures` (for example `TooFar`), `""` on success.
        category: the paper's failure type the code rolls up to, None on success.
        margins: signed quantities that explain the failure (`reach_m`, `height_m`, `mass_kg` …), for traces and analysis.
        message: one readable sentence without numbers about hidden positions.
        contingency: outcome drawn from the contingency distribution when it was not `success` (`slipped`, `broken` …).
    """

    action: Action
    success: bool
    code: str = ""
    category: FailureCategory | None = None
    margins: Mapping[str, float] = field(default_factory=dict)
    message: str = ""
    contingency: str = ""


@dataclass(frozen=True, slots=True)
class Feedback:
    """Result of a plan step: one outcome per action, and the simulated seconds it took."""

    outcomes: tuple[ActionOutcome, ...]
    duration_s: float

    @property
    def success(self) -> bool:
        """Whether every action of the step succeeded."""
        return all(outcome.success for outcome in self.outcomes)

    @property
    def struck(self) -> bool:
        """Whether a contingency spoiled an action of the step; unknown, and so False, once the feedback is public."""
        return any(outcome.contingency for outcome in self.outcomes)

    def public(self) -> Feedback:
        """The feedback without what a planner must not know: margins and the draws of the contingency."""
        return replace(self, outcomes=tuple(replace(outcome, margins={}, contingency="") for outcome in self.outcomes))

    def to_text(self) -> str:
        """What a planner reads: each action with `ok` or its failure code; never a margin."""
        return "; ".join(f"{outcome.action.to_text()} {'ok' if outcome.success else outcome.code}" for outcome in self.outcomes)


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera.

    Attributes:
        intrinsics: (3, 3) matrix K in pixels.
        camera_in_pelvis: (4, 4) pose of the camera (x right, y down, z forward) in the pelvis heading frame.
        height: rows H.
        width: columns W.
    """

    intrinsics: NDArray[np.float64]
    camera_in_pelvis: NDArray[np.float64]
    height: int
    width: int


@dataclass(frozen=True, slots=True)
class Proprioception:
    """What the robot knows of its own body.

    Attributes:
        motion: (T, F) features of the last T frames at `fps`, newest last (`data.motion.FEATURES`).
        fps: frames per second of `motion`.
        joint_positions: (J,) radians, in the robot's joint order.
        key_bodies_in_pelvis: (K, 3) metres, current positions of the key bodies in the pelvis heading frame.
    """

    motion: NDArray[np.float32]
    fps: float
    joint_positions: NDArray[np.float64]
    key_bodies_in_pelvis: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class HistoryItem:
    """One earlier step of the episode: its text and the feedback text."""

    step: str
    feedback: str


@dataclass(frozen=True, slots=True)
class Observation:
    """All that a planner sees. It never holds positions or states of objects.

    Attributes:
        instruction: the task in natural language.
        robot: robot name.
        image: (H, W, 3) uint8 head-camera view.
        camera: the head camera; its pose follows from the robot's own joints.
        visible_objects: ids of objects in the current view.
        known_objects: ids seen so far in the episode, and the room's furniture.
        proprioception: the robot's own state.
        history: earlier steps with their feedback, oldest first.
        step: index of the coming step.
        step_budget: number of steps the task allows.
    """

    instruction: str
    robot: str
    image: NDArray[np.uint8]
    camera: Camera
    visible_objects: tuple[str, ...]
    known_objects: tuple[str, ...]
    proprioception: Proprioception
    history: tuple[HistoryItem, ...]
    step: int
    step_budget: int


@dataclass(frozen=True, slots=True)
class Motion:
    """A robot or human motion clip.

    Attributes:
        name: clip id.
        robot: robot name, or `human`.
        fps: frames per second.
        features: (T, F) float32, `data.motion.FEATURES`.
        captions: sentences that describe the whole clip.
        root_pose: (T, 7) pelvis position (m) and quaternion (w, x, y, z) in the world, or None.
        joint_positions: (T, J) radians in the robot's joint order, or None.
    """

    name: str
    robot: str
    fps: float
    features: NDArray[np.float32]
    captions: tuple[str, ...] = ()
    root_pose: NDArray[np.float64] | None = None
    joint_positions: NDArray[np.float64] | None = None


class Outcome(StrEnum):
    """How an episode ended. `INFRASTRUCTURE_ERROR` is not a score: it is reported and re-run."""

    SUCCESS = "success"
    FAILURE = "failure"
    INFRASTRUCTURE_ERROR = "infrastructure_error"


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """One line of the ledger.

    Attributes:
        planner, robot, task, category, difficulty, trial, seed, config_hash: the episode's key.
        outcome: how it ended.
        failure: the one category of a failed episode, None otherwise.
        invalid_output: number of planner replies outside the grammar.
        budget_exhausted: whether the step budget ran out.
        goal_conditions_met: fraction of goal predicates that held at the end, in [0, 1].
        steps: environment steps taken.
        makespan_s: simulated seconds.
        path_length_m: length of the base's path.
        arm_utilisation: mean fraction of arm-steps in which an arm acted, in [0, 1].
        planner_calls, planner_tokens, planner_s, wall_s: cost.
        trace: per step, the step text, its outcome codes and margins.
        message: error text of an infrastructure error.
        cached_calls: calls that a reply cache answered.
        reflections: calls that reflected on a failure.
        planner_usd: price of all calls when they were made, None where it is not known.
        models: exact language models that answered.
    """

    planner: str
    robot: str
    task: str
    category: str
    difficulty: str
    trial: int
    seed: int
    config_hash: str
    outcome: Outcome
    failure: FailureCategory | None
    invalid_output: int
    budget_exhausted: bool
    goal_conditions_met: float
    steps: int
    makespan_s: float
    path_length_m: float
    arm_utilisation: float
    planner_calls: int
    planner_tokens: int
    planner_s: float
    wall_s: float
    trace: tuple[Mapping[str, object], ...] = ()
    message: str = ""
    cached_calls: int = 0
    reflections: int = 0
    planner_usd: float | None = 0.0
    models: tuple[str, ...] = ()
