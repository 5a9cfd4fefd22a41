"""How many episodes in words a trained model completes alone: planning without eyes, body and physics.

    python benchmarks/words.py outputs/tiny/shared/base/model [more model folders] [--episodes 300]

The episodes are drawn apart from those of training and from the benchmark's tasks, so this is where recipes are compared; a
model of 6 M parameters takes about a minute on one core. Without motion tokens, which episodes in words do not have.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

from configs.schema.collect import CollectConfig
from proprio_mllm.evaluation.dagger import student_in_text
from proprio_mllm.report.statistics import wilson
from sim.collection.text_planning import play_alone


def main() -> int:
    """Prints one line per model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    config = CollectConfig("text_planning", "unused", args.episodes, seed=args.seed)
    for model in args.models:
        played = play_alone(config, student_in_text(str(model)))
        categories = [str(episode.moments[0]["category"]) for episode in played]
        done = Counter(name for name, episode in zip(categories, played, strict=True) if episode.success)
        low, high = wilson(sum(done.values()), len(played))
        parts = ", ".join(f"{name} {done[name]}/{count}" for name, count in sorted(Counter(categories).items()))
        share = sum(done.values()) / len(played)
        sys.stdout.write(f"{model}: {share:.3f} [{low:.3f}, {high:.3f}] of {len(played)}; {parts}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
