"""What is foretold of reach: all where places decide, nothing more than the commonest answer where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.foresight import Options, Try, main, right, tries_of
from sim.collection.demonstrations import Foresight


def made(count: int, lessons: int = 20, decided: bool = True) -> list[Try]:
    """Tries at random places; too far beyond 1 m, or one in three anywhere."""
    rng = np.random.default_rng(0)
    places = rng.uniform((0.5, -0.5, 0.0), (1.5, 0.5, 0.4), (count, 3))
    far = places[:, 0] > 1.0 if decided else rng.random(count) < 0.3
    return [Try(k % lessons, ("h1", "Pick"), places[k], "TooFar" if far[k] else "") for k in range(count)]


def test_places_that_decide_are_told_and_errors_blur_them() -> None:
    tries = made(600)
    words, exact, blurred = (float(right(tries, error).mean()) for error in (None, 0.0, 0.3))
    assert words < 0.6
    assert exact > 0.93
    assert words < blurred < exact - 0.1


def test_places_that_decide_nothing_are_no_help() -> None:
    tries = made(600, decided=False)
    commonest = np.mean([not one.code for one in tries])
    assert float(right(tries, None).mean()) == pytest.approx(commonest, abs=1e-9)
    assert float(right(tries, 0.0).mean()) < commonest + 0.02


def test_a_lesson_tells_nothing_of_itself() -> None:
    assert not right(made(50, lessons=1), 0.0).any()
    other = [Try(7, ("x1", "Pick"), one.centre, one.code) for one in made(50)]
    assert not right([*made(50, lessons=1), *other], 0.0).any()  # nor one robot of the other


def test_lessons_are_played_and_their_tries_assessed(capsys: pytest.CaptureFixture[str]) -> None:
    tries = tries_of(Options(lessons=2, seed=3))
    assert {one.kind[0] for one in tries} == {"h1", "x1"}
    assert all(0.0 < np.linalg.norm(one.centre) < 12.0 for one in tries)
    assert main(["lessons=2", "seed=3"]) == 0
    head, everything, *verbs = capsys.readouterr().out.splitlines()
    assert head.split() == ["tries", "in", "reach", "words", "0", "cm", "5", "cm", "10", "cm", "20", "cm"]
    assert int(everything.split()[1]) == len(tries) >= sum(int(line.split()[1]) for line in verbs) > 0


def test_tasks_are_played_with_the_reach_test_and_without(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []
    better = Foresight.better
    monkeypatch.setattr(Foresight, "better", lambda *args: asked.append(True) or better(*args))
    assert main(["lessons=0", "tasks=120"]) == 0
    head, rules, foreseeing = capsys.readouterr().out.splitlines()
    assert head == "h1, 3 tasks: solved, in time" and asked
    assert (rules.startswith("rules "), foreseeing.startswith("with the reach test ")) == (True, True)
    for line in (rules, foreseeing):
        solved, timely = (int(word) for word in line.partition("(")[0].split()[-2:])
        parts = [word.strip(",)") for word in line.partition("(")[2].split()]
        assert (sum(map(int, parts[1::3])), sum(map(int, parts[2::3]))) == (solved, timely)
        assert 0 <= timely <= solved <= 3
