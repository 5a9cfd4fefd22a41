"""Named parameter groups, so that a training phase can say what it trains.

| group | parameters |
|---|---|
| `rows` | embeddings: with adapters, the active one's rows of the motion tokens; without, the whole tables |
| `lora` | the active adapter's low-rank weights of the language model |
| `lm` | the language model's own layers |
| `vision` | the vision tower without its merger |
| `merger` | the vision tower's merger |
| `cse` | cross-spatial encoder |
| `mpe` | additive sign embedding |
| `point_map` | point-map encoder |
"""

from __future__ import annotations

import re
from collections.abc import Collection

from peft import PeftModel
from torch import nn

from proprio_mllm.model.modeling import ProprioMLLM

GROUPS: tuple[str, ...] = ("rows", "lora", "lm", "vision", "merger", "cse", "mpe", "point_map")
_ADAPTER = re.compile(r"\.(?:lora_[AB]|trainable_tokens_delta)\.([^.]+)")


def group_of(name: str) -> str:
    """Group of a parameter name of `ProprioMLLM`."""
    head = name.split(".", 1)[0]
    if head in ("cse", "mpe", "point_map"):
        return head
    if "trainable_tokens_" in name:
        return "rows"
    if "lora_" in name:
        return "lora"
    if ".visual.merger." in name:
        return "merger"
    if ".visual." in name:
        return "vision"
    if "embed_tokens" in name or "lm_head" in name:
        return "tables"
    return "lm"


def adapter_of(name: str) -> str | None:
    """Name of the adapter that a parameter belongs to, None for all others."""
    match = _ADAPTER.search(name)
    return match.group(1) if match else None


def parameter_groups(model: ProprioMLLM) -> dict[str, dict[str, nn.Parameter]]:
    """Parameters of the model by group and name; every parameter that can train is in exactly one group.

    With adapters, those that are not active are left out, and so are the full embedding tables: they stay as they are, the
    adapter's rows are trained.
    """
    active = model.vlm.active_adapters if isinstance(model.vlm, PeftModel) else []
    named = [(name, group_of(name), parameter) for name, parameter in model.named_parameters()]
    adapted = any("trainable_tokens_" in name for name, _, _ in named)
    groups: dict[str, dict[str, nn.Parameter]] = {group: {} for group in GROUPS}
    for name, group, parameter in named:
        if (adapter := adapter_of(name)) is not None and adapter not in active:
            continue
        if group == "tables":
            if adapted:
                continue
            group = "rows"
        groups[group][name] = parameter
    return groups


def train_only(model: ProprioMLLM, names: Collection[str]) -> list[nn.Parameter]:
    """Freezes everything but the named groups and returns their parameters.

    Raises:
        ValueError: on an unknown group, or when the groups hold no parameter.
    """
    unknown = sorted(set(names) - set(GROUPS))
    if unknown:
        raise ValueError(f"unknown parameter groups {unknown}; allowed: {', '.join(GROUPS)}")
    model.requires_grad_(False)
    groups = parameter_groups(model)
    chosen = [parameter for name in names for parameter in groups[name].values()]
    if not chosen:
        raise ValueError(f"parameter groups {sorted(names)} hold no parameter in this model")
    for parameter in chosen:
        parameter.requires_grad_(True)
    return chosen
