"""What an instruction asks for: its clauses turned into goals, by key words and their order.

Verbs are read from left to right: a verb takes the things after it, a preposition the place after it, `it` what was spoken of
last. What is only a means to something else that is asked for is no goal: fetching what shall be put down, opening what
something is put into.

Paper: natural-language instructions of the DualTHOR tasks; the reading is a reference planner's, not the paper's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

from proprio_mllm.planners.scripted.idioms import INTO, KIND_OF, PREPOSITIONS, Sentence, read_sentence
from proprio_mllm.planners.scripted.words import Mention, find_mentions

#: Names of what slices and what wipes.
TOOLS: Final = {"sliced": ("knife", "butterknife"), "clean": ("dishsponge", "handtowel")}


@dataclass(frozen=True, slots=True)
class Goal:
    """One thing that shall be so.

    Attributes:
        kind: `held`, `on` (or in), `lifted`, `open`, `closed`, `toggled_on`, `toggled_off`, `sliced`, `clean`, `cooked`,
            `filled` or `used_up`.
        obj: what it is about.
        place: for `on`, where to; for `filled` and `cooked`, where it is done; None when nothing is said.
        tool: for `sliced` and `clean` the tool, for `filled` the vessel that is poured from.
        ajar: for `closed`, whether the door falls shut by itself.
    """

    kind: str
    obj: Mention
    place: Mention | None = None
    tool: Mention | None = None
    ajar: bool = False


def read_goals(instruction: str, ids: Iterable[str] = ()) -> tuple[Goal, ...]:
    """The goals of an instruction, in its order; none when it asks for nothing that is understood.

    Args:
        instruction: any text.
        ids: ids whose types are names of things, beside the common ones.
    """
    return _Reader(read_sentence(*find_mentions(instruction, ids))).goals()


class _Reader:
    """Reads one instruction."""

    def __init__(self, sentence: Sentence) -> None:
        self.said = sentence
        self.found: list[Goal] = []
        self.verb = ""
        self.objs: list[Mention] = []
        self.place: Mention | None = sentence.door
        self.tool: Mention | None = None

    def goals(self) -> tuple[Goal, ...]:
        """Reads the verbs from left to right."""
        preposition = ""
        for word in self.said.text.split():
            if word.startswith("<"):
                self._group([self.said.mentions[int(index)] for index in word[1:-1].split("+")], preposition)
            elif word in ("it", "them", "both"):
                self._pronoun(preposition, word)
            elif word in KIND_OF or word == "filled":
                self._take_verb(word)
            elif word in PREPOSITIONS:
                if preposition == "inside" or (word == "inside" and self.place is not None and self.said.ajar):
                    self._put_in(self.place)
                preposition = word
                continue
            elif word in (";", ","):
                self.verb = "" if self.verb == "state" else self.verb
            preposition = ""
        return self._judged()

    def _take_verb(self, word: str) -> None:
        if word == "filled":
            before, self.verb = self.verb, "filled"
            self._emit(self.objs[-1:])
            self.verb = before
            return
        self.verb = KIND_OF[word]
        if word in ("go", "goes") and not self.objs:
            self.verb = ""

    def _group(self, group: list[Mention], preposition: str) -> None:
        if preposition in ("with", "using"):
            self.tool = group[0]
            self.found = [replace(g, tool=g.tool or group[0]) if g.kind in TOOLS else g for g in self.found]
        elif preposition == "from":
            self._from(group[0])
        elif preposition == "at" or (preposition in INTO and self._done_there(preposition)):
            self.found = [replace(g, place=group[0]) if g.kind == self.verb else g for g in self.found]
        elif preposition in INTO:
            self._put_in(group[0])
        else:
            self.objs = _merged(group)
            if self.verb not in ("", "on", "state"):
                self._emit(self.objs)

    def _done_there(self, preposition: str) -> bool:
        """Whether a preposition tells where something is done, not where it is put or poured."""
        pours = preposition in ("into", "in") and not any(goal.kind == "filled" for goal in self.found)
        return self.verb == "cooked" or (self.verb == "filled" and not pours)

    def _from(self, source: Mention) -> None:
        self.found = [replace(g, tool=source) if g.kind == "filled" else g for g in self.found]
        self.tool = source

    def _put_in(self, place: Mention | None) -> None:
        """What a preposition does with the thing after it."""
        if place is None:
            return
        if self.verb == "filled":  # pour from <b> into <a>
            self.objs = [place]
            self._emit(self.objs)
        elif self.verb == "state":
            self.found = [g for g in self.found if g.obj not in self.objs]
            self.objs = [replace(obj, place=place) for obj in self.objs]
        elif self.verb in ("on", "held", "lifted"):
            self.found += [Goal("on", obj, place) for obj in self.objs if obj != place]
        if self.verb == "":  # go to it
            self.objs = [place]
        else:
            self.place = place

    def _pronoun(self, preposition: str, word: str) -> None:
        if preposition in INTO:
            self._put_in(self.place or (self._opened() if self.verb == "on" else None))
        elif preposition == "from":
            held = [goal.obj for goal in self.found if goal.kind == "held"]
            if held:
                self._from(held[-1])
        elif self.verb in ("closed", "open"):
            self._emit([self.place] if self.place is not None else self.objs[-1:])
        elif word == "both" and not preposition:
            return
        elif self.verb not in ("", "on", "state"):
            self._emit(self.objs)

    def _opened(self) -> Mention | None:
        return next((goal.obj for goal in reversed(self.found) if goal.kind == "open"), None)

    def _emit(self, objs: list[Mention]) -> None:
        for obj in objs:
            tool = self.tool if self.verb in (*TOOLS, "filled") and self.tool != obj else None
            self.found.append(Goal(self.verb, obj, None, tool))

    # ---- what is asked for, and what is only a means

    def _judged(self) -> tuple[Goal, ...]:
        goals = [replace(g, kind="lifted") if self.said.heavy and g.kind == "held" else g for g in self.found]
        work = {g.obj for g in goals if g.kind in ("sliced", "clean", "cooked", "filled", "used_up")}
        put = {g.obj for g in goals if g.kind == "on"}
        places = {g.place for g in goals if g.kind == "on"} | {g.obj.place for g in goals}
        filled = {g.obj for g in goals if g.kind == "filled"}
        tools = {g.tool for g in goals if g.tool is not None}
        kept: list[Goal] = []
        for goal in goals:
            if goal.kind in ("held", "lifted") and (goal.obj in put | tools or (goal.obj in work)):
                continue
            if goal.kind == "held" and any(g.kind in TOOLS and goal.obj.name in TOOLS[g.kind] for g in goals):
                goals = [replace(g, tool=goal.obj) if g.kind in TOOLS and g.tool is None else g for g in goals]
                kept = [replace(g, tool=goal.obj) if g.kind in TOOLS and g.tool is None else g for g in kept]
                continue
            if goal.kind == "open" and goal.obj in places:
                continue
            if goal.kind == "on" and goal.obj in filled:
                kept = [replace(g, place=goal.place) if g.kind == "filled" and g.place is None else g for g in kept]
                continue
            kept.append(goal)
        for goal in [g for g in kept if g.kind == "filled" and g.tool is not None and self.said.in_hands]:
            assert goal.tool is not None
            kept += [Goal("held", goal.obj), Goal("held", goal.tool)]
        spots = {g.obj: g.place for g in kept if g.kind == "on"}
        kept = [replace(g, place=spots[g.obj]) if g.kind == "cooked" and not g.place and g.obj in spots else g for g in kept]
        kept += [Goal("on", g.obj, g.place) for g in kept if g.kind == "cooked" and g.place and g.obj not in put]
        if self.said.level:
            kept += [Goal("filled", g.obj) for g in kept if g.kind == "on"]
        if self.said.ajar:
            kept = self._behind_door(kept)
        if not goals and self.verb == "on":  # bring it, to nowhere in particular
            kept += [Goal("held", obj) for obj in self.objs]
        return tuple(dict.fromkeys(kept))

    def _behind_door(self, goals: list[Goal]) -> list[Goal]:
        """With the door that shuts by itself closed in the end; what is taken, and said to be nowhere else, is behind it."""
        for goal in goals:
            door = goal.place if goal.kind == "on" else self.said.door or goal.obj.place or self.place
            if door is not None:
                inside = [
                    replace(one, obj=replace(one.obj, place=door)) if one.kind == "held" and one.obj.place is None else one
                    for one in goals
                ]
                return [*inside, Goal("closed", door, ajar=True)]
        return goals


def _merged(group: list[Mention]) -> list[Mention]:
    """A group without what is said again with more words: `the pot, the pot from the table`."""
    return [one for one in group if not any(one is not two and _vaguer(one, two) for two in group)]


def _vaguer(one: Mention, two: Mention) -> bool:
    return one.name == two.name and one.ordinal == two.ordinal and one.place is None and two.place is not None
