"""Where the things are that decisions are about, as a point map finds them: what `model.places` says in answers.

Lessons hold no positions. A point map that knows what is where has learnt them from posed views, so its centres are the labels:
an answer says of its own picture what the point map makes of it, and the step is learnt behind words like "20d 0.60 0.90"
(embodied chain of thought; Zawalski et al., 2024). Every variant learns the same words, whether or not it has the point map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import torch

from proprio_mllm.model.batch import Collator
from proprio_mllm.model.geometry import floor_m, to_pelvis
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.named_map import NamedPointMap, centres_of, name_rows
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import Words, id_words, place_words
from proprio_mllm.training.sources import Demos

#: Score of the likest cell from which on a thing counts as found.
_FOUND: Final = -1.0
_BATCH: Final = 32


class Places:
    """Finds things in the pictures of decisions.

    Args:
        model: gives the tokenizer and the words' rows.
        encoder: a trained point map that knows what is where.
        demos: the decisions.
    """

    def __init__(self, model: ProprioMLLM, encoder: NamedPointMap, demos: Demos) -> None:
        self._encoder, self._demos = encoder.eval(), demos
        self._tokens, self._table = tokens_of(model.processor.tokenizer), model.table.detach()
        self._collator = Collator(model.processor, model.cfg)

    @torch.no_grad()
    def __call__(self, asked: Sequence[tuple[int, Words]]) -> Mapping[int, Words]:
        """The place of one thing in the picture of each row, where it is alone of its name there and found.

        Args:
            asked: rows and the words of ids.
        """
        found: dict[int, Words] = {}
        for start in range(0, len(asked), _BATCH):
            some = [(row, self._demos.reader[row], thing) for row, thing in asked[start : start + _BATCH]]
            some = [one for one in some if _alone(one[2], one[1]["visible"])]
            if not some:
                continue
            views = [self._demos.view(row) for _, row, _ in some]
            images = self._collator.images(views)
            names = name_rows(self._tokens, self._table, [thing[:-1] for *_, thing in some])
            geo = self._encoder(images.rgb, None, images.stance)
            assert geo.named is not None
            scale = self._encoder.scale.exp()
            centres, cosine = centres_of(geo.named, names, scale)
            sure = scale * cosine.amax(1) + self._encoder.bias > _FOUND
            for (row, *_), view, centre, known in zip(some, views, centres.numpy(), sure.tolist(), strict=True):
                if known:
                    assert view.camera is not None and view.key_bodies is not None
                    found[row] = place_words(to_pelvis(view.camera, centre), floor_m(view.key_bodies))
        return found


def _alone(thing: Words, visible: Sequence[str]) -> bool:
    """Whether a thing is in view, and no other of its name."""
    seen = [id_words(name) for name in visible]
    return thing in seen and sum(one[:-1] == thing[:-1] for one in seen) == 1


def thing_of(answer: Words) -> Words:
    """What the sub-goal of an answer is about; nothing where that has not been seen, or there is none."""
    goal = answer[: answer.index("do")]
    goal = goal[goal.index("so") + 2 :] if "so" in goal else goal
    return () if goal[1:] == ("unseen",) else goal[1:]
