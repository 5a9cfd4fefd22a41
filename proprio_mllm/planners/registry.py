"""All planners that need nothing but an observation, by kind. The privileged expert is made in `proprio_mllm.evaluation`.

`PLANNERS` stand alone, `CHAT_PLANNERS` ask a backend; a planner of a file does either.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from configs.schema.backend import BackendConfig
from configs.schema.eval import PlannerConfig
from proprio_mllm.backends.protocol import Backend
from proprio_mllm.planners.chat.dag_plan.planner import DagPlanner
from proprio_mllm.planners.chat.llm_planner import LlmPlanner
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.plain import PlainPlanner
from proprio_mllm.planners.chat.rap import RapPlanner
from proprio_mllm.planners.file_planner import load_planner
from proprio_mllm.planners.protocol import Planner
from proprio_mllm.planners.random_planner import RandomPlanner
from proprio_mllm.planners.scripted.planner import ScriptedPlanner


def _mllm(cfg: PlannerConfig) -> Planner:
    from proprio_mllm.planners.words import WordsPlanner  # torch loads only where a model is used

    assert cfg.weights is not None
    reflects = cfg.reflection == "on"
    return WordsPlanner.load(cfg.weights, cfg.temperature, cfg.train, cfg.insist, cfg.adapter, reflects)


def _random(cfg: PlannerConfig) -> Planner:
    return RandomPlanner(cfg.image_size)


def _scripted(cfg: PlannerConfig) -> Planner:
    return ScriptedPlanner(cfg.image_size)


def _file(cfg: PlannerConfig) -> Planner:
    assert cfg.source is not None
    return load_planner(cfg.source)


PLANNERS: Final[Mapping[str, Callable[[PlannerConfig], Planner]]] = {
    "file": _file,
    "mllm": _mllm,
    "random": _random,
    "scripted": _scripted,
}


def make_planner(cfg: PlannerConfig) -> Planner:
    """The configured planner.

    Raises:
        ValueError: on a kind that is not made here.
    """
    if cfg.kind not in PLANNERS:
        raise ValueError(f"planner kind {cfg.kind!r} is not made here; allowed: {', '.join(PLANNERS)}")
    return PLANNERS[cfg.kind](cfg)


CHAT_PLANNERS: Final[Mapping[str, Callable[[Backend, ChatOptions], Planner]]] = {
    "dag_plan": DagPlanner,
    "llm_planner": LlmPlanner,
    "plain": PlainPlanner,
    "rap": RapPlanner,
}


def make_chat_planner(cfg: PlannerConfig, backend_cfg: BackendConfig, backend: Backend) -> Planner:
    """The configured planner on a backend.

    Raises:
        CodeFileError: when the planner of a file cannot be made.
        ValueError: on a kind that asks no backend.
    """
    options = ChatOptions.of(cfg, backend_cfg)
    if cfg.source is not None:
        return load_planner(cfg.source, backend, options)
    if cfg.kind not in CHAT_PLANNERS:
        raise ValueError(f"planner kind {cfg.kind!r} asks no backend; allowed: {', '.join(CHAT_PLANNERS)}, file")
    return CHAT_PLANNERS[cfg.kind](backend, options)
