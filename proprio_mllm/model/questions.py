"""Grounding questions about a named object, answered from its position relative to the robot's own body.

Each builder gives a question and the true answer from the object's centre in the pelvis heading frame, which training data
carries. Answers are words or one action, never raw coordinates. "Proprioceptive" questions depend on the body's shape and
posture: which arm is nearer, which are long enough, and how far the body must go down or up.

Frame: pelvis heading frame, x forward, y left, z up, metres. The bins are ours, the paper names none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.steps import Action
from proprio_mllm.model.geometry import arm_length_m, shoulders
from proprio_mllm.model.prompts import Style
from proprio_mllm.model.wording import id_words, place_words

#: Bearing within which an object counts as ahead, degrees.
AHEAD_DEG = 8.0
#: Limits of near and far, metres in the floor plane from the pelvis.
NEAR_M, FAR_M = 1.0, 2.0
#: Height relative to the pelvis below and above which an object counts as low and high, metres.
LOW_M, HIGH_M = -0.15, 0.25
#: Lateral offset within which either arm does, metres.
EITHER_M = 0.1
#: How far below the shoulders the hands work most freely, as a share of the arm's length: forearms level.
WORKING = 0.5
#: Arm lengths from its shoulder within which an arm reaches an object. The simulator's reach test agrees in 89 % of 616 poses
#: before things on H1, 96 % on X1 (commonest answers 64 and 95 %).
REACH: Final = 1.1
#: Body shifts are rounded to this, metres.
STEP_M = 0.1

#: Terse questions about the body use words that planning teaches.
QUESTIONS: Mapping[str, Mapping[Style, str]] = {
    "side": {"terse": "side {}", "full": "Is {} to the left, ahead or to the right?"},
    "distance": {"terse": "distance {}", "full": "Is {} near, middle or far?"},
    "height": {"terse": "height {}", "full": "Is {} low, level or high relative to your pelvis?"},
    "arm": {"terse": "Pick {}", "full": "Which arm reaches {} better: left, right or either?"},
    "reach": {"terse": "far {}", "full": "Which arms are long enough to reach {} from here: left, right, both or none?"},
    "see": {"terse": "see?", "full": "Which objects do you see, from left to right? Give their ids."},
    "place": {
        "terse": "at {}",
        "full": "Where is {}? Give bearing and distance from you and height above the floor.",
    },
    "shift": {"terse": "MoveDown {}", "full": "How must your height change to work on {}? Give MoveDown, MoveUp or none."},
}


def spoken(object_id: str, style: Style) -> str:
    """How questions name an object: terse ones in the words of episodes, so that a name is the same tokens in both.

    A word that is a token, its blank included (`proprio_mllm.model.word_tokens`), is found in a text only where no letter
    stands before the blank: hence two of them.
    """
    return "".join(f" {word} " for word in id_words(object_id)).rstrip() if style == "terse" else object_id


def ask(kind: str, name: str = "", style: Style = "terse") -> str:
    """The question of a kind about an object, named as `spoken` does; `see` is about none.

    Raises:
        ValueError: on an unknown kind.
    """
    if kind not in QUESTIONS:
        raise ValueError(f"question {kind!r} is not allowed; allowed: {', '.join(QUESTIONS)}")
    return QUESTIONS[kind][style].format(name)


def side_answer(center: NDArray[np.floating]) -> str:
    """`left`, `ahead` or `right` by bearing."""
    bearing = math.degrees(math.atan2(float(center[1]), float(center[0])))
    return "ahead" if abs(bearing) <= AHEAD_DEG else ("left" if bearing > 0 else "right")


def distance_answer(center: NDArray[np.floating]) -> str:
    """`near`, `middle` or `far` in the floor plane."""
    distance = float(np.hypot(center[0], center[1]))
    return "near" if distance < NEAR_M else ("far" if distance > FAR_M else "middle")


def height_answer(center: NDArray[np.floating]) -> str:
    """`low`, `level` or `high` relative to the pelvis."""
    return "low" if center[2] < LOW_M else ("high" if center[2] > HIGH_M else "level")


def arm_answer(center: NDArray[np.floating]) -> str:
    """`left`, `right` or `either` by the side on which the object lies."""
    return "either" if abs(center[1]) <= EITHER_M else ("left" if center[1] > 0 else "right")


def reach_answer(center: NDArray[np.floating], key_bodies: NDArray[np.floating]) -> str:
    """`left`, `right`, `both` or `none`: the arms whose shoulders are within `REACH` arm lengths of the object.

    Args:
        center: (3,) object.
        key_bodies: (K, 3) the robot's own bodies.
    """
    most_m = REACH * arm_length_m(key_bodies)
    sides = zip(("left", "right"), shoulders(key_bodies), strict=True)
    long_enough = [side for side, shoulder in sides if np.linalg.norm(center - shoulder) <= most_m]
    return "both" if len(long_enough) == 2 else (long_enough or ["none"])[0]


def body_shift_m(center: NDArray[np.floating], key_bodies: NDArray[np.floating]) -> float:
    """Change of pelvis height that brings the object level with the hands at work, metres, negative is down.

    The hands work `WORKING` arm lengths below the shoulders; changes are multiples of `STEP_M`.

    Args:
        center: (3,) object.
        key_bodies: (K, 3) the robot's own bodies.
    """
    level_m = float(shoulders(key_bodies)[:, 2].mean()) - WORKING * arm_length_m(key_bodies)
    return round((float(center[2]) - level_m) / STEP_M) * STEP_M


def shift_answer(center: NDArray[np.floating], key_bodies: NDArray[np.floating]) -> str:
    """The body action that brings the object level with the hands at work, or `none`; at most 1 m."""
    shift = body_shift_m(center, key_bodies)
    if shift == 0.0:
        return "none"
    return Action("MoveDown" if shift < 0 else "MoveUp", amount=round(min(abs(shift), 1.0), 3)).to_text()


def place_answer(center: NDArray[np.floating], key_bodies: NDArray[np.floating]) -> str:
    """`place_words` without the word that opens them, in the tokens of episodes (`spoken`)."""
    words = place_words(center, key_bodies)
    return "".join(f" {word} " for word in words[1:]).rstrip()


#: The true answer of each kind of question about an object, from its centre (3,) and the robot's own bodies (K, 3).
ANSWERS: Final[Mapping[str, Callable[[NDArray[np.floating], NDArray[np.floating]], str]]] = {
    "side": lambda center, _: side_answer(center),
    "arm": lambda center, _: arm_answer(center),
    "distance": lambda center, _: distance_answer(center),
    "height": lambda center, _: height_answer(center),
    "reach": reach_answer,
    "shift": shift_answer,
    "place": place_answer,
}
