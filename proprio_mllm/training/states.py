"""Object states as a log tells them: what a planner or judge may know without looking."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from data.interface.observation import HistoryItem
from data.interface.steps import Action, ActionError

__all__ = ["asked_relation", "history_of", "open_hands", "states_from_log"]

_SWITCHES: Final = {"Open": "open", "Close": "closed", "ToggleOn": "switched on", "ToggleOff": "switched off", "Lift": "lifted"}
_OPPOSITE: Final = {"open": "closed", "closed": "open", "switched on": "switched off", "switched off": "switched on"}


def history_of(row: Mapping[str, Any]) -> list[HistoryItem]:
    """The log of a shard's row."""
    return [HistoryItem(item["step"], item["feedback"]) for item in row["history"]]


def asked_relation(states: Mapping[str, Sequence[str]], rng: np.random.Generator) -> str:
    """A relation to ask about; mostly one in which some object is."""
    full = [name for name, things in states.items() if things]
    names = full if full and rng.random() < 0.7 else sorted(states)
    return names[int(rng.integers(len(names)))]


def _successes(history: Sequence[HistoryItem]) -> Iterator[Action]:
    """The actions of a log that were carried out, in order."""
    for item in history:
        for part in item.feedback.split(";"):
            text, _, result = part.strip().rpartition(" ")
            if result != "ok":
                continue
            try:
                yield Action.parse(text)
            except ActionError:
                continue


def open_hands(history: Sequence[HistoryItem]) -> tuple[bool, bool]:
    """Whether the left and the right hand are empty after a log that begins with empty hands."""
    empty = {"left": True, "right": True}
    for action in _successes(history):
        if action.name in ("Pick", "Place") and action.arm is not None:
            empty[action.arm.value] = action.name == "Place"
        elif action.name in ("Lift", "PlaceBoth"):
            empty = dict.fromkeys(empty, action.name == "PlaceBoth")
    return empty["left"], empty["right"]


def states_from_log(history: Sequence[HistoryItem]) -> dict[str, tuple[str, ...]]:
    """Objects in each relation according to the successful actions of a log.

    Relations: `held`, `lifted`, `open`, `closed`, `switched on`, `switched off`, and `on R` for receptacles R.
    """
    hands: dict[str, str] = {}
    lifted = ""
    found: dict[str, list[str]] = {name: [] for name in _SWITCHES.values()}

    def move(thing: str, place: str | None) -> None:
        for name, things in found.items():
            if name.startswith("on ") and thing in things:
                things.remove(thing)
        if place is not None:
            found.setdefault(f"on {place}", []).append(thing)

    for action in _successes(history):
        thing = action.object_id or ""
        if action.name == "Pick" and action.arm is not None:
            hands[action.arm.value] = thing
            move(thing, None)
        elif action.name == "Place" and action.arm is not None:
            held = hands.pop(action.arm.value, None)
            if held:
                move(held, thing)
        elif action.name == "PlaceBoth":
            if lifted:
                move(lifted, thing)
                found["lifted"] = []
            lifted = ""
        elif action.name in _SWITCHES:
            relation = _SWITCHES[action.name]
            if action.name == "Lift":
                lifted = thing
                move(thing, None)
            opposite = found.get(_OPPOSITE.get(relation, ""), [])
            if thing in opposite:
                opposite.remove(thing)
            if thing not in found[relation]:
                found[relation].append(thing)
    found["held"] = list(hands.values())
    return {name: tuple(things) for name, things in found.items()}
