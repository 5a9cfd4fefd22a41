"""Muon: momentum whose update is orthogonalised, for the weight matrices of linear layers; AdamW for everything else.

From scratch it needed about half of AdamW's steps. torch has a Muon too. It always orthogonalises in bfloat16, which is four
times slower than float32 on processors without units for it, and one matrix at a time, twice as slow on small models as all of
a shape together; and it takes matrices only, while the loop and its checkpoints keep one optimiser.

Source: K. Jordan, "Muon: an optimizer for hidden layers in neural networks", 2024; scaling to AdamW's update size: J. Liu et
al., "Muon is scalable for LLM training", 2025. The paper does not name its optimiser.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import torch
from torch import Tensor, nn

#: Quintic Newton-Schulz iteration: singular values go to about 1 in five steps.
_QUINTIC: Final = (3.4445, -4.7750, 2.0315)
_ITERATIONS: Final = 5
#: Update size relative to AdamW's: 0.2 is AdamW's usual root mean square, doubled because momentum alone is steadier.
_SCALE: Final = 0.4


def orthogonalised(update: Tensor) -> Tensor:
    """The nearest semi-orthogonal matrices, roughly: singular values between 0.7 and 1.2.

    Args:
        update: (..., M, N).
    """
    a, b, c = _QUINTIC
    wide = update if update.shape[-2] <= update.shape[-1] else update.mT
    x = wide / (wide.norm(dim=(-2, -1), keepdim=True) + 1e-7)
    for _ in range(_ITERATIONS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x if wide is update else x.mT


def linear_weights(module: nn.Module) -> list[nn.Parameter]:
    """Trained weights of linear layers, without those that are embedding tables too and without the output layer."""
    tables = {id(one.weight) for one in module.modules() if isinstance(one, nn.Embedding)}
    layers = [(name, one) for name, one in module.named_modules() if isinstance(one, nn.Linear)]
    weights = [one.get_parameter("weight") for name, one in layers if name.rsplit(".", 1)[-1] != "lm_head"]
    chosen = {id(weight): weight for weight in weights if weight.requires_grad and id(weight) not in tables}
    return list(chosen.values())


class Muon(torch.optim.Optimizer):
    """Muon for matrices, AdamW for the others.

    Args:
        matrices: weights of linear layers.
        groups: parameter groups of all other parameters, with their `weight_decay`.
        lr: learning rate of both.
        betas: AdamW's.
        momentum: of the matrices.
        weight_decay: of the matrices.
        adam_share: AdamW's learning rate over `lr`.
        dtype: in which updates are orthogonalised.
    """

    def __init__(
        self,
        matrices: Iterable[nn.Parameter],
        groups: Iterable[dict[str, Any]],
        lr: float,
        betas: tuple[float, float] = (0.9, 0.99),
        momentum: float = 0.95,
        weight_decay: float = 0.01,
        adam_share: float = 1.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self._dtype = dtype
        wanted = [{"params": list(matrices), "weight_decay": weight_decay, "orthogonal": True, "share": 1.0}]
        wanted += [{**group, "orthogonal": False, "share": adam_share} for group in groups]
        defaults = {"lr": lr, "betas": betas, "momentum": momentum, "weight_decay": weight_decay, "eps": 1e-8}
        super().__init__([group for group in wanted if group["params"]], defaults)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]  # torch's overloads
        """One step over all parameters that have a gradient."""
        loss = closure() if closure is not None else None
        for group in self.param_groups:
            lr = group["lr"] * group["share"]
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            changes = self._matrices(parameters, group) if group["orthogonal"] else (self._adam(p, group) for p in parameters)
            for parameter, change in zip(parameters, changes, strict=True):
                parameter.mul_(1.0 - lr * group["weight_decay"])
                parameter.sub_(change, alpha=lr)
        return loss

    def _matrices(self, parameters: Sequence[Tensor], group: dict[str, Any]) -> list[Tensor]:
        """Changes of matrices; those of one shape are orthogonalised together."""
        ahead: list[Tensor] = []
        for parameter in parameters:
            state = self.state[parameter]
            if not state:
                state["momentum"] = torch.zeros_like(parameter)
            state["momentum"].lerp_(parameter.grad, 1.0 - group["momentum"])  # type: ignore[arg-type]
            ahead.append(torch.lerp(parameter.grad, state["momentum"], group["momentum"]))  # type: ignore[arg-type]
        changes = dict[int, Tensor]()
        for shape in dict.fromkeys(one.shape for one in ahead):
            alike = [number for number, one in enumerate(ahead) if one.shape == shape]
            straight = orthogonalised(torch.stack([ahead[number] for number in alike]).to(self._dtype))
            changes |= zip(alike, straight.to(ahead[alike[0]].dtype) * (_SCALE * math.sqrt(max(shape))), strict=True)
        return [changes[number] for number in range(len(ahead))]

    def _adam(self, parameter: Tensor, group: dict[str, Any]) -> Tensor:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros(())
            state["mean"], state["square"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        first, second = group["betas"]
        state["step"] += 1
        state["mean"].lerp_(parameter.grad, 1.0 - first)  # type: ignore[arg-type]
        state["square"].lerp_(parameter.grad.square(), 1.0 - second)  # type: ignore[union-attr]
        count = float(state["step"])
        mean = state["mean"] / (1.0 - first**count)
        return mean / ((state["square"] / (1.0 - second**count)).sqrt() + group["eps"])
