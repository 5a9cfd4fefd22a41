"""The benchmark of the paper's model runs as it is, at a size that fits here."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_every_stage_runs_and_is_timed(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "benchmarks.seven_b", "model=tiny", f"folder={tmp_path}", "steps=3", "batch=2", "peak=1"]
    done = subprocess.run(words, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    named = re.search(r"all stages, a few steps each: .* pointmap .* alignment .* selu ", done.stdout)
    step = re.search(r"2 decisions, (\d+) tokens: ([\d.]+) s, \d+ tokens/s, ([\d.]+) TFLOP, .* % of 1\n", done.stdout)
    assert named and step, done.stdout
    bare = re.search(r"without MPE and CSE: [\d.]+ s, ([\d.]+) TFLOP; .* % of FLOP", done.stdout)
    assert bare and 0 < float(bare[1]) <= float(step[3])
    assert len(re.findall(r"at once: first token after [\d.]+ s, then \d+ tokens/s", done.stdout)) == 2
