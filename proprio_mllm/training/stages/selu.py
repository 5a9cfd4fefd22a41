"""Stage `selu` (paper, stage 3): the actor explores, the critic judges and relabels, both learn from what is kept.

Actor and critic are two LoRA adapters over the stage-2 model: the actor goes on with stage 2's adapter, the critic starts as
its copy, which says already when it is done. A round: roll the actor out with a temperature, judge every end, ask oneself and
relabel failures keeping the verb, fine-tune the critic, judge again, fine-tune the actor on the kept trajectories. A critic
whose yes about held-out lessons is less often right than before is put back; where it is too often wrong (`selu.precision`),
nothing is kept and the critic learns from lessons alone. The critic's agreement with the simulator is reported and, unless
`truth=oracle`, never used. Part of each batch is replayed against forgetting: decisions of lessons, for the critic questions
about them too; the abstract of SELU mentions no replay.
"""

from __future__ import annotations

import dataclasses
import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from configs.schema.train import LoopConfig
from data.files import read_json
from data.shards import config_hash
from proprio_mllm.model.batch import Batch, Collator, Example
from proprio_mllm.model.building import add_adapter, load_model, save_model, use_adapter
from proprio_mllm.model.groups import train_only
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.critic import (
    Judge,
    ModelJudge,
    OracleJudge,
    Trajectory,
    actor_examples,
    audit,
    critic_examples,
    keep,
    precision,
)
from proprio_mllm.training.goals import Relabel
from proprio_mllm.training.judging import Verdicts, state_example
from proprio_mllm.training.loop import Objective, Parts
from proprio_mllm.training.paths import finish, finished_key
from proprio_mllm.training.pipeline import Metrics, Pipeline
from proprio_mllm.training.processes import first_alone, processes
from proprio_mllm.training.rollouts import Rollout, RolloutCollector, RolloutRequest, read_rollouts
from proprio_mllm.training.stages.inputs import lessons_of, turns_of

logger = logging.getLogger(__name__)

#: Adapter names; the actor's is the one that stage 2 trained.
ACTOR, CRITIC = "default", "critic"
#: Held-out questions that tell the critic's precision, whether a goal holds.
_ASKED: Final = 400


class ExampleObjective(Objective):
    """Fine-tuning of one adapter on stored examples, with a share of freshly drawn ones."""

    def __init__(
        self,
        name: str,
        model: ProprioMLLM,
        examples: Sequence[Example],
        replay: Callable[[np.random.Generator], Example],
        replay_share: float,
        key: str,
    ) -> None:
        self.name, self.key = name, key
        self.module: nn.Module = model
        self._examples, self._replay = list(examples), replay
        self._share = replay_share if self._examples else 1.0
        self._collator = Collator(model.processor, model.cfg)

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> Parts:
        """Stored and replayed examples."""
        drawn = rng.random(size) < self._share
        rows = [self._replay(rng) if fresh else self._examples[int(rng.integers(len(self._examples)))] for fresh in drawn]
        return Parts(self._collator.in_parts(rows))

    def weight(self, batch: Parts) -> float:
        """Tokens of the answers."""
        return float(batch[0].out_of)

    def loss(self, module: nn.Module, batch: Batch, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        """Cross-entropy over the answers; nothing is drawn."""
        del generator
        out = module(batch)
        return out.loss, {"accuracy": out.correct / max(batch.out_of, 1)}


def copy_adapter(model: ProprioMLLM, source: str, target: str) -> None:
    """Copies one adapter's weights to another of the same shape.

    Raises:
        ValueError: when either adapter has no weights in the model.
    """
    state = dict(model.named_parameters())
    copied = 0
    with torch.no_grad():
        for name, parameter in state.items():
            other = name.replace(f".{source}.", f".{target}.") if f".{source}." in name else _ending(name, source, target)
            if other != name and other in state:
                state[other].copy_(parameter)
                copied += 1
    if not copied:
        raise ValueError(f"no weights of adapter {source!r} to copy to {target!r}")


def _ending(name: str, source: str, target: str) -> str:
    return name.removesuffix(source) + target if name.endswith(f".{source}") else name


def train_adapter(model: ProprioMLLM, name: str) -> list[nn.Parameter]:
    """Makes an adapter active and the only thing that trains; returns its parameters."""
    use_adapter(model, name)
    train_only(model, ("lora", "rows"))
    chosen = []
    for key, parameter in model.named_parameters():
        parameter.requires_grad_(parameter.requires_grad and _of(name, key))
        if parameter.requires_grad:
            chosen.append(parameter)
    return chosen


def _of(adapter: str, parameter: str) -> bool:
    """Whether a parameter is an adapter's."""
    return f".{adapter}." in parameter or parameter.endswith(f".{adapter}")


def _trajectories(rollouts: Sequence[Rollout], tokenizer: MotionTokenizer | None) -> list[Trajectory]:
    found = []
    for rollout in rollouts:
        motion = tuple(None if tokenizer is None else tokenizer.encode_window(window) for window in rollout.motions)
        found.append(Trajectory(rollout, motion))
    return found


class _Learner:
    """The model with both adapters, on the device that trains, and what it reads.

    Args:
        pipeline: gives the loops and the lessons.
        folder: of the stored model; the critic is made where it is missing.
        key: of this stage's output.
    """

    def __init__(self, pipeline: Pipeline, folder: Path, key: str) -> None:
        self._pipeline, self._key = pipeline, key
        self.model = load_model(folder, trainable=True)
        self.tokenizer = MotionTokenizer.load(folder / "motion") if self.model.cfg.proprioception else None
        peft: Any = self.model.vlm
        if CRITIC not in peft.peft_config:
            add_adapter(self.model, CRITIC)
            copy_adapter(self.model, ACTOR, CRITIC)
        self.model.to(processes().device)
        self._demos = lessons_of(pipeline, self.model.cfg)
        self._turns = turns_of(pipeline, self.model, self._demos, self.tokenizer)
        self._verdicts = Verdicts(self.model, self._demos, self._turns.codes)

    def judge(self) -> ModelJudge:
        """The critic as it is now."""
        return ModelJudge(self.model, CRITIC)

    def critic(self) -> dict[str, Tensor]:
        """What the critic has learnt so far: a copy of its adapter's weights."""
        named = self.model.named_parameters()
        return {name: tensor.detach().clone() for name, tensor in named if _of(CRITIC, name)}

    def put_back(self, critic: Mapping[str, Tensor]) -> None:
        """Makes the critic what it was."""
        self.model.load_state_dict(critic, strict=False)

    def precision(self) -> float:
        """How often the critic is right when it says yes to held-out questions about lessons."""
        return precision(self.judge(), self._verdicts.held_out(_ASKED))

    def _judging(self, rng: np.random.Generator) -> Example:
        """What the critic must not forget, when planners are done and the states of things, and goals that were not met."""
        kind = rng.integers(3)
        if kind == 0:
            return self._planning(rng)
        if kind == 1:
            return self._verdicts.draw(rng)
        return state_example(self._demos, int(self._demos.draw(rng, 1)[0]), rng, self._turns.codes)

    def _planning(self, rng: np.random.Generator) -> Example:
        return self._turns.draw(rng, 1)[0]

    def tune(self, adapter: str, name: str, examples: Sequence[Example], loop: LoopConfig, share: float, folder: Path) -> None:
        """Fine-tunes one adapter."""
        train_adapter(self.model, adapter)
        replay = self._judging if adapter == CRITIC else self._planning
        key = config_hash({"key": self._key, "name": name, "examples": len(examples)})
        objective = ExampleObjective(name, self.model, examples, replay, share, key)
        self._pipeline.loop(objective, loop, folder)

    def store(self, folder: Path) -> None:
        """Writes the model, the actor active."""
        use_adapter(self.model, ACTOR)
        first_alone(lambda: save_model(self.model.eval(), folder, self.tokenizer))


class _Selu:
    """One run of the stage."""

    def __init__(self, pipeline: Pipeline, folder: Path, key: str, collect: RolloutCollector) -> None:
        self.pipeline, self.cfg, self.folder, self.key, self.collect = pipeline, pipeline.cfg.selu, folder, key, collect
        self.start = pipeline.paths.model("alignment")

    def round(self, number: int) -> dict[str, float]:
        """One round; its folder holds rollouts, the two runs, the model and its metrics."""
        folder, key = self.folder / f"round_{number}", f"{self.key}/{number}"
        if finished_key(folder) == key and not self.pipeline.cfg.overwrite:
            logger.info("selu: round %d is complete", number)
            return read_json(folder / "done.json")["metrics"]
        before = self.start if number == 0 else self.folder / f"round_{number - 1}" / "model"
        seed = self.pipeline.cfg.seed * 1000 + number
        cfg, actor = self.cfg, key if number else self.pipeline.key("alignment")  # the first rollouts serve other critics too
        hashed = config_hash({"actor": actor, "episodes": cfg.episodes, "seed": seed, "temperature": cfg.temperature})
        request = RolloutRequest(before, folder / "rollouts", cfg.episodes, seed, cfg.temperature, hashed, cfg.rollouts)

        def act() -> None:
            (folder / "done.json").unlink(missing_ok=True)
            if self.pipeline.cfg.overwrite:  # the actor may be another one under the same key
                shutil.rmtree(folder / "rollouts", ignore_errors=True)
            self.collect(request)

        torch.cuda.empty_cache()  # of the last round's model: the actor runs in processes of its own
        first_alone(act)
        learner = _Learner(self.pipeline, before, self.key)
        trajectories = _trajectories(read_rollouts(request.folder), learner.tokenizer)
        if not trajectories:
            raise ValueError(f"{request.folder}: the collector wrote no episode")
        goals: dict[tuple[str, str], Relabel] = {}
        oracle = OracleJudge(goals) if cfg.truth == "oracle" else None
        judge: Judge = oracle or learner.judge()
        metrics: dict[str, float] = {f"before_{name}": value for name, value in audit(trajectories, {}, judge).items()}
        before = self._precision(learner, metrics, "before")
        learnt = critic_examples(learner.model, trajectories, judge, goals) if before >= cfg.precision else []
        for kind in ("direct", "relabel", "negative"):
            metrics[f"critic_{kind}"] = float(sum(one.kind == kind for one in learnt))
        untaught = learner.critic()
        learner.tune(CRITIC, "selu/critic", [one.example for one in learnt], cfg.critic, cfg.replay_share, folder / "critic")
        after = self._precision(learner, metrics, "after")
        if after >= before:
            judge = oracle or learner.judge()
        else:
            logger.warning("selu: the critic is less often right than before: put back")
            learner.put_back(untaught)
        kept = keep(trajectories, goals, judge, cfg.per_class) if max(before, after) >= cfg.precision else []
        metrics |= {f"after_{name}": value for name, value in audit(trajectories, goals, judge).items()}
        steps = actor_examples(learner.model, kept)
        metrics |= {
            "episodes": float(len(trajectories)),
            "actor_success": float(np.mean([t.rollout.success for t in trajectories])),
            "kept": float(len(kept)),
            "kept_relabelled": float(sum(item.relabelled for item in kept)),
            "actor_steps": float(len(steps)),
        }
        if steps:
            learner.tune(ACTOR, "selu/actor", steps, cfg.actor, cfg.replay_share, folder / "actor")
        learner.store(folder / "model")
        first_alone(lambda: finish(folder, key, metrics))
        return metrics

    def _precision(self, learner: _Learner, metrics: dict[str, float], when: str) -> float:
        """How often the judge's yes is right: the simulator's always, the critic's to questions about held-out lessons."""
        if self.cfg.truth == "oracle":
            return 1.0
        metrics[f"{when}_held_out_precision"] = found = learner.precision()
        logger.info("selu: %s it learns, %.2f of the critic's yes to held-out questions are right", when, found)
        if found < self.cfg.precision:
            logger.warning("selu: that is below selu.precision=%.2f and does not count", self.cfg.precision)
        return found


class SeluStage:
    """Rounds of acting, judging, relabelling and learning."""

    name = "selu"
    needs = ("alignment",)
    shards = ()
    recipe = 7

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """The rounds, whoever runs the episodes."""
        settings = dataclasses.asdict(pipeline.cfg.selu)
        del settings["rollouts"]
        return {"selu": settings}

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Runs the rounds, continuing an interrupted one, and stores the last round's model.

        Raises:
            ValueError: without a collector of rollouts.
        """
        if pipeline.collect_rollouts is None:
            raise ValueError("stage 'selu' needs rollouts: no collector was given")
        rounds = _Selu(pipeline, folder, key, pipeline.collect_rollouts)
        metrics: Metrics = {}
        for number in range(pipeline.cfg.selu.rounds):
            metrics |= {f"round{number}_{name}": value for name, value in rounds.round(number).items()}
        last = folder / f"round_{pipeline.cfg.selu.rounds - 1}" / "model"
        model = load_model(last, ACTOR)
        tokenizer = MotionTokenizer.load(last / "motion") if model.cfg.proprioception else None
        pipeline.store("selu", model, tokenizer)
        return metrics
