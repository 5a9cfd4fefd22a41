"""Where a thing's place is lost on its way through a model: from the point map to the tokens that name the thing.

    python -m benchmarks.trace views=outputs/tiny/data/views model=weights/tiny/full

Things in training views are asked about (on which side). Their position in the pelvis heading frame is predicted by ridge
regression on what stands along the way: the points of the cells that show the thing, their visual tokens as the language model
gets them and before each of its layers, and, before each layer, the last token of the thing's name and the token behind which
the answer comes. Printed is the share of the variance of x (forward), y (left) and z (up) that is explained for things kept
back, and the size of what stands there: what is small beside the stream that it enters is lost in it.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from configs.arguments import command, read_arguments
from proprio_mllm.model.batch import IGNORE, Batch, Collator, Example
from proprio_mllm.model.building import load_model
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.prompts import looking
from proprio_mllm.training.sources import CELL, Asked, ViewRow, Views

_TOGETHER: Final = 16
#: Ridge penalties; of each the best counts, the same for all places.
_PENALTIES: Final = (10.0, 100.0, 1000.0)


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        views: folder of `views` shards.
        model: folder of a stored model with CSE.
        rows: how many views are asked about.
    """

    views: str
    model: str
    rows: int = 200


@dataclass(frozen=True, slots=True)
class Question:
    """A question about a thing in a view, and the share of the thing's pixels in each merged cell (N,), which add up to 1."""

    row: ViewRow
    asked: Asked
    cells: NDArray[np.float32]

    @staticmethod
    def of(views: Views, row: ViewRow, asked: Asked) -> Question:
        """The cells are those of the thing's box that show its type."""
        left, top, right, bottom = map(int, asked.thing["bbox"])
        mask = np.zeros(row.segmentation.shape, dtype=np.float32)
        kind = views.type_names.index(str(asked.thing["id"]).rpartition("_")[0])
        mask[top:bottom, left:right] = row.segmentation[top:bottom, left:right] == kind
        height, width = (size // CELL for size in mask.shape)
        cells = mask.reshape(height, CELL, width, CELL).sum((1, 3)).ravel()
        return Question(row, asked, cells / cells.sum())

    def example(self, views: Views) -> Example:
        """The view and the question, alone, so that no other tells."""
        return Example(looking([(self.asked.question, self.asked.answer)], None, views.style), (self.row.view,))


def name_ends(model: ProprioMLLM, batch: Batch, questions: Sequence[Question]) -> list[int]:
    """Position (K,) of the last token of each name, one question per row."""
    ends: list[int] = []
    for ids, question in zip(batch.input_ids.tolist(), questions, strict=True):
        name: list[int] = model.processor.tokenizer(f" {question.asked.name.lstrip()}", add_special_tokens=False)["input_ids"]
        ends.append(next(end for end in range(len(ids), 0, -1) if ids[end - len(name) : end] == name) - 1)
    return ends


def traced(model: ProprioMLLM, questions: Sequence[Question], views: Views) -> dict[str, Tensor]:
    """What stands at each place on the way (K, features), for K questions."""
    collate = Collator(model.processor, model.cfg)
    batch = collate([question.example(views) for question in questions])
    assert batch.images is not None
    layers: Any = model.core.model.language_model.layers
    read: list[Tensor] = []

    def keep(_: Any, args: tuple[Any, ...], inputs: dict[str, Any]) -> None:
        read.append(args[0] if args else inputs["hidden_states"])

    handles = [layer.register_forward_pre_hook(keep, with_kwargs=True) for layer in layers]
    with torch.no_grad():
        model(batch)
        found = {"points": model.spatial(batch.images)[0]} if model.cse is not None else {}
    for handle in handles:
        handle.remove()
    rows, cells = torch.arange(len(questions)), torch.from_numpy(np.stack([question.cells for question in questions]))
    seen = batch.input_ids == collate.image_token
    found |= {f"visual tokens, layer {number}": hidden[seen].unflatten(0, cells.shape) for number, hidden in enumerate(read)}
    shown = {place: (values.float() * cells[..., None]).sum(1) for place, values in found.items()}
    answers = (batch.labels != IGNORE).int().argmax(1) - 1
    for text, places in (("name", torch.tensor(name_ends(model, batch, questions))), ("answer", answers)):
        shown |= {f"{text}, layer {number}": hidden[rows, places].float() for number, hidden in enumerate(read)}
    return shown


def explained(values: Tensor, truth: Tensor) -> list[float]:
    """Share of the variance of each column of `truth` (K, 3) in the last quarter that `values` (K, F) explain."""
    fit = len(values) * 3 // 4
    values = (values - values[:fit].mean(0)) / (values[:fit].std(0) + 1e-4)
    values = torch.cat([values, torch.ones(len(values), 1)], 1)
    best = torch.full((truth.shape[1],), -torch.inf)
    for penalty in _PENALTIES:
        normal = values[:fit].T @ values[:fit] + penalty * torch.eye(values.shape[1])
        missed = values[fit:] @ torch.linalg.solve(normal, values[:fit].T @ truth[:fit]) - truth[fit:]
        best = torch.maximum(best, 1.0 - missed.square().mean(0) / truth[fit:].var(0))
    return best.tolist()


@command()
def main(arguments: Sequence[str]) -> int:
    """Prints the table."""
    options = read_arguments(Options, arguments)
    model = load_model(Path(options.model)).eval()
    views, rng = Views(Path(options.views), model.cfg), np.random.default_rng(0)
    held, questions = defaultdict[str, list[Tensor]](list), list[Question]()
    rows = rng.choice(views.split.train, min(options.rows, len(views.split.train)), replace=False)
    for row in (views.row(int(index)) for index in rows):
        questions += [Question.of(views, row, one) for one in views.asked(row, ("side",), 8, rng)]
    truth = [question.asked.thing["center_in_pelvis"] for question in questions]
    for first in range(0, len(questions), _TOGETHER):
        for place, values in traced(model, questions[first : first + _TOGETHER], views).items():
            held[place].append(values)
    sys.stdout.write(f"{len(truth)} things in {len(rows)} views\n{'':24} {'x':>6} {'y':>6} {'z':>6} {'size':>8}\n")
    for place, values in held.items():
        whole = torch.cat(values)
        shares = " ".join(f"{share:6.2f}" for share in explained(whole, torch.tensor(truth, dtype=torch.float32)))
        sys.stdout.write(f"{place:24} {shares} {float(whole.norm(dim=-1).mean()):8.1f}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
