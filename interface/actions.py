"""The table of actions: what each one occupies, takes, needs, does and can meet, and how it is told to a language model.

Everything that knows about actions reads this table: the parser and its grammar, the simulator's legality checks, the expert,
the text world, the planners' beliefs, prompts and manuals, and the catalogue. A new action is a row here and a skill in
`sim.skills`. Paper: the dual-arm action space of DualTHOR.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal

from interface import requirements as needs
from interface.effects import Become, Condition, Effect, Grasp, HoldOpen, LetGo, PutDown, Rise, Turn, Walk
from interface.facts import Call, Facts, Situation
from interface.failures import FailureCode
from interface.requirements import Requirement, need, where


class ActionKind(StrEnum):
    """What an action occupies: the whole body, one arm, both arms, or nothing (episode control)."""

    BODY = "body"
    ARM = "arm"
    TWO_ARM = "two_arm"
    EPISODE = "episode"


@dataclass(frozen=True, slots=True)
class Amount:
    """A number that an action takes.

    Attributes:
        name: what it is.
        unit: metres or degrees.
        low, high: closed range.
        default: what is used when none is given, None where the robot then chooses.
    """

    name: str
    unit: Literal["m", "deg"]
    low: float
    high: float
    default: float | None = None


@dataclass(frozen=True, slots=True)
class ActionSpec:
    """One action of the grammar.

    Attributes:
        name: AI2-THOR-style verb.
        kind: what the action occupies while it runs.
        meaning: what it does, for people and language models.
        takes_object: whether an object id is required.
        amounts: the optional numbers, in order.
        tool: what the acting hand has to hold, None when it needs no tool.
        beside: actions of the other arm that may be about the same object at the same time.
        requires: preconditions in the order in which they are checked.
        effects: what holds after it has succeeded; none for what changes nothing that anybody asks about.
        meets: failure codes that only moving tells.
    """

    name: str
    kind: ActionKind
    meaning: str
    takes_object: bool = False
    amounts: tuple[Amount, ...] = ()
    tool: Literal["cutter", "wiper", "vessel"] | None = None
    beside: tuple[str, ...] = ()
    requires: tuple[Requirement, ...] = ()
    effects: tuple[Effect, ...] = ()
    meets: tuple[FailureCode, ...] = ()

    @property
    def amount(self) -> Amount | None:
        """The first number, None when it takes none."""
        return self.amounts[0] if self.amounts else None

    @property
    def arms(self) -> int:
        """Arms that it occupies."""
        return {ActionKind.ARM: 1, ActionKind.TWO_ARM: 2}.get(self.kind, 0)

    @property
    def codes(self) -> tuple[FailureCode, ...]:
        """Every failure code that it can meet."""
        unknown = (FailureCode.OBJECT_NOT_KNOWN,) if self.takes_object else ()
        parallel = (FailureCode.ARM_CONFLICT,) if self.kind is ActionKind.ARM else ()
        return tuple(dict.fromkeys((*unknown, *parallel, *(one.code for one in self.requires), *self.meets)))

    def has_effect(self, *kinds: type[Effect]) -> bool:
        """Whether it has an effect of one of some kinds."""
        return any(isinstance(effect, kinds) for effect in self.effects)


_C = FailureCode
_REACH = (_C.TOO_FAR, _C.BODY_TOO_HIGH, _C.BODY_TOO_LOW, _C.OBSTRUCTED)
_NOTHING = (_C.NOTHING_HAPPENED,)


def _walk(name: str, meaning: str, unit: Literal["m", "deg"]) -> ActionSpec:
    amount = Amount("distance", "m", 0.05, 5.0, 0.25) if unit == "m" else Amount("angle", "deg", 5.0, 180.0, 90.0)
    effect = Walk() if unit == "m" else Turn()
    return ActionSpec(
        name, ActionKind.BODY, meaning, amounts=(amount,), requires=needs.BASE_FREE, effects=(effect,), meets=(_C.BLOCKED_PATH,)
    )


def _legs(name: str, meaning: str, sign: Literal[-1, 1]) -> ActionSpec:
    amount = Amount("height", "m", 0.01, 1.0, 0.1)
    return ActionSpec(
        name, ActionKind.BODY, meaning, amounts=(amount,), requires=needs.BASE_FREE, effects=(Rise(sign),),
        meets=(_C.HEIGHT_LIMIT,),
    )  # fmt: skip


def _door(name: str, meaning: str, opening: bool) -> ActionSpec:
    return ActionSpec(
        name,
        ActionKind.ARM,
        meaning,
        takes_object=True,
        requires=(
            *needs.FREE_HAND,
            *need(_C.NOT_OPENABLE, lambda s: s.target.can.openable),
            *need(_C.IN_USE, lambda s: not s.target.holders),
            *need(_C.ALREADY_IN_STATE, lambda s: not (s.target.opened if opening else s.target.closed)),
        ),
        effects=(Become(Condition.OPEN, opening), *((HoldOpen(),) if opening else ())),
        meets=(*_REACH, _C.BLOCKED_PATH, _C.GRASP_MISSED, _C.HANDLE_SLIPPED, _C.LOCKED, *_NOTHING),
    )


def _switch(name: str, meaning: str, on: bool) -> ActionSpec:
    return ActionSpec(
        name,
        ActionKind.ARM,
        meaning,
        takes_object=True,
        requires=(
            *needs.FREE_HAND,
            *need(_C.NOT_TOGGLEABLE, lambda s: s.target.can.toggleable),
            *need(_C.ALREADY_IN_STATE, lambda s: s.target.on != on),
            *needs.NOT_BROKEN,
            *need(_C.OBSTRUCTED, lambda s: not s.target.covered),
        ),
        effects=(Become(Condition.ON, on),),
        meets=(*_REACH, _C.GRASP_MISSED, *_NOTHING),
    )


_TABLE: Final = (
    ActionSpec(
        "GoTo",
        ActionKind.BODY,
        "walk to a known object or piece of furniture; the distance to it and its bearing on arrival may be left out",
        takes_object=True,
        amounts=(Amount("distance", "m", 0.2, 2.0), Amount("bearing", "deg", -180.0, 180.0)),
        requires=needs.BASE_FREE,
        effects=(Walk(to_target=True),),
        meets=(_C.BLOCKED_PATH, _C.NO_FREE_POSE),
    ),
    _walk("MoveAhead", "walk forward", "m"),
    _walk("MoveBack", "walk backward", "m"),
    _walk("MoveLeft", "step to the left", "m"),
    _walk("MoveRight", "step to the right", "m"),
    _walk("RotateLeft", "turn to the left, the view turns too", "deg"),
    _walk("RotateRight", "turn to the right, the view turns too", "deg"),
    _legs("MoveUp", "raise the pelvis by stretching the legs", 1),
    _legs("MoveDown", "lower the pelvis by bending the legs", -1),
    ActionSpec(
        "Pick",
        ActionKind.ARM,
        "take an object into the empty hand",
        takes_object=True,
        requires=needs.FREE_HAND + needs.ONE_HAND_LOAD,
        effects=(Grasp(),),
        meets=(*_REACH, _C.GRASP_MISSED, _C.DROPPED, _C.SLIPPED, _C.BROKE, _C.SPILLED, *_NOTHING),
    ),
    ActionSpec(
        "Place",
        ActionKind.ARM,
        "put what the hand holds on or in a receptacle",
        takes_object=True,
        beside=("Place",),
        requires=needs.HAND_HOLDS + needs.FREE_RECEPTACLE,
        effects=(PutDown(),),
        meets=(*_REACH, _C.RECEPTACLE_FULL, _C.PLACE_MISSED, _C.BROKE, _C.SPILLED, *_NOTHING),
    ),
    _door("Open", "open a door, drawer, lid or the like", opening=True),
    _door("Close", "close it", opening=False),
    _switch("ToggleOn", "switch a thing on", on=True),
    _switch("ToggleOff", "switch it off", on=False),
    ActionSpec(
        "Hold",
        ActionKind.ARM,
        "steady an object with the empty hand while the other one works on it",
        takes_object=True,
        beside=("Slice", "Clean", "Pour"),
        requires=(
            *needs.FREE_HAND,
            *where(lambda s: s.target.can.movable, needs.ONE_HAND_LOAD),
            *need(_C.NOT_PICKUPABLE, lambda s: s.target.can.movable or s.target.can.openable),
            *need(_C.ALREADY_HELD, lambda s: not s.target.holders),
        ),
        effects=(Grasp(in_place=True),),
        meets=(*_REACH, _C.GRASP_MISSED, *_NOTHING),
    ),
    ActionSpec(
        "Release",
        ActionKind.ARM,
        "let go of what the hand steadies or holds",
        requires=needs.ANY_HOLD,
        effects=(LetGo(),),
    ),
    ActionSpec(
        "Slice",
        ActionKind.ARM,
        "cut an object with the knife in the hand; what would roll away needs the other hand to Hold it",
        takes_object=True,
        tool="cutter",
        beside=("Hold",),
        requires=(
            *needs.HAND_HOLDS,
            *need(_C.NEEDS_TOOL, lambda s: s.tool.can.cutter),
            *need(_C.NOT_SLICEABLE, lambda s: s.target.can.sliceable),
            *need(_C.ALREADY_IN_STATE, lambda s: not s.target.sliced),
            *need(_C.IN_USE, lambda s: s.arm.value not in s.target.holders),
            *needs.ACCESSIBLE,
            *needs.STEADY,
        ),
        effects=(Become(Condition.SLICED, True),),
        meets=(*_REACH, _C.TOOL_MISSED, *_NOTHING),
    ),
    ActionSpec(
        "Clean",
        ActionKind.ARM,
        "wipe a dirty object with the sponge or towel in the hand",
        takes_object=True,
        tool="wiper",
        beside=("Hold",),
        requires=(
            *needs.HAND_HOLDS,
            *need(_C.NEEDS_TOOL, lambda s: s.tool.can.wiper),
            *need(_C.NOT_DIRTY, lambda s: s.target.soiled),
            *need(_C.IN_USE, lambda s: s.target.object_id != s.tool.object_id),
            *needs.ACCESSIBLE,
            *needs.STEADY,
        ),
        effects=(Become(Condition.DIRTY, False),),
        meets=(*_REACH, _C.TOOL_MISSED, *_NOTHING),
    ),
    ActionSpec(
        "UseUp",
        ActionKind.ARM,
        "use an object up",
        takes_object=True,
        requires=(
            *needs.FREE_HAND,
            *need(_C.NOT_USABLE, lambda s: s.target.can.consumable),
            *need(_C.ALREADY_IN_STATE, lambda s: not s.target.used_up),
            *needs.ACCESSIBLE,
        ),
        effects=(Become(Condition.USED_UP, True),),
        meets=(*_REACH, _C.TOOL_MISSED, *_NOTHING),
    ),
    ActionSpec(
        "Pour",
        ActionKind.ARM,
        "pour what the vessel in the hand holds into the target",
        takes_object=True,
        tool="vessel",
        beside=("Hold",),
        requires=(
            *needs.VESSEL,
            *need(_C.EMPTY, lambda s: s.tool.fill > 0.0),
            *need(_C.NOT_FILLABLE, lambda s: s.target.can.fillable and s.target.object_id != s.tool.object_id),
            *needs.NOT_BROKEN,
            *need(_C.IN_USE, lambda s: s.arm.other.value not in s.target.holders),
            *need(_C.ALREADY_IN_STATE, lambda s: not s.target.full),
            *needs.ACCESSIBLE,
        ),
        effects=(Become(Condition.FILLED, True), Become(Condition.FILLED, None, "tool")),
        meets=(*_REACH, _C.POUR_MISSED, _C.SPILLED),
    ),
    ActionSpec(
        "Fill",
        ActionKind.ARM,
        "hold the vessel in the hand under a running source, the target, and fill it",
        takes_object=True,
        tool="vessel",
        requires=(
            *needs.VESSEL,
            *need(_C.OBJECT_BROKEN, lambda s: not s.tool.broken),
            *need(_C.ALREADY_IN_STATE, lambda s: not s.tool.full),
            *need(_C.NOT_FILLABLE, lambda s: s.target.outlet is not None),
            *need(_C.SOURCE_OFF, lambda s: s.facts.objects[s.target.outlet or ""].on is not False),
        ),
        effects=(Become(Condition.FILLED, True, "tool"),),
        meets=(*_REACH, _C.POUR_MISSED, _C.SPILLED, *_NOTHING),
    ),
    ActionSpec(
        "ResetArm",
        ActionKind.ARM,
        "bring the arm back to rest",
        requires=(
            *need(_C.BOTH_HANDS_BUSY, lambda s: s.facts.lifted is None),
            *need(_C.IN_USE, lambda s: (name := s.facts.held[s.arm]) is None or s.facts.objects[name].can.movable),
        ),
        meets=(_C.OBSTRUCTED,),
    ),
    ActionSpec(
        "Lift",
        ActionKind.TWO_ARM,
        "lift an object that is too big for one hand with both; both have to be empty",
        takes_object=True,
        requires=needs.BOTH_FREE + needs.TWO_HAND_LOAD,
        effects=(Grasp(),),
        meets=(*_REACH, _C.GRASP_MISSED, _C.DROPPED, _C.SLIPPED, _C.SPILLED, *_NOTHING),
    ),
    ActionSpec(
        "PlaceBoth",
        ActionKind.TWO_ARM,
        "put what both hands hold on a receptacle",
        takes_object=True,
        requires=needs.BOTH_HOLD + needs.FREE_RECEPTACLE,
        effects=(PutDown(),),
        meets=(*_REACH, _C.RECEPTACLE_FULL, _C.PLACE_MISSED, *_NOTHING),
    ),
    ActionSpec("Done", ActionKind.EPISODE, "end the task; only when it is done"),
)

#: Every action that a planner may use, by name.
ACTIONS: Final[Mapping[str, ActionSpec]] = {spec.name: spec for spec in _TABLE}


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why an action cannot be carried out from here.

    Attributes:
        code: the requirement that does not hold.
        margins: signed quantities that explain it.
    """

    code: FailureCode
    margins: Mapping[str, float]


def first_refusal(call: Call, facts: Facts) -> Refusal | None:
    """The first requirement of an action that does not hold, None when all do; the target has to exist."""
    situation = Situation(facts, call)
    for one in ACTIONS[call.name].requires:
        if not one.holds(situation):
            return Refusal(one.code, {} if one.margin is None else {one.margin[0]: one.margin[1](situation)})
    return None


def given_amount(call: Call) -> float:
    """The amount of an action or its default, metres or degrees; 0 for actions without one."""
    if call.amount is not None:
        return call.amount
    amount = ACTIONS[call.name].amount
    return 0.0 if amount is None else amount.default or 0.0


def exclude_each_other(first: Call, second: Call) -> bool:
    """Whether two arm actions want one object and cannot share it."""
    same = first.object_id is not None and first.object_id == second.object_id
    return same and second.name not in ACTIONS[first.name].beside


def bringing_about(condition: Condition, value: bool) -> Iterator[ActionSpec]:
    """The actions that bring an object into a state, in the order of the table."""
    for spec in ACTIONS.values():
        if any(
            isinstance(effect, Become) and (effect.condition, effect.value) == (condition, value) for effect in spec.effects
        ):
            yield spec
