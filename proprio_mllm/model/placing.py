"""Where named things are in pictures, in words: what `model.places` says in answers.

A point map that knows what is where finds a thing by its name, and its place is written down in words (`wording.place_words`):
the labels of training, and with the point map in the model the words of its answers too, so that the step is decided behind
the same words that it was learnt behind. A model without that point map says them itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch

from proprio_mllm.model.batch import Collator, View
from proprio_mllm.model.geometry import to_pelvis
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.named_map import NamedPointMap, centres_of, name_rows
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import Words, id_words, place_words

#: Score of the likest cell from which on a thing counts as found.
_FOUND: Final = -1.0


def finder_of(model: ProprioMLLM) -> NamedPointMap | None:
    """The point map that tells a model the places in its answers; None where it says them itself, or answers without."""
    return model.point_map if model.cfg.places and isinstance(model.point_map, NamedPointMap) else None


class Placing:
    """Finds things in pictures.

    Args:
        model: gives the tokenizer and the words' rows.
        encoder: a trained point map that knows what is where.
    """

    def __init__(self, model: ProprioMLLM, encoder: NamedPointMap) -> None:
        self._encoder = encoder.eval()
        self._tokens, self._table = tokens_of(model.processor.tokenizer), model.table.detach()
        self._collator = Collator(model.processor, model.cfg)

    @torch.no_grad()
    def __call__(self, views: Sequence[View], things: Sequence[Words]) -> list[Words]:
        """The place of one thing in each picture, in words; none where it is not found, or the body is hidden.

        Args:
            views: pictures with camera and key bodies; a hidden body's are zeros, from which nothing can be placed.
            things: the words of an id each.
        """
        images = self._collator.images(views).to(self._table.device)
        names = name_rows(self._tokens, self._table, [thing[:-1] for thing in things])
        geo = self._encoder(images.rgb, None, images.stance)
        assert geo.named is not None
        scale = self._encoder.scale.exp()
        centres, cosine = centres_of(geo.named, names, scale)
        sure = scale * cosine.amax(1) + self._encoder.bias > _FOUND
        found: list[Words] = []
        for view, centre, known in zip(views, centres.cpu().numpy(), sure.tolist(), strict=True):
            assert view.camera is not None and view.key_bodies is not None
            told = known and view.key_bodies.any()
            found.append(place_words(to_pelvis(view.camera, centre), view.key_bodies) if told else ())
        return found


def stands_alone(thing: Words, visible: Sequence[str]) -> bool:
    """Whether a thing is in view, and no other of its name: of two, a name does not tell which is meant."""
    seen = [id_words(name) for name in visible]
    return thing in seen and sum(one[:-1] == thing[:-1] for one in seen) == 1
