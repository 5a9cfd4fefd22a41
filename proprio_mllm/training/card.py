"""Model cards in Hugging Face's format, from the provenance that lies beside released weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from proprio_mllm.model.backbone import PUBLISHED
from proprio_mllm.training.paths import RELEASED_AS

_ABOUT: Final = {
    "practice": "A language model from scratch that plans in words: it reads the episode so far and answers with a plan step.",
    "base": "The language model of `words` that has learnt to see; it stands in for a pretrained Qwen2.5-VL at this size.",
    "pointmap": "The point map that also knows what is where: stage `alignment` reads positions of things from it.",
    "alignment": "The base model with motion tokens, motion-based position embedding, cross-spatial encoder (paper, stage 2).",
    "selu": "The aligned model after self-learning (paper, stage 3).",
}
#: What an ablated model does without.
_WITHOUT: Final = {
    "full": "",
    "no_mpe": " Ablation: without the motion-based position embedding.",
    "no_cse": " Ablation: without the cross-spatial encoder.",
    "no_mpe_cse": " Ablation: without the motion-based position embedding and the cross-spatial encoder.",
    "no_proprio": " Control: the same training without motion tokens and both.",
}
_OWN: Final = "It is of a size for tests on a laptop and not comparable with the\npaper's 7B model."
_OTHERS: Final = "What was added to the base model is here; its weights and their licence are where it is."
_ALONE: Final = ", and on nothing else: no text or picture of people"
_ADDED: Final = ", beside what the base model had learnt"


def model_card(provenance: Mapping[str, Any]) -> str:
    """The text of `README.md` in a folder of released weights.

    Args:
        provenance: as in `provenance.json`.
    """
    stage, model = provenance["stage"], provenance["config"]["model"]["name"]
    variant = "full" if stage in RELEASED_AS else provenance["variant"]
    planner = RELEASED_AS.get(stage, {"full": "proprio", "no_proprio": "no_proprio"}.get(variant, f"proprio_{variant}"))
    name = planner if stage in RELEASED_AS else variant
    use = f"eval.py planner={planner} robot=h1" if stage != "pointmap" else "train.py stage=alignment given=weights"
    rows = [
        f"| {one} | {key} | {value:.4g} |"
        for one, record in provenance["stages"].items()
        for key, value in record["metrics"].items()
        if key != "seconds" and not key.endswith(("/steps", "/seconds"))
    ]
    commands = "\n".join(f"    {record['command']}" for record in provenance["stages"].values())
    shards = ", ".join(f"{kind} `{key}`" for kind, key in provenance["shards"].items())
    weights = provenance["config"]["model"].get("weights")
    beside = _ADDED if weights else _ALONE
    base = f"base_model: {weights}\n" if weights in PUBLISHED else ""
    return f"""---
license: {"other" if weights else "apache-2.0"}
library_name: proprio-mllm
pipeline_tag: robotics
language: en
{base}tags: [embodied-planning, dual-arm, humanoid, mujoco]
---

# Proprio-MLLM {model}, {name}

{_ABOUT[stage]}{_WITHOUT[variant]} For the humanoids Unitree H1 and AgiBot X1 in the household simulator of this project.

    python {use}

**Trained** on what the simulator and the project's rules make{beside}. Seed
{provenance["seed"]}; shards {shards}. Stored as {provenance["stored_as"]}.

{commands}

**Measured** on held-out data while training; success on the benchmark's 359 tasks is in `docs/benchmark.md`.

| stage | metric | value |
|---|---|---|
{chr(10).join(rows)}

**Limits.** It knows this simulator's actions, codes and instructions in English, and no others; it says nothing about what is
safe for people or property, and has never driven a robot. {_OTHERS if weights else _OWN}
"""
