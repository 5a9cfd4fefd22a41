"""What the synthetic people do, and the words for it: household movements with directions, heights and named arms.

Each activity adds to a `Script` and returns interchangeable phrases. Wrist points are in the base frame: x forward, y left, z
above the floor, metres.

Paper: none; part of the generator of motions. The vocabulary follows HumanML3D's manner of describing motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data.script import Script

Array = NDArray[np.float64]
Phrases = list[str]
Activity = Callable[[Script], Phrases]

#: Height bands (m above the floor) and their names.
HEIGHTS: Final[Mapping[str, tuple[float, float]]] = {
    "near the floor": (0.15, 0.35),
    "at knee height": (0.45, 0.6),
    "at waist height": (0.8, 1.05),
    "at chest height": (1.15, 1.35),
    "at head height": (1.45, 1.6),
    "above the head": (1.7, 1.85),
}
#: Where a hand goes from the middle of the body: least and greatest x and, to its own side, y; metres.
DIRECTIONS: Final[Mapping[str, tuple[tuple[float, float], tuple[float, float]]]] = {
    "in front": ((0.32, 0.46), (0.08, 0.3)),
    "to the side": ((0.12, 0.28), (0.42, 0.55)),
    "across the body": ((0.28, 0.38), (-0.2, -0.05)),
}
_SIDES: Final = ("left", "right")


def _choice(script: Script, options: tuple[str, ...] | list[str]) -> str:
    return str(options[int(script.rng.integers(len(options)))])


def _thing(script: Script, hands: int) -> str:
    """What is handled: the same thing in all of a clip, and `the` after its first mention."""
    one = ("a cup", "a bottle", "an object", "a small box", "a plate", "a book")
    known = script.objs.get(hands)
    if known is not None:
        return known
    obj = _choice(script, one if hands == 1 else ("a box", "a heavy object", "a pot", "a basket", "a tray"))
    script.objs[hands] = f"the {obj.split(' ', 1)[1]}"
    return obj


def _point(script: Script, side: int, height: str, width: float | None = None, direction: str = "in front") -> Array:
    low, high = HEIGHTS[height]
    (x_low, x_high), (y_low, y_high) = DIRECTIONS[direction]
    x = 0.22 if height == "above the head" else float(script.rng.uniform(x_low, x_high))
    y = float(script.rng.uniform(y_low, y_high)) if width is None else width
    return np.array([x, y if side == 0 else -y, script.rng.uniform(low, high)])


def _direction(script: Script, side: int, height: str) -> tuple[str, str]:
    """A direction of `DIRECTIONS` and the words for it; low and high places are in front."""
    if HEIGHTS[height][0] < 0.7 or HEIGHTS[height][1] > 1.7 or script.rng.random() < 0.5:
        return "in front", ""
    direction = _choice(script, ["to the side", "across the body"])
    other = _SIDES[side] if direction == "to the side" else _SIDES[1 - side]
    return direction, f" on the {other} side" if direction == "to the side" else f" across the body to the {other}"


def _go(script: Script, wrists: dict[int, Array], seconds: float) -> None:
    """Moves hands to points, with the trunk turned towards what is beside the body."""
    drop, lean = script.reach_posture(list(wrists.values()))
    for side, wrist in wrists.items():
        script.hand(side, wrist, seconds, advance=False)
    if len(wrists) == 1:
        (side, wrist), *_ = wrists.items()
        beside = float(np.arctan2(wrist[1], max(wrist[0], 0.05))) - (0.45 if side == 0 else -0.45)
        script.trunk(float(np.clip(0.45 * beside, -0.4, 0.4)), 0.0, seconds, advance=False)
    script.posture(drop, lean, seconds)


def _stand(script: Script, seconds: float) -> None:
    script.trunk(0.0, 0.0, seconds, advance=False)
    script.posture(0.0, 0.0, seconds)


def _rest(script: Script, sides: Iterable[int], seconds: float) -> None:
    """Lets hands hang and straightens up."""
    for side in sides:
        script.hand(side, None, seconds, advance=False)
    _stand(script, seconds)


def _slow(script: Script, wrists: dict[int, Array]) -> float:
    """Seconds for a reach: low ones take longer."""
    lowest = min(float(wrist[2]) for wrist in wrists.values())
    return float(script.rng.uniform(0.8, 1.1) + (0.5 if lowest < 0.65 else 0.0))


def walk(script: Script) -> Phrases:
    """Walks ahead, at one of three paces, straight or along a curve."""
    pace, word = [(0.8, "slowly"), (1.0, ""), (1.25, "quickly")][int(script.rng.integers(3))]
    pace *= float(script.rng.uniform(0.92, 1.08))
    turn = float(script.rng.choice([0.0, 0.0, 1.0, -1.0])) * float(script.rng.uniform(0.6, 1.5))
    script.walk(float(script.rng.uniform(0.8, 2.4)), turn_rad=turn, pace=pace)
    curve = "" if turn == 0.0 else f" in a curve to the {_SIDES[int(turn < 0)]}"
    word = f" {word}" if word else ""
    return [f"walks forward{word}{curve}", f"takes a few steps ahead{word}{curve}", f"moves forward{word}{curve}"]


def walk_back(script: Script) -> Phrases:
    """Walks backwards."""
    script.walk(float(script.rng.uniform(0.4, 0.9)), direction_rad=np.pi, pace=0.9)
    return ["walks backwards", "takes a few steps back", "steps backward"]


def turn(script: Script) -> Phrases:
    """Turns in place by 45 to 180 degrees."""
    degrees = int(script.rng.choice([45, 90, 135, 180]))
    side = int(script.rng.integers(2))
    pace = float(script.rng.uniform(0.85, 1.35))
    script.walk(0.0, turn_rad=np.deg2rad(degrees) * (1 if side == 0 else -1), pace=pace)
    name = _SIDES[side]
    around = "turns around" if degrees == 180 else f"turns {degrees} degrees"
    return [f"{around} to the {name}", f"turns to the {name}", f"rotates {name} in place"]


def side_step(script: Script) -> Phrases:
    """Steps sideways."""
    side = int(script.rng.integers(2))
    script.walk(float(script.rng.uniform(0.3, 0.8)), direction_rad=np.pi / 2 * (1 if side == 0 else -1))
    name = _SIDES[side]
    return [f"steps sideways to the {name}", f"side-steps {name}", f"moves to the {name} without turning"]


def crouch(script: Script) -> Phrases:
    """Crouches and rises."""
    drop = float(script.rng.uniform(0.15, 0.36))
    script.posture(drop, 0.9 * drop + 0.1, float(script.rng.uniform(0.8, 1.3)))
    script.wait(float(script.rng.uniform(0.2, 0.7)))
    _stand(script, float(script.rng.uniform(0.8, 1.2)))
    deep = "deeply" if drop > 0.27 else "slightly"
    return [f"crouches {deep} and rises again", f"bends the knees {deep} and stands up", f"squats {deep}, then straightens up"]


def bend(script: Script) -> Phrases:
    """Bends the trunk forward and straightens."""
    lean = float(script.rng.uniform(0.4, 0.95))
    script.posture(0.02, lean, float(script.rng.uniform(0.8, 1.2)))
    script.wait(float(script.rng.uniform(0.2, 0.6)))
    _stand(script, float(script.rng.uniform(0.8, 1.1)))
    return ["bends forward and straightens up", "leans forward at the waist and comes back up", "bows and stands upright again"]


def idle(script: Script) -> Phrases:
    """Stands and, half of the time, shifts the weight from one leg to the other."""
    if script.rng.random() < 0.5:
        script.wait(float(script.rng.uniform(1.5, 3.0)))
        return ["stands still", "waits without moving", "remains standing with the arms at the sides"]
    for side in (0, 1):
        script.trunk(0.0, 0.09 if side else -0.09, float(script.rng.uniform(0.7, 1.1)))
        script.wait(float(script.rng.uniform(0.1, 0.5)))
    script.trunk(0.0, 0.0, 0.7)
    return ["shifts the weight from one leg to the other", "stands and sways from side to side", "waits, swaying a little"]


def look_around(script: Script) -> Phrases:
    """Turns the chest to one side and, half of the time, to the other."""
    side = int(script.rng.integers(2))
    angle = float(script.rng.uniform(0.35, 0.7)) * (1.0 if side == 0 else -1.0)
    script.trunk(angle, 0.0, float(script.rng.uniform(0.6, 1.0)))
    script.wait(float(script.rng.uniform(0.2, 0.6)))
    both = script.rng.random() < 0.5
    if both:
        script.trunk(-angle, 0.0, float(script.rng.uniform(0.9, 1.4)))
        script.wait(float(script.rng.uniform(0.2, 0.6)))
    script.trunk(0.0, 0.0, float(script.rng.uniform(0.6, 0.9)))
    name, other = _SIDES[side], _SIDES[1 - side]
    if both:
        return [f"turns the upper body to the {name}, then to the {other}", f"looks to the {name} and to the {other}"]
    return [f"turns the upper body to the {name} and back", f"looks over to the {name}", f"twists to the {name} and returns"]


def gesture(script: Script) -> Phrases:
    """Moves one or both hands from place to place in the air."""
    sides = [(0,), (1,), (0, 1)][int(script.rng.integers(3))]
    for _ in range(int(script.rng.integers(2, 5))):
        seconds = float(script.rng.uniform(0.5, 1.1))
        for side in sides:
            x, y, z = script.rng.uniform((-0.1, -0.1, 0.8), (0.45, 0.62, 1.8))
            x = max(x, 0.25) if y < 0.45 else x  # not through the trunk, nor close by the shoulder
            script.hand(side, np.array([x, y if side == 0 else -y, z]), seconds, advance=False)
            script.elbow(side, float(script.rng.uniform(-0.1, 0.7)), seconds)
            script.grip(side, float(script.rng.uniform(0.0, 1.0)), seconds)
        script.trunk(float(script.rng.uniform(-0.35, 0.35)), float(script.rng.uniform(-0.15, 0.15)), seconds, advance=False)
        script.posture(float(script.rng.uniform(0.0, 0.12)), float(script.rng.uniform(-0.05, 0.35)), seconds)
    for side in sides:
        script.hand(side, None, 0.9, advance=False)
        script.elbow(side, 0.0, 0.9)
    _stand(script, 0.9)
    if len(sides) == 2:
        return ["gestures with both hands", "moves both arms about in the air", "talks with both hands moving"]
    name = _SIDES[sides[0]]
    return [f"gestures with the {name} hand", f"moves the {name} arm about in the air", f"talks, moving the {name} hand"]


def reach(script: Script) -> Phrases:
    """Reaches out with one arm and takes the hand back."""
    side, height = int(script.rng.integers(2)), _choice(script, list(HEIGHTS))
    direction, where = _direction(script, side, height)
    wrists = {side: _point(script, side, height, direction=direction)}
    script.grip(side, 1.0)
    seconds = _slow(script, wrists)
    _go(script, wrists, seconds)
    script.wait(float(script.rng.uniform(0.2, 0.5)))
    _rest(script, (side,), seconds)
    name = _SIDES[side]
    return [
        f"reaches out with the {name} hand {height}{where}",
        f"extends the {name} arm {height}{where} and brings it back",
        f"stretches the {name} arm out {height}{where}",
        f"uses the {name} hand to reach something {height}{where}",
    ]


def reach_both(script: Script) -> Phrases:
    """Reaches out with both arms and takes the hands back."""
    height = _choice(script, list(HEIGHTS))
    width = float(script.rng.uniform(0.12, 0.3))
    left = _point(script, 0, height, width)
    wrists = {0: left, 1: left * np.array([1.0, -1.0, 1.0])}
    for side in (0, 1):
        script.grip(side, 1.0)
    seconds = _slow(script, wrists)
    _go(script, wrists, seconds)
    script.wait(float(script.rng.uniform(0.2, 0.5)))
    _rest(script, (0, 1), seconds)
    return [
        f"reaches out with both hands {height}",
        f"extends both arms {height} and lowers them",
        f"stretches both arms forward {height}",
    ]


def pick(script: Script) -> Phrases:
    """Picks something up with one hand and holds it."""
    side, height = int(script.rng.integers(2)), _choice(script, list(HEIGHTS)[:5])
    direction, where = _direction(script, side, height)
    wrists = {side: _point(script, side, height, direction=direction)}
    script.grip(side, 1.0)
    seconds = _slow(script, wrists)
    _go(script, wrists, seconds)
    script.grip(side, 0.1)
    script.wait(0.35)
    script.hand(side, np.array([0.28, 0.2 if side == 0 else -0.2, 1.1]), seconds, advance=False)
    _stand(script, seconds)
    name, obj = _SIDES[side], _thing(script, 1)
    return [
        f"picks up {obj} {height}{where} with the {name} hand",
        f"grabs {obj} {height}{where} using the {name} arm",
        f"takes {obj} {height}{where} in the {name} hand and holds it",
        f"uses the {name} hand to pick up {obj} {height}{where}",
    ]


def place(script: Script) -> Phrases:
    """Puts down what one hand holds."""
    side, height = int(script.rng.integers(2)), _choice(script, list(HEIGHTS)[1:5])
    script.grip(side, 0.1)
    script.hand(side, np.array([0.28, 0.2 if side == 0 else -0.2, 1.1]), 0.7)
    direction, where = _direction(script, side, height)
    wrists = {side: _point(script, side, height, direction=direction)}
    seconds = _slow(script, wrists)
    _go(script, wrists, seconds)
    script.grip(side, 1.0)
    script.wait(0.35)
    _rest(script, (side,), seconds)
    name, obj = _SIDES[side], _thing(script, 1)
    return [
        f"puts down {obj} {height}{where} with the {name} hand",
        f"places {obj} {height}{where} using the {name} arm",
        f"sets {obj} down {height}{where} with the {name} hand",
    ]


def _held(script: Script, width: float | None = None) -> Array:
    """Where the left wrist is while both hands hold something; the right one mirrors it."""
    width = float(script.rng.uniform(0.12, 0.3)) if width is None else width
    return np.array([script.rng.uniform(0.28, 0.42), width, script.rng.uniform(0.95, 1.35)])


def _both(script: Script, left: Array, seconds: float, shift: float = 0.0) -> None:
    """Moves the left wrist to a point, the right one to its mirror image, both `shift` m to the left; time does not advance."""
    for side, sign in ((0, 1.0), (1, -1.0)):
        script.hand(side, left * np.array([1.0, sign, 1.0]) + np.array([0.0, shift, 0.0]), seconds, advance=False)


def carry(script: Script) -> Phrases:
    """Carries something in front of the body with both hands."""
    for side in (0, 1):
        script.grip(side, 0.3)
    _both(script, _held(script), 0.8)
    script.posture(float(script.rng.uniform(0.0, 0.06)), float(script.rng.uniform(-0.1, 0.15)), 0.8)
    way, where = [(0.0, "forward"), (np.pi, "backwards"), (np.pi / 2, "to the left"), (-np.pi / 2, "to the right")][
        int(script.rng.choice(4, p=(0.64, 0.12, 0.12, 0.12)))
    ]
    distance = float(script.rng.uniform(0.8, 1.8)) * (1.0 if way == 0.0 else 0.5)
    script.walk(distance, direction_rad=way, pace=float(script.rng.uniform(0.8, 1.05)))
    obj = _thing(script, 2)
    return [
        f"carries {obj} {where} with both hands",
        f"steps {where} while holding {obj} in both hands",
        f"moves {obj} {where} with both arms",
    ]


def roam(script: Script) -> Phrases:
    """Steps about in all directions, turning, with something in both hands or with the hands moving on the way."""
    carries = script.rng.random() < 0.5
    for _ in range(int(script.rng.integers(2, 5))):
        seconds = float(script.rng.uniform(0.8, 1.4))
        if carries:
            _both(script, _held(script), seconds)
        for side in () if carries else (0, 1):
            x, y, z = script.rng.uniform((0.0, 0.2, 0.85), (0.45, 0.5, 1.6))
            wrist = np.array([max(x, 0.25) if y < 0.4 else x, y if side == 0 else -y, z])
            script.hand(side, wrist if script.rng.random() < 0.6 else None, seconds, advance=False)
        script.trunk(float(script.rng.uniform(-0.25, 0.25)), 0.0, seconds, advance=False)
        script.posture(float(script.rng.uniform(0.0, 0.06)), float(script.rng.uniform(-0.05, 0.3)), seconds, advance=False)
        distance = float(script.rng.uniform(0.0, 0.8))
        way = float(script.rng.uniform(-np.pi, np.pi))
        script.walk(
            distance, direction_rad=way, turn_rad=float(script.rng.uniform(-1.6, 1.6)), pace=float(script.rng.uniform(0.9, 1.4))
        )
    _rest(script, (0, 1), 0.9)
    if carries:
        obj = _thing(script, 2)
        return [f"steps about with {obj} in both hands", f"turns here and there while carrying {obj}"]
    return ["steps about and turns, moving the arms", "walks to and fro in a small space", "steps around with both arms moving"]


def shift(script: Script) -> Phrases:
    """Moves something that both hands hold from one side of the body to the other."""
    start = int(script.rng.integers(2))
    left = _held(script)
    for side in (0, 1):
        script.grip(side, 0.3)
    for sign in (1.0, -1.0) if start == 0 else (-1.0, 1.0):
        seconds = float(script.rng.uniform(0.8, 1.3))
        left = left + script.rng.uniform((-0.05, 0.0, -0.25), (0.05, 0.0, 0.2))
        left[2] = np.clip(left[2], 0.7, 1.5)
        drop, lean = script.reach_posture([left])
        _both(script, left, seconds, shift=sign * float(script.rng.uniform(0.1, 0.25)))
        script.trunk(sign * float(script.rng.uniform(0.3, 0.6)), 0.0, seconds, advance=False)
        script.posture(drop, lean, seconds)
        script.wait(float(script.rng.uniform(0.1, 0.4)))
    _rest(script, (0, 1), 0.9)
    name, other, obj = _SIDES[start], _SIDES[1 - start], _thing(script, 2)
    return [
        f"moves {obj} from the {name} to the {other} with both hands",
        f"swings {obj} over from the {name} side to the {other} side with both arms",
        f"hands {obj} across the body from {name} to {other}",
    ]


def spread(script: Script) -> Phrases:
    """Spreads one or both arms out to the sides, between hanging and above the shoulders."""
    sides = [(0,), (1,), (0, 1), (0, 1)][int(script.rng.integers(4))]
    raised = float(script.rng.uniform(-0.95, 0.85))
    for _ in range(int(script.rng.integers(1, 3))):
        seconds = float(script.rng.uniform(0.7, 1.3))
        for side in sides:
            angle, ahead = raised + float(script.rng.uniform(-0.12, 0.12)), float(script.rng.uniform(-0.25, 0.45))
            reach = float(script.rng.uniform(0.4, 0.5))
            out = 0.18 + reach * np.cos(angle) * np.cos(ahead)
            wrist = [reach * np.cos(angle) * np.sin(ahead), out if side == 0 else -out, 1.4 + reach * np.sin(angle)]
            script.hand(side, np.array(wrist), seconds, advance=False)
            script.grip(side, float(script.rng.uniform(0.3, 1.0)), seconds)
        bow = float(script.rng.uniform(-0.18, 0.18)) if script.rng.random() < 0.4 else 0.0
        script.trunk(float(script.rng.uniform(-0.15, 0.15)), bow, seconds)
        script.wait(float(script.rng.uniform(0.3, 1.2)))
        raised = float(np.clip(raised + script.rng.uniform(-0.6, 0.6), -0.95, 0.85))
    _rest(script, sides, 0.9)
    if len(sides) == 2:
        return [
            "spreads both arms out to the sides",
            "holds both arms out sideways",
            "raises the arms on both sides of the body",
        ]
    name = _SIDES[sides[0]]
    return [
        f"holds the {name} arm out to the side",
        f"raises the {name} arm sideways",
        f"spreads the {name} arm away from the body",
    ]


def stretch(script: Script) -> Phrases:
    """Stretches with both hands above the head, bending to one side or both, or bends back."""
    ahead = np.array([0.44, 0.24, 1.35])  # hands rise and fall in front, not along the shoulders
    seconds = float(script.rng.uniform(1.2, 1.6))
    for side, sign in ((0, 1.0), (1, -1.0)):
        x, y, z = script.rng.uniform((0.0, 0.05, 1.7), (0.2, 0.35, 1.85))
        script.hand_path(side, [ahead * [1.0, sign, 1.0], np.array([x, sign * y, z])], seconds)
    script.posture(0.0, float(script.rng.uniform(-0.2, 0.05)), seconds)
    first = float(script.rng.choice((-1.0, 1.0)))
    for sign in (first, -first) if script.rng.random() < 0.5 else (first,):
        script.trunk(0.0, sign * float(script.rng.uniform(0.1, 0.3)), float(script.rng.uniform(0.6, 1.0)))
        script.wait(float(script.rng.uniform(0.1, 0.5)))
    script.trunk(0.0, 0.0, 0.8, advance=False)
    for side, sign in ((0, 1.0), (1, -1.0)):
        script.hand_path(side, [ahead * [1.0, sign, 1.0]], 0.8)
    script.wait(0.8)
    _rest(script, (0, 1), 0.8)
    return [
        "stretches both arms above the head",
        "reaches up high with both hands and bends sideways",
        "stretches the upper body",
    ]


def lift(script: Script) -> Phrases:
    """Lifts something with both hands."""
    height = _choice(script, list(HEIGHTS)[:3])
    left = _point(script, 0, height, float(script.rng.uniform(0.14, 0.24)))
    wrists = {0: left, 1: left * np.array([1.0, -1.0, 1.0])}
    for side in (0, 1):
        script.grip(side, 0.9)
    seconds = _slow(script, wrists)
    _go(script, wrists, seconds)
    for side in (0, 1):
        script.grip(side, 0.3)
    script.wait(0.35)
    _both(script, _held(script, float(left[1])), seconds)
    _stand(script, seconds)
    obj = _thing(script, 2)
    return [
        f"lifts {obj} {height} with both hands",
        f"picks up {obj} {height} using both arms",
        f"raises {obj} from {height[3:] if height.startswith('at ') else 'the floor'} with two hands",
    ]


def _along(script: Script, side: int, start_x: float, end_x: float) -> str:
    height = _choice(script, ["at waist height", "at chest height"])
    first = _point(script, side, height, 0.18)
    first[0] = start_x
    last = first.copy()
    last[0] = end_x
    _go(script, {side: first}, float(script.rng.uniform(0.7, 1.0)))
    script.grip(side, 0.2)
    script.wait(0.25)
    _go(script, {side: last}, float(script.rng.uniform(0.9, 1.3)))
    script.grip(side, 0.6)
    script.wait(0.25)
    _rest(script, (side,), 0.9)
    return height


def push(script: Script) -> Phrases:
    """Pushes with one hand."""
    side = int(script.rng.integers(2))
    height = _along(script, side, 0.24, 0.5)
    return [
        f"pushes something away with the {_SIDES[side]} hand {height}",
        f"pushes forward {height} using the {_SIDES[side]} arm",
    ]


def pull(script: Script) -> Phrases:
    """Pulls with one hand."""
    side = int(script.rng.integers(2))
    height = _along(script, side, 0.5, 0.24)
    return [
        f"pulls something closer with the {_SIDES[side]} hand {height}",
        f"pulls a drawer out {height} using the {_SIDES[side]} arm",
    ]


def _door_arc(script: Script, side: int, start_rad: float, end_rad: float) -> tuple[str, list[Array]]:
    """The name of a height, and points of a door's handle about a hinge on the hand's own side; 0 is shut."""
    sign = 1.0 if side == 0 else -1.0
    height = _choice(script, ["at waist height", "at chest height"])
    z = float(script.rng.uniform(*HEIGHTS[height]))
    hinge, radius = np.array([0.5, 0.42 * sign]), 0.4
    angles = np.linspace(start_rad, end_rad, 5)
    return height, [np.array([hinge[0] - radius * np.sin(a), hinge[1] - sign * radius * np.cos(a), z]) for a in angles]


def _sweep(script: Script, side: int, wrists: list[Array], seconds: float) -> None:
    """Leads one hand through points in one sweep."""
    script.hand_path(side, wrists, seconds)
    script.time_s += seconds


def open_door(script: Script) -> Phrases:
    """Swings a door open: the hand follows an arc about a hinge on its own side."""
    side = int(script.rng.integers(2))
    height, arc = _door_arc(script, side, 0.0, 0.8)
    script.grip(side, 1.0)
    _go(script, {side: arc[0]}, float(script.rng.uniform(0.8, 1.1)))
    script.grip(side, 0.1)
    script.wait(0.3)
    _sweep(script, side, arc[1:], float(script.rng.uniform(1.1, 1.6)))
    script.grip(side, 0.7)
    script.wait(0.2)
    _rest(script, (side,), 0.9)
    name, obj = _SIDES[side], _choice(script, ("a cabinet door", "a fridge", "a cupboard"))
    return [f"opens {obj} with the {name} hand", f"pulls {obj} open {height} with the {name} hand"]


def close_door(script: Script) -> Phrases:
    """Pushes a door shut along its arc."""
    side = int(script.rng.integers(2))
    height, arc = _door_arc(script, side, 0.8, 0.05)
    script.grip(side, 0.5)
    _go(script, {side: arc[0]}, float(script.rng.uniform(0.8, 1.1)))
    _sweep(script, side, arc[1:], float(script.rng.uniform(0.9, 1.4)))
    script.wait(0.2)
    _rest(script, (side,), 0.9)
    name, obj = _SIDES[side], _choice(script, ("a cabinet door", "a fridge", "a cupboard"))
    return [f"closes {obj} with the {name} hand", f"pushes {obj} shut {height} with the {name} hand"]


def pour(script: Script) -> Phrases:
    """Holds a vessel over another one and tilts it with a raised elbow; the other hand steadies, half of the time."""
    side = int(script.rng.integers(2))
    sign = 1.0 if side == 0 else -1.0
    level = float(script.rng.uniform(1.05, 1.2))
    steady = script.rng.random() < 0.5
    script.grip(side, 0.1)
    if steady:
        script.grip(1 - side, 0.2)
        script.hand(1 - side, np.array([0.36, 0.06 * -sign, level - 0.12]), 0.9, advance=False)
    script.hand(side, np.array([0.34, 0.2 * sign, level]), float(script.rng.uniform(0.8, 1.1)))
    seconds = float(script.rng.uniform(0.7, 1.1))
    script.elbow(side, float(script.rng.uniform(0.6, 1.0)), seconds)
    script.hand(side, np.array([0.38, 0.05 * sign, level + 0.1]), seconds)
    script.wait(float(script.rng.uniform(0.6, 1.4)))
    script.elbow(side, 0.0, 0.7)
    script.hand(side, np.array([0.32, 0.2 * sign, level]), 0.7)
    for one in (0, 1) if steady else (side,):
        script.hand(one, None, 0.9, advance=False)
    _stand(script, 0.9)
    name, obj = _SIDES[side], _choice(script, ("a bottle", "a kettle", "a jug"))
    return [
        f"pours something from {obj} with the {name} hand",
        f"holds {obj} in the {name} hand and tilts it to pour",
        f"fills a cup from {obj} using the {name} arm",
    ]


def wipe(script: Script) -> Phrases:
    """Wipes a surface to and fro with one hand."""
    side = int(script.rng.integers(2))
    sign = 1.0 if side == 0 else -1.0
    height = _choice(script, ["at knee height", "at waist height", "at waist height"])
    centre = _point(script, side, height, 0.15)
    script.grip(side, 0.3)
    _go(script, {side: centre}, float(script.rng.uniform(0.9, 1.3)))
    for _ in range(int(script.rng.integers(2, 5))):
        for shift in (0.13, -0.13):
            script.hand(side, centre + np.array([float(script.rng.uniform(-0.04, 0.04)), shift * sign, 0.0]), 0.35)
    _rest(script, (side,), 0.9)
    name, obj = _SIDES[side], _choice(script, ("a table", "a counter", "a surface"))
    return [
        f"wipes {obj} {height} with the {name} hand",
        f"cleans {obj} with the {name} hand, moving it to and fro",
        f"rubs over {obj} {height} using the {name} arm",
    ]


def put_down(script: Script) -> Phrases:
    """Sets down with both hands what they hold."""
    width = float(script.rng.uniform(0.12, 0.24))
    for side in (0, 1):
        script.grip(side, 0.3)
    _both(script, _held(script, width), 0.8)
    script.wait(0.8)
    height = _choice(script, list(HEIGHTS)[:3])
    left = _point(script, 0, height, width)
    wrists = {0: left, 1: left * np.array([1.0, -1.0, 1.0])}
    seconds = _slow(script, wrists)
    _go(script, wrists, seconds)
    for side in (0, 1):
        script.grip(side, 0.9)
    script.wait(0.35)
    _rest(script, (0, 1), seconds)
    obj = _thing(script, 2)
    return [
        f"sets {obj} down {height} with both hands",
        f"puts {obj} down {height} using both arms",
        f"lowers {obj} with two hands and lets go of it {height}",
    ]


def wave(script: Script) -> Phrases:
    """Waves with a raised hand."""
    side = int(script.rng.integers(2))
    sign = 1.0 if side == 0 else -1.0
    script.grip(side, 1.0)
    centre = np.array([0.2, 0.36 * sign, 1.62])
    script.hand(side, centre, 0.8)
    for _ in range(int(script.rng.integers(2, 4))):
        for shift in (0.12, -0.12):
            script.hand(side, centre + np.array([0.0, shift * sign, -0.02]), 0.3)
    script.hand(side, None, 0.9)
    name = _SIDES[side]
    return [f"waves with the {name} hand", f"raises the {name} arm and waves", f"greets by waving the {name} hand"]


ACTIVITIES: Final[Mapping[str, Activity]] = {
    "walk": walk,
    "walk_back": walk_back,
    "turn": turn,
    "side_step": side_step,
    "crouch": crouch,
    "bend": bend,
    "idle": idle,
    "reach": reach,
    "reach_both": reach_both,
    "pick": pick,
    "place": place,
    "carry": carry,
    "lift": lift,
    "push": push,
    "pull": pull,
    "open": open_door,
    "wave": wave,
    "close": close_door,
    "pour": pour,
    "wipe": wipe,
    "put_down": put_down,
    "look_around": look_around,
    "gesture": gesture,
    "roam": roam,
    "shift": shift,
    "spread": spread,
    "stretch": stretch,
}
#: Sequences that make sense together, besides each activity alone.
RECIPES: Final[tuple[tuple[str, ...], ...]] = (
    *((name,) for name in ACTIVITIES),
    ("walk", "reach"),
    ("walk", "pick"),
    ("turn", "walk"),
    ("walk", "turn"),
    ("pick", "walk"),
    ("pick", "turn"),
    ("lift", "turn"),
    ("carry", "turn"),
    ("side_step", "reach"),
    ("turn", "reach_both"),
    ("walk", "open"),
    ("walk", "place"),
    ("side_step", "place"),
    ("walk", "wave"),
    ("walk_back", "turn"),
    ("crouch", "walk"),
    ("reach", "reach_both"),
    ("turn", "push"),
    ("pull", "walk_back"),
    ("open", "pick"),
    ("pick", "close"),
    ("carry", "put_down"),
    ("lift", "put_down"),
    ("walk", "pour"),
    ("turn", "wipe"),
    ("look_around", "walk"),
    ("gesture", "walk"),
    ("walk", "gesture"),
    ("gesture", "reach"),
    ("roam", "reach"),
    ("lift", "roam"),
    ("pick", "roam"),
    ("roam", "gesture"),
    ("roam", "put_down"),
    ("roam", "walk"),
    ("lift", "shift"),
    ("carry", "shift"),
    ("lift", "carry"),
    ("spread", "walk"),
    ("walk", "spread"),
    ("spread", "gesture"),
    ("side_step", "spread"),
    ("stretch", "turn"),
    ("walk", "stretch"),
    ("turn", "gesture"),
    ("walk", "pick", "turn"),
    ("turn", "walk", "place"),
)
