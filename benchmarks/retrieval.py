"""How well a memory's retrieval finds related tasks and moments, and how long sentence embedding takes.

    python -m proprio_mllm memory demos=DEMOS out=MEMORY
    python benchmarks/retrieval.py MEMORY DEMOS [--views 600]

Asked are the demonstrations whose task and instruction are not in the memory. `family`: the nearest stored task is of the same
family; by chance, the mean share of that family in the memory. `verbs`: it takes the same arm actions. `moments`: a step of an
asked episode is looked up by the object that it is about, which should be in view in the best moment, and by its action, which
should be what is done there. `views`: types in view that a view shares with the most alike one of another episode (intersection
over union), with the image encoder that the memory names.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from data.shards import ShardError, ShardReader, decode_png
from interface.actions import ACTIONS, ActionKind
from interface.steps import PlanStep
from proprio_mllm.planners.chat.embedding import SentenceEmbedder
from proprio_mllm.planners.chat.recall import Key, MomentRecall, TaskRecall, load_moments
from proprio_mllm.planners.chat.sight import ImageEncoder
from proprio_mllm.planners.chat.spoken import step_words, type_words
from proprio_mllm.planners.memory import MemoryEpisode, MemoryFileError, read_memory
from proprio_mllm.planners.memory_build import Candidate, candidates


def verbs(episode: MemoryEpisode) -> frozenset[str]:
    """Names of the arm actions that a task takes."""
    names = {action.name for step in episode.plan for action in PlanStep.parse(step).actions}
    return frozenset(name for name in names if ACTIONS[name].kind in (ActionKind.ARM, ActionKind.TWO_ARM))


def share(hits: Sequence[bool]) -> str:
    """Hits in per cent and as a count."""
    return f"{100 * sum(hits) / len(hits):.1f} % ({sum(hits)}/{len(hits)})"


def tasks(recall: TaskRecall, asked: Sequence[Candidate], k: int = 9) -> str:
    """Whether instructions find related tasks."""
    stored = Counter(one.family for one in recall.memory.episodes)
    found = [(one.episode, recall.nearest(one.episode.instruction, k)) for one in asked]
    chance = np.mean([stored[one.family] / stored.total() for one, _ in found])
    return "\n".join(
        (
            f"family of the nearest: {share([one.family == near[0].family for one, near in found])}, by chance {chance:.1%}",
            f"family among the {k} nearest: {share([one.family in {n.family for n in near} for one, near in found])}",
            f"verbs of the nearest: {share([verbs(one) == verbs(near[0]) for one, near in found])}",
            f"category of the nearest: {share([one.category == near[0].category for one, near in found])}",
        )
    )


def moments(recall: MomentRecall, asked: Sequence[Candidate], reader: ShardReader, name: str) -> str:
    """Whether keys find moments."""
    rng = np.random.default_rng(0)
    objects: list[bool] = []
    actions: list[bool] = []
    for one in asked:
        index = int(rng.integers(len(one.episode.steps)))
        step = one.episode.steps[index]
        about = PlanStep.parse(step.step).actions[0].object_id
        if about is None:
            continue
        image = decode_png(reader[one.row + index]["image"])
        family = recall.tasks.family(one.episode.instruction)
        for key, hits in ((Key("object", about), objects), (Key("action", step.step), actions)):
            best = recall.moments(one.episode.instruction, family, one.episode.plan, key, image, 1)[0]
            there = best.episode.steps[best.best]
            if key.kind == "object":
                hits.append(type_words(about) in {type_words(seen) for seen in there.visible})
            else:
                hits.append(step_words(there.step) == step_words(step.step))
    return f"moments {name}: object in view {share(objects)}, same action {share(actions)}"


def views(eyes: ImageEncoder, reader: ShardReader, count: int) -> str:
    """Whether views that look alike show the same."""
    rng = np.random.default_rng(0)
    rows = [reader[int(index)] for index in np.sort(rng.choice(len(reader), min(count, len(reader)), replace=False))]
    began = time.perf_counter()
    vectors = eyes.encode([decode_png(row["image"]) for row in rows])
    seconds = (time.perf_counter() - began) / len(rows)
    episodes = np.array([row["episode"] for row in rows])
    seen = [{type_words(one) for one in row["visible"]} for row in rows]
    other = episodes[:, None] != episodes
    shares: list[float] = []
    for likeness in (vectors @ vectors.T, rng.random((len(rows), len(rows)))):
        best = np.where(other, likeness, -np.inf).argmax(axis=1)
        shares.append(float(np.mean([len(a & seen[b]) / max(1, len(a | seen[b])) for a, b in zip(seen, best, strict=True)])))
    return (
        f"views: {shares[0]:.1%} of the types shared, by chance {shares[1]:.1%} ({len(rows)}); {1e3 * seconds:.1f} ms per view"
    )


def main() -> int:
    """Prints one line per figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("memory", type=Path)
    parser.add_argument("demos", type=Path)
    parser.add_argument("--views", type=int, default=600)
    args = parser.parse_args()
    if args.views < 2:
        parser.error(f"--views {args.views} must be at least 2")
    try:
        reader, memory = ShardReader(args.demos, "demos"), read_memory(args.memory)
    except (ShardError, MemoryFileError) as error:
        parser.error(str(error))
    began = time.perf_counter()
    embedder = SentenceEmbedder()
    loaded = time.perf_counter()
    known = {one.task for one in memory.episodes} | {one.instruction for one in memory.episodes}
    asked = [one for one in candidates(reader) if not known & {one.episode.task, one.episode.instruction}]
    if not asked:
        parser.error(f"every demonstration of {args.demos} is in the memory {args.memory}: none is left to ask about")
    fresh = list(dict.fromkeys(one.episode.instruction for one in asked))[:200]
    start = time.perf_counter()
    for text in fresh:
        embedder.embed([text])
    each = (time.perf_counter() - start) / len(fresh)
    recall = load_moments(str(args.memory))
    lines = [f"embedding: {loaded - began:.1f} s to import and load, {1e3 * each:.1f} ms per sentence on one core"]
    lines += [f"memory of {len(memory.episodes)}, asked {len(asked)}", tasks(recall.tasks, asked)]
    lines.append(moments(MomentRecall(recall.tasks), asked, reader, "in words"))
    if recall.eyes is not None:
        lines += [moments(recall, asked, reader, "with pictures"), views(recall.eyes, reader, args.views)]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
