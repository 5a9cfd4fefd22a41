"""Codes and margins in words."""

from __future__ import annotations

import pytest

from interface.failures import FAILURES, FailureCode
from proprio_mllm.report.words import code_in_words, margins_in_words


@pytest.mark.parametrize("code", FailureCode)
def test_every_margin_of_every_code_has_a_sentence(code: FailureCode) -> None:
    margins = dict.fromkeys(FAILURES[code].margins, -0.25)
    said = margins_in_words("x1", code.value, margins)
    assert len(said) == len(margins)
    assert all(sentence.endswith(f"({name} -0.25)") for sentence, name in zip(said, margins, strict=True))
    assert code_in_words(code.value) == FAILURES[code].meaning


def test_signs_decide_the_words() -> None:
    def say(code: str, **margins: float) -> str:
        return " ".join(margins_in_words("x1", code, margins))

    assert say("BodyTooHigh", height_m=-0.12) == "X1's pelvis is 0.12 m too high (height_m -0.12)"
    assert say("BodyTooLow", height_m=0.2).startswith("X1's pelvis is 0.20 m too low")
    assert "last 0.05 m down" in say("HeightLimit", height_m=-0.05) and "up" in say("HeightLimit", height_m=0.05)
    assert "beyond X1's reach" in say("TooFar", reach_m=0.3) and "within X1's reach" in say("BodyTooLow", reach_m=-0.3)
    assert "above" in say("TooHeavy", mass_kg=1.0) and "below" in say("TooHeavy", mass_kg=-1.0)
    assert say("Unheard", depth_m=0.1) == "depth_m +0.1" and code_in_words("Unheard") == "Unheard"
