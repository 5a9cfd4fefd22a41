"""What the tiny model starts from: a tokenizer of the project's own text, and type names that mean their words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch.nn import functional

from configs.schema.model import ModelConfig
from proprio_mllm.evaluation.lessons import Lessons
from proprio_mllm.model.building import build_model, build_processor
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.word_tokens import add_word_tokens, tokens_of
from proprio_mllm.model.wording import PLACE_SCALES
from proprio_mllm.training.sources import Clips, Views
from proprio_mllm.training.text import corpus, order_places, start_from_words, whole_words


@pytest.fixture
def fresh(shards: Path, cfg: ModelConfig) -> ProprioMLLM:
    views = Views(shards / "views", cfg)
    texts = corpus(cfg, views, Clips(shards / "clips"))
    return build_model(cfg, build_processor(cfg, texts, whole_words(views)))


def row(model: ProprioMLLM, text: str) -> torch.Tensor:
    ids = model.processor.tokenizer(text, add_special_tokens=False).input_ids
    embeddings: Any = model.core.get_input_embeddings()
    return embeddings.weight.detach()[ids].sum(0)


def test_the_corpus_holds_every_kind_of_text(shards: Path, cfg: ModelConfig) -> None:
    texts = "\n".join(corpus(cfg, Views(shards / "views", cfg), Clips(shards / "clips")))
    for wanted in ("which ", "judge", "left", "see", "Mug_1"):
        assert wanted in texts, wanted


def test_a_type_name_starts_as_its_words(fresh: ProprioMLLM) -> None:
    others = row(fresh, "Mug")
    start_from_words(fresh, ("CoffeeTable", "Fridge"))
    coffee_table = row(fresh, "CoffeeTable")
    words = fresh.processor.tokenizer(" coffee table", add_special_tokens=False).input_ids
    assert torch.allclose(coffee_table * len(words) ** 0.5, row(fresh, " coffee table"), atol=1e-6)
    similar = torch.cosine_similarity
    assert similar(coffee_table, row(fresh, " coffee table"), 0) > 0.99
    assert similar(coffee_table, row(fresh, " lamp"), 0) < 0.5
    assert torch.equal(others, row(fresh, "Mug"))


def test_places_start_in_order(fresh: ProprioMLLM) -> None:
    add_word_tokens(fresh.processor.tokenizer, Lessons().words())
    fresh = build_model(fresh.cfg, fresh.processor)
    before = fresh.table.detach().clone()
    order_places(fresh)
    tokens, table = tokens_of(fresh.processor.tokenizer), fresh.table.detach()
    changed = set((before != table).any(dim=1).nonzero().flatten().tolist())
    assert changed == {tokens.tokens([word])[0] for scale in PLACE_SCALES for word in scale}
    for scale in PLACE_SCALES:
        rows = functional.normalize(table[[tokens.tokens([word])[0] for word in scale]], dim=1)
        alike = rows @ rows.T
        near, far = alike.diagonal(1), alike.diagonal(len(scale) // 3)
        assert bool((near > 0.6).all()) and float(near.max()) < 0.999 and float(far.max()) < float(near.min())


def test_a_name_of_several_tokens_is_refused(fresh: ProprioMLLM) -> None:
    with pytest.raises(ValueError, match="'SpaceRocketLauncher'"):
        start_from_words(fresh, ("SpaceRocketLauncher",))
