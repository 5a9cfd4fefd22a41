"""Speed of a chat model in this process: requests and tokens per second at several batch sizes.

    python benchmarks/local_backend.py [--weights weights/tiny/base] [--requests 32] [--batches 1,8] [--repeats 3]
        [--tokens 48]

As many threads as the largest batch ask at once, a planning prompt with a picture of 500 pixels each. Replies are drawn at
temperature 1, so that they have different lengths; each request's draws are its own, so every batch size answers the same. The
batch sizes take turns, so that what else runs on the machine disturbs all alike; the figures are medians over the repeats.
`batches` says how many the requests came in.
"""

from __future__ import annotations

import argparse
import io
import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.table import Table
from transformers.utils import logging as transformers_logging

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.local import LocalChat
from proprio_mllm.backends.protocol import ChatImage, ChatMessage, ChatReply, ChatRequest
from proprio_mllm.report.sft import plan_prompt


@dataclass(frozen=True, slots=True)
class Pass:
    """All requests answered once."""

    seconds: float
    batches: int
    prompt: int
    written: int
    latency_s: float


def requests(count: int, tokens: int) -> list[ChatRequest]:
    """Planning prompts with known objects of different number, each with a picture of its own."""
    rng = np.random.default_rng(0)
    made: list[ChatRequest] = []
    for number in range(count):
        known = [f"Mug_{n}" for n in range(1, 2 + number % 7)]
        system, user = plan_prompt("put the mug into the fridge", "h1", known[:1], [*known, "Fridge_1"], [], 0, 8)
        data = io.BytesIO()
        Image.fromarray(rng.integers(0, 256, (25, 25, 3), dtype=np.uint8)).resize((500, 500)).save(data, "png")
        messages = (ChatMessage("system", (system.text,)), ChatMessage("user", (ChatImage(data.getvalue()), user.text)))
        made.append(ChatRequest(messages, max_tokens=tokens, temperature=1.0))
    return made


def run(chat: LocalChat, asked: list[ChatRequest], threads: int) -> tuple[Pass, list[str]]:
    """Figures of one pass, and the replies."""
    before, began = chat.batches, time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        replies: list[ChatReply] = list(pool.map(chat.complete, asked))
    seconds = time.perf_counter() - began
    figures = Pass(
        seconds,
        chat.batches - before,
        sum(reply.prompt_tokens for reply in replies),
        sum(reply.completion_tokens for reply in replies),
        statistics.median(reply.latency_s for reply in replies),
    )
    return figures, [reply.text for reply in replies]


def main() -> int:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, default=Path("weights/tiny/base"))
    parser.add_argument("--requests", type=int, default=32)
    parser.add_argument("--batches", default="1,8")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--tokens", type=int, default=48)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="of the model")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    transformers_logging.disable_progress_bar()
    sizes = [int(size) for size in args.batches.split(",")]
    chats = {size: LocalChat(BackendConfig("local", "bench", model=str(args.weights), batch=size)) for size in sizes}
    asked = requests(args.requests, args.tokens)
    passes: dict[int, list[Pass]] = {size: [] for size in sizes}
    texts: dict[int, list[str]] = {}
    for repeat in range(args.repeats + 1):
        for size, chat in chats.items():
            figures, texts[size] = run(chat, asked, max(sizes))
            if repeat:  # the first warms up
                passes[size].append(figures)
    first = chats[sizes[0]]
    names = ("batch", "requests/s", "tokens written/s", "tokens read/s", "median latency [s]", "batches", "replies as first")
    table = Table(*names, title=f"{first.identity} on {first.device}, {args.threads} threads")
    for size, done in passes.items():
        seconds = statistics.median(one.seconds for one in done)
        same = sum(a == b for a, b in zip(texts[size], texts[sizes[0]], strict=True))
        table.add_row(
            str(size),
            f"{len(asked) / seconds:.1f}",
            f"{done[0].written / seconds:.0f}",
            f"{done[0].prompt / seconds:.0f}",
            f"{statistics.median(one.latency_s for one in done):.3f}",
            str(statistics.median(one.batches for one in done)),
            f"{same}/{len(asked)}",
        )
    Console(file=sys.stdout, width=120).print(table)
    for chat in chats.values():
        chat.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
