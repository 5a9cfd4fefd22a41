"""Contingencies, seeded: outcome distributions of skills by object type and state, and the three difficulties.

A draw is a pure function of (seed, step, action, object): every planner that does the same thing at the same step of the same
trial meets the same contingencies, and no generator has to be carried around or saved. Outcomes are drawn after an action has
proved geometrically and logically possible; the skill then acts them out in the physics.

Paper: stochastic contingencies (the cup with 80/10/10 success, spilled, broken) and the difficulties easy, medium, hard with
100, 50 and 20 % success of low-level skills. Body movements are not subject to contingencies here: the paper's table of rates
gives them 98 % and more.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import yaml

import configs
from configs.assets import asset_files
from configs.validate import build
from interface.actions import ACTIONS
from interface.effects import PutDown
from interface.failures import FailureCode
from interface.steps import Action

#: Outcomes that are no success and that skills know how to act out, with the code that the log then has.
CODES: Final[Mapping[str, FailureCode]] = {
    "slipped": FailureCode.SLIPPED,
    "spilled": FailureCode.SPILLED,
    "broken": FailureCode.BROKE,
    "nothing": FailureCode.NOTHING_HAPPENED,
    "locked": FailureCode.LOCKED,
}
OUTCOMES: Final = ("success", *CODES)
DIFFICULTIES: Final = ("easy", "medium", "hard", "natural")


@dataclass(frozen=True)
class OutcomeRule:
    """Distribution of outcomes under some conditions.

    Attributes:
        actions: action names the rule is for.
        types: object types the rule is for; empty means all.
        state: values of object metadata that must hold.
        outcomes: probability per outcome; sums to 1 and contains `success`.
    """

    actions: tuple[str, ...]
    types: tuple[str, ...]
    state: dict[str, bool]
    outcomes: dict[str, float]

    def __post_init__(self) -> None:
        unknown = sorted(set(self.actions) - set(ACTIONS))
        if unknown:
            raise ValueError(f"contingency rule names unknown actions {unknown}; allowed: {', '.join(ACTIONS)}")
        unknown = sorted(set(self.outcomes) - set(OUTCOMES))
        if unknown:
            raise ValueError(f"contingency rule names unknown outcomes {unknown}; allowed: {', '.join(OUTCOMES)}")
        total = sum(self.outcomes.values())
        if "success" not in self.outcomes or len(self.outcomes) < 2 or abs(total - 1.0) > 1e-9:
            raise ValueError(f"outcomes must hold success, one more, and sum to 1, got {self.outcomes} (sum {total:g})")

    def matches(self, action: str, object_type: str, state: Mapping[str, object]) -> bool:
        """Whether the rule is for this action on an object of this type and state."""
        return (
            action in self.actions
            and (not self.types or object_type in self.types)
            and all(state.get(name, False) == value for name, value in self.state.items())
        )


@dataclass(frozen=True)
class ContingencyConfig:
    """Rules, first match decides, and the probability of success per difficulty (None: the rule's own)."""

    difficulties: dict[str, float | None]
    rules: tuple[OutcomeRule, ...]

    def __post_init__(self) -> None:
        if set(self.difficulties) != set(DIFFICULTIES):
            raise ValueError(f"difficulties must be {DIFFICULTIES}, got {sorted(self.difficulties)}")
        for name, rate in self.difficulties.items():
            if rate is not None and not 0.0 <= rate <= 1.0:
                raise ValueError(f"success rate of difficulty {name!r} must lie in [0, 1], got {rate}")


def load_contingency(name: str = "default") -> ContingencyConfig:
    """Reads `configs/contingency/<name>.yaml`, or that of one's own assets (`configs.assets`).

    Raises:
        ValueError: when there is no such file.
    """
    files = asset_files("contingency", Path(configs.__file__).parent / "contingency")
    if name not in files:
        raise ValueError(f"no contingency config {name!r}; allowed: {', '.join(sorted(files))}")
    return build(ContingencyConfig, yaml.safe_load(files[name].read_text(encoding="utf-8")), files[name].name)


def subject_of(action: Action, held: str | None) -> str:
    """Id of the object whose rule decides an action's outcome: what is put down or poured, else what the action names.

    Args:
        action: the action.
        held: what its arm holds, or both do.
    """
    hands = action.spec.has_effect(PutDown) or action.spec.tool == "vessel"
    return (held if hands else None) or action.object_id or ""


def _uniform(seed: int, step: int, action: str, object_id: str) -> float:
    """A number in [0, 1) that depends on the key only."""
    key = f"{seed}|{step}|{action}|{object_id}".encode()
    return int.from_bytes(hashlib.blake2b(key, digest_size=8).digest(), "big") / 2.0**64


@dataclass(frozen=True)
class Contingency:
    """The contingencies of one trial.

    Attributes:
        config: rules and difficulties.
        difficulty: a key of `config.difficulties`.
        seed: key of the trial's contingencies.
    """

    config: ContingencyConfig
    difficulty: str
    seed: int

    def __post_init__(self) -> None:
        if self.difficulty not in self.config.difficulties:
            raise ValueError(f"unknown difficulty {self.difficulty!r}; allowed: {', '.join(self.config.difficulties)}")

    def distribution(self, action: str, object_type: str, state: Mapping[str, object]) -> dict[str, float]:
        """Probability per outcome of an action; actions without a rule always succeed."""
        rule = next((rule for rule in self.config.rules if rule.matches(action, object_type, state)), None)
        if rule is None:
            return {"success": 1.0}
        own = rule.outcomes["success"]
        rate = self.config.difficulties[self.difficulty]
        rate = own if rate is None else rate
        rest = 1.0 - own
        shares = {name: p * (1.0 - rate) / rest for name, p in rule.outcomes.items() if name != "success"}
        return {"success": rate} | shares

    def draw(self, step: int, action: str, object_id: str, object_type: str, state: Mapping[str, object]) -> str:
        """The outcome of an action at a step, the same whenever it is asked."""
        u = _uniform(self.seed, step, action, object_id)
        cumulative = 0.0
        outcome = "success"
        for name, p in self.distribution(action, object_type, state).items():
            outcome = name  # the last one, should rounding leave u above the sum
            cumulative += p
            if u < cumulative:
                break
        return outcome
