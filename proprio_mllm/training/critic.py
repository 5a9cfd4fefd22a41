"""The critic of SELU: judges goals, asks itself about states, and turns trajectories into its own and the actor's examples.

The critic is the same model under another LoRA adapter. It reads the view, the log and the motion tokens of a moment as a
planner does, and says `Done` where the goal holds; the simulator's truth reaches it only in the labelled ablation
`truth=oracle`. Formats and filters that the abstract of SELU leaves open are ours: cutting a trajectory at the first moment at
which a rewritten goal holds, dropping failed steps as targets, caps per class.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from interface.actions import ActionKind
from interface.steps import Action, PlanStep
from proprio_mllm.model.batch import Example
from proprio_mllm.model.building import use_adapter
from proprio_mllm.model.chat import Message
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.observing import EpisodeLog, pictured_turn
from proprio_mllm.model.prompts import Style, answers, self_ask_prompt
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import answer_words, reflection_words, verdict_words
from proprio_mllm.training.asking import replies
from proprio_mllm.training.goals import VERBS, Relabel, relabel, verbs_of
from proprio_mllm.training.judging import LOG_LENGTH, verdict_example
from proprio_mllm.training.rollouts import Rollout

Motion = Sequence[int] | None


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A rollout with the motion tokens of every moment (None leaves proprioception out)."""

    rollout: Rollout
    motion: tuple[Motion, ...]


@dataclass(frozen=True, slots=True)
class CriticExample:
    """One row of the critic's training set: `kind` says where its answer comes from."""

    kind: Literal["direct", "relabel", "negative", "ask"]
    episode: str
    example: Example


@dataclass(frozen=True, slots=True)
class Kept:
    """A trajectory that the actor learns: its goal, and the moment at which the goal first held."""

    trajectory: Trajectory
    goal: str
    end: int
    relabelled: bool


class Judge:
    """What SELU needs of a critic."""

    def completed(self, queries: Sequence[tuple[Trajectory, int, str]]) -> list[bool]:
        """Whether each goal holds at a moment of a trajectory."""
        raise NotImplementedError

    def ask(self, trajectory: Trajectory, relation: str) -> str:
        """Ids of the objects in a relation at the end, as `prompts.answers` writes them."""
        raise NotImplementedError


class ModelJudge(Judge):
    """The critic adapter of the model.

    Args:
        model: the model; its active adapter is switched to the critic's for every call.
        adapter: name of the critic's adapter.
    """

    def __init__(self, model: ProprioMLLM, adapter: str = "critic") -> None:
        self._model, self._adapter = model, adapter
        self._said: dict[tuple[str, int, str], bool] = {}

    def completed(self, queries: Sequence[tuple[Trajectory, int, str]]) -> list[bool]:
        """Whether it says that it is done; any other word is no. It is asked once and remembers what it said."""
        asked = {(t.rollout.episode, at, goal): (t, at, goal) for t, at, goal in queries}
        new = {key: verdict(self._model, *query) for key, query in asked.items() if key not in self._said}
        self._said |= zip(new, self.agrees(list(new.values())), strict=True)
        return [self._said[t.rollout.episode, at, goal] for t, at, goal in queries]

    def agrees(self, asked: Sequence[Example]) -> list[bool]:
        """Whether it says that it is done in `judging.verdict_example`s without their answers."""
        done = verdict_words(True)[0]
        length = len(tokens_of(self._model.processor.tokenizer).tokens([done]))
        return [reply == done for reply in self._reply(asked, length)]

    def ask(self, trajectory: Trajectory, relation: str) -> str:
        """Greedy reply to a self-asked question."""
        at = trajectory.rollout.length
        example = Example(ask_prompt(trajectory, relation, self._model.cfg.prompt), (trajectory.rollout.view(at),))
        return self._reply([example], 24)[0]

    def _reply(self, asked: Sequence[Example], tokens: int) -> list[str]:
        use_adapter(self._model.eval(), self._adapter)
        return replies(self._model, asked, tokens)


class OracleJudge(Judge):
    """The simulator's truth, for the labelled ablation and for audits; knows the end of a trajectory only."""

    def __init__(self, goals: Mapping[tuple[str, str], Relabel]) -> None:
        self._goals = goals

    def completed(self, queries: Sequence[tuple[Trajectory, int, str]]) -> list[bool]:
        """The original goal by the simulator's verdict, relabelled ones by the object relations at the end."""
        return [at == t.rollout.length and self.truth(t.rollout, goal) is True for t, at, goal in queries]

    def truth(self, rollout: Rollout, goal: str) -> bool | None:
        """Whether a goal holds at the end; None when the row does not say."""
        if goal == rollout.instruction:
            return rollout.success
        found = self._goals.get((rollout.episode, goal))
        if found is None or rollout.relations is None:
            return None
        held = rollout.relations
        return all(obj in held.get(VERBS[verb].relation.format(place), ()) for verb, obj, place in found.parts)

    def ask(self, trajectory: Trajectory, relation: str) -> str:
        """The relation's objects at the end that the robot knows of."""
        rollout = trajectory.rollout
        known = set(rollout.moments[-1].known)
        return answers([name for name in (rollout.relations or {}).get(relation, ()) if name in known])


def verdict(model: ProprioMLLM, t: Trajectory, at: int, goal: str, done: bool | None = None) -> Example:
    """`judging.verdict_example` about a moment."""
    return verdict_example(model, t.rollout.shown(at, goal), t.rollout.view(at), t.motion[at], done)


def ask_prompt(t: Trajectory, relation: str, style: Style) -> tuple[Message, ...]:
    """`self_ask_prompt` about the end."""
    at = t.rollout.length
    return self_ask_prompt(relation, t.rollout.moments[at].visible, t.rollout.history(at), t.motion[at], style, LOG_LENGTH)


def critic_examples(
    model: ProprioMLLM, trajectories: Sequence[Trajectory], judge: Judge, goals: dict[tuple[str, str], Relabel]
) -> list[CriticExample]:
    """Judges, asks itself and relabels.

    Args:
        model: that the examples are for.
        trajectories: this round's.
        judge: the critic.
        goals: receives the relabelled goals by (episode, goal).

    Returns:
        The critic's new examples: yes on the goals it accepts directly, yes on relabelled goals that it confirms, no on the
        original goal of every other trajectory.
    """
    examples: list[CriticExample] = []

    def add(kind: Literal["direct", "relabel", "negative"], t: Trajectory, goal: str) -> None:
        example = verdict(model, t, t.rollout.length, goal, kind != "negative")
        examples.append(CriticExample(kind, t.rollout.episode, example))

    verdicts = judge.completed([(t, t.rollout.length, t.rollout.instruction) for t in trajectories])
    for t, done in zip(trajectories, verdicts, strict=True):
        rollout = t.rollout
        if done:
            add("direct", t, rollout.instruction)
            continue
        add("negative", t, rollout.instruction)
        ask = functools.partial(judge.ask, t)
        found = relabel(rollout.instruction, rollout.moments[-1].known, rollout.receptacles(), ask, (rollout.instruction,))
        if found is None:
            continue
        goals[rollout.episode, found.goal] = found
        if judge.completed([(t, rollout.length, found.goal)])[0]:
            add("relabel", t, found.goal)
    return examples


def keep(
    trajectories: Sequence[Trajectory], goals: Mapping[tuple[str, str], Relabel], judge: Judge, per_class: int
) -> list[Kept]:
    """Re-judges original and relabelled goals.

    An episode ends by itself when its own goal holds; under another it is cut at the first moment that the judge accepts.
    Duplicates (same robot, goal and steps) are dropped; at most `per_class` per verbs, robot and category are kept, in order.
    """
    candidates = [(t, t.rollout.instruction, False) for t in trajectories]
    by_episode = {t.rollout.episode: t for t in trajectories}
    candidates += [(by_episode[episode], goal, True) for episode, goal in goals]
    verdicts = judge.completed([(t, t.rollout.length, goal) for t, goal, _ in candidates])
    kept: list[Kept] = []
    seen: set[tuple[object, ...]] = set()
    classes: Counter[tuple[object, ...]] = Counter()
    for (t, goal, relabelled), done in zip(candidates, verdicts, strict=True):
        if not done or t.rollout.length == 0:
            continue
        # A goal can only come true through the work of an arm.
        moments = [at for at in range(1, t.rollout.length) if relabelled and _worked(t.rollout, at - 1)]
        flags = judge.completed([(t, at, goal) for at in moments])
        end = next((at for at, held in zip(moments, flags, strict=True) if held), t.rollout.length)
        steps = tuple(moment.step for moment in t.rollout.moments[:end])
        same = (t.rollout.robot, goal, steps)
        group = (verbs_of(goal), t.rollout.robot, t.rollout.category)
        if same in seen or classes[group] >= per_class:
            continue
        seen.add(same)
        classes[group] += 1
        kept.append(Kept(t, goal, end, relabelled))
    return kept


def actor_examples(model: ProprioMLLM, kept: Sequence[Kept]) -> list[Example]:
    """Decisions of kept trajectories: every step that worked, up to the moment at which the goal held.

    `Done()` is never a target: an episode ends by itself when its goals hold, and relabelled goals would teach to stop early.
    Going where the robot has just gone works, but teaches to stand still. The sub-goal of an answer is told in hindsight: it is
    the next action of an arm that worked.
    """
    examples: list[Example] = []
    for number, item in enumerate(kept):
        t, rollout = item.trajectory, item.trajectory.rollout
        log = EpisodeLog(tokens_of(model.processor.tokenizer), reflects=number % 2 == 0)  # as half of the lessons
        for at, shown in enumerate(rollout.shown(item.end - 1, item.goal)):
            moment, now = rollout.moments[at], log.look(shown)
            served = next((action for later in range(at, item.end) for action in _worked(rollout, later)), None)
            if not moment.ok or served is None or moment.step == "Done()" or _stays(rollout, at):
                continue
            thing: str | None = served.object_id or ""
            if thing and thing not in moment.known:
                thing = None
            step = PlanStep.parse(moment.step)
            reflection = reflection_words(log.sightings.belief.failed, step) if log.reflects else ()
            answer = log.words.tokens(answer_words(served.name, thing, step, reflection))
            view = rollout.view(at) if model.cfg.sees else None
            examples.append(pictured_turn(model, log.log, now, view, t.motion[at], answer))
    return examples


def _worked(rollout: Rollout, at: int) -> list[Action]:
    """Actions of arms of a step, where all of it worked."""
    moment = rollout.moments[at]
    if not moment.ok or moment.step == "Done()":
        return []
    return [action for action in PlanStep.parse(moment.step).actions if action.spec.kind is not ActionKind.BODY]


def _stays(rollout: Rollout, at: int) -> bool:
    """Whether a step only repeats the way to where the step before went."""
    before, now = rollout.moments[at - 1] if at else None, rollout.moments[at]
    return before is not None and before.ok and before.step == now.step and now.step.startswith("GoTo(")


def precision(judge: ModelJudge, asked: Sequence[tuple[Example, bool]]) -> float:
    """Of a critic's yes to questions, each with what is true, the share that is right; 0 when it never says yes."""
    said = judge.agrees([question for question, _ in asked])
    return float(np.mean([truth for (_, truth), yes in zip(asked, said, strict=True) if yes])) if any(said) else 0.0


def audit(trajectories: Sequence[Trajectory], goals: Mapping[tuple[str, str], Relabel], judge: Judge) -> dict[str, float]:
    """The judge against the simulator's truth at the end, for reports only: counts, and what they define of accuracy,
    precision and recall.
    """
    oracle = OracleJudge(goals)
    by_episode = {t.rollout.episode: t for t in trajectories}
    queries = [(t, t.rollout.length, t.rollout.instruction) for t in trajectories]
    queries += [(by_episode[episode], by_episode[episode].rollout.length, goal) for episode, goal in goals]
    truth = [oracle.truth(t.rollout, goal) for t, _, goal in queries]
    said = judge.completed(queries)
    pairs = [(s, t) for s, t in zip(said, truth, strict=True) if t is not None]
    both = sum(s and t for s, t in pairs)
    yes, true = sum(s for s, _ in pairs), sum(t for _, t in pairs)
    scores = {"judged": float(len(pairs)), "said_yes": float(yes), "truly_yes": float(true)}
    if pairs:
        scores["accuracy"] = float(np.mean([s == t for s, t in pairs]))
    if yes:
        scores["precision"] = both / yes
    if true:
        scores["recall"] = both / true
    return scores
