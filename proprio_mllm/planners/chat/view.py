"""An observation in words and as an encoded picture. Only what an `Observation` holds can enter.

Paper: baselines' inputs: image, instruction, feedback. They have no proprioception; `body_text` is a switch beyond the paper.
"""

from __future__ import annotations

import io
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from data.motion import HAND_OPENING, OPEN_HAND, PELVIS_HEIGHT
from interface.bodies import KEY_BODIES
from interface.observation import HistoryItem, Observation, Proprioception
from proprio_mllm.backends.protocol import ChatImage

_HANDS: Final = {"left": KEY_BODIES.index("left_hand"), "right": KEY_BODIES.index("right_hand")}


def encoded(image: NDArray[np.uint8]) -> ChatImage:
    """A picture (H, W, 3) as PNG: the same picture gives the same bytes."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=False, compress_level=6)
    return ChatImage(buffer.getvalue())


def body_text(proprioception: Proprioception) -> str:
    """Pelvis height, and where each hand is and whether it is open."""
    last, keys = proprioception.motion[-1], proprioception.key_bodies_in_pelvis
    lines = [f"Your pelvis is {last[PELVIS_HEIGHT]:.2f} m above the floor."]
    for (side, index), opening in zip(_HANDS.items(), last[HAND_OPENING], strict=True):
        x, y, z = keys[index]
        state = "open" if opening >= OPEN_HAND else "closed around something or shut"
        across = f"{abs(y):.2f} m to the {'left' if y >= 0 else 'right'}"
        lines.append(f"Your {side} hand is {state}, {x:.2f} m ahead of the pelvis, {across}, {z:+.2f} m in height.")
    return " ".join(lines)


def log_text(history: tuple[HistoryItem, ...], last: int) -> str:
    """The newest steps with their results, oldest first, numbered as in the episode."""
    start = max(0, len(history) - last)
    lines = [f"{number + 1}. {item.feedback or item.step}" for number, item in enumerate(history) if number >= start]
    if start:
        lines.insert(0, f"({start} earlier steps left out)")
    return "\n".join(lines) or "nothing yet"


def scene_text(observation: Observation, last: int, body: bool) -> str:
    """Task, limits, names, the log, and with `body` the robot's own state.

    Args:
        observation: what is seen.
        last: steps of the log.
        body: whether proprioception is told.
    """
    seen = set(observation.visible_objects)
    elsewhere = [name for name in observation.known_objects if name not in seen]
    parts = [
        f"Task: {observation.instruction}",
        f"This is step {observation.step + 1} of at most {observation.step_limit}; in time are {observation.time_limit}.",
        f"Objects in view: {', '.join(observation.visible_objects) or 'none'}",
        f"Known elsewhere: {', '.join(elsewhere) or 'none'}",
        *([body_text(observation.proprioception)] if body else []),
        f"Log:\n{log_text(observation.history, last)}",
        "The picture is the view of your head camera now.",
    ]
    return "\n".join(parts)
