"""Object states as a log tells them: what a planner or judge may know without looking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from interface.effects import Condition
from interface.observation import HistoryItem
from interface.symbolic import SymbolicState, events_of

#: States that are asked about, by the words for being in them and for not.
_WORDS: Final[Mapping[Condition, tuple[str, str]]] = {
    Condition.OPEN: ("open", "closed"),
    Condition.ON: ("switched on", "switched off"),
    Condition.SLICED: ("sliced", ""),
    Condition.DIRTY: ("", "clean"),
    Condition.USED_UP: ("used up", ""),
    Condition.FILLED: ("filled", ""),
}


def history_of(row: Mapping[str, Any]) -> list[HistoryItem]:
    """The log of a shard's row."""
    return [HistoryItem(item["step"], item["feedback"]) for item in row["history"]]


def asked_relation(states: Mapping[str, Sequence[str]], rng: np.random.Generator) -> str:
    """A relation to ask about; mostly one in which some object is."""
    full = [name for name, objs in states.items() if objs]
    names = full if full and rng.random() < 0.7 else sorted(states)
    return names[int(rng.integers(len(names)))]


def states_from_log(history: Sequence[HistoryItem]) -> dict[str, tuple[str, ...]]:
    """Objects in each relation according to the successful actions of a log.

    Relations: `held`, `lifted`, `open`, `closed`, `switched on`, `switched off`, `sliced`, `clean`, `used up`, `filled`, and
    `on R` for receptacles R.
    """
    state = SymbolicState()
    for events in events_of(history):
        for event in events:
            if event.ok:
                state.succeed(event.action)
    found: dict[str, list[str]] = {word: [] for words in _WORDS.values() for word in words if word}
    for condition, (yes, no) in _WORDS.items():
        for obj, value in state.conditions[condition].items():
            if word := yes if value else no:
                found[word].append(obj)
    for obj, place in state.at.items():
        found.setdefault(f"on {place}", []).append(obj)
    found["lifted"] = [] if state.lifted is None else [state.lifted]
    found["held"] = [item for item in state.held.values() if item is not None]
    return {name: tuple(objs) for name, objs in found.items()}
