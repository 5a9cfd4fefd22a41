"""All planners that need nothing but an observation, by kind. The privileged expert is made in `proprio_mllm.evaluation`.

`BUILT_IN` and stored models stand alone, `CHAT_PLANNERS` ask a backend; a planner of a file does either.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from configs.schema.backend import BackendConfig
from configs.schema.planner import AskingPlanner, BuiltInPlanner, FilePlanner, ModelPlanner, PlannerConfig
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

BUILT_IN: Final[Mapping[str, Callable[[int], Planner]]] = {"random": RandomPlanner, "scripted": ScriptedPlanner}


def make_planner(cfg: PlannerConfig) -> Planner:
    """The configured planner.

    Raises:
        ValueError: on a kind that is not made here.
    """
    if isinstance(cfg, ModelPlanner):
        from proprio_mllm.planners.words import WordsPlanner  # torch loads only where a model is used

        return WordsPlanner.load(cfg.weights, cfg.temperature, cfg.train, cfg.insist, cfg.adapter, cfg.reflection == "on")
    if isinstance(cfg, FilePlanner):
        return load_planner(cfg.source)
    if isinstance(cfg, BuiltInPlanner) and cfg.kind in BUILT_IN:
        return BUILT_IN[cfg.kind](cfg.image_size)
    raise ValueError(f"planner kind {cfg.kind!r} is not made here; allowed: file, mllm, {', '.join(BUILT_IN)}")


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
    if not isinstance(cfg, AskingPlanner):
        raise ValueError(f"planner kind {cfg.kind!r} asks no backend; allowed: {', '.join(CHAT_PLANNERS)}, file")
    options = ChatOptions.of(cfg, backend_cfg)
    if isinstance(cfg, FilePlanner):
        return load_planner(cfg.source, backend, options)
    return CHAT_PLANNERS[cfg.kind](backend, options)
