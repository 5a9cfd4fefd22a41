"""Draws against the distribution they are of, and limits of each row."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from proprio_mllm.backends.decoding import Limits, Rule, Rules

IDS = torch.zeros(1, 1, dtype=torch.long)


@pytest.mark.parametrize("temperature", [0.5, 1.0, 2.0])
def test_draws_follow_the_softmax(temperature: float) -> None:
    """20 000 draws: 40 rows with seeds of their own, 500 tokens each."""
    scores = torch.tensor([1.0, 0.0, -0.5, 2.0, -torch.inf]).expand(40, 5)
    rules = Rules([Rule(temperature, seed) for seed in range(40)])
    drawn = torch.cat([rules(IDS.expand(40, 1), scores).argmax(dim=1) for _ in range(500)])
    counts = np.bincount(drawn.numpy(), minlength=5)
    expected = torch.softmax(scores[0].double() / temperature, 0).numpy() * len(drawn)
    assert counts[4] == 0
    assert chisquare(counts[:4], expected[:4]).pvalue > 0.001


def test_a_row_draws_the_same_whoever_stands_beside_it() -> None:
    scores = torch.randn(3, 50, generator=torch.Generator().manual_seed(0))
    together, alone = Rules([Rule(0.0), Rule(1.0, 5), Rule(1.5, 6)]), Rules([Rule(1.5, 6)])
    for _ in range(20):
        rows = together(IDS.expand(3, 1), scores)
        assert torch.equal(rows[2:], alone(IDS, scores[2:]))
        assert torch.equal(rows[0], scores[0]), "temperature 0 leaves the scores as they are"
        assert not torch.equal(rows[1], scores[1])


def test_each_row_ends_at_its_own_length() -> None:
    limits = Limits(prompt=4, limits=[1, 3, 2])
    done = [limits(torch.zeros(3, 4 + written), None).tolist() for written in (1, 2, 3)]
    assert done == [[True, False, False], [True, False, True], [True, True, True]]
