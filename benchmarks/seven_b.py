"""Whether a machine can train and run the paper's model, and how fast: its shapes, weights of your own or random ones.

    python -m benchmarks.seven_b peak=989                                  # an H100; random weights, 17 GB on disk
    python -m benchmarks.seven_b weights=/path/to/Qwen2.5-VL-7B-Instruct
    python -m benchmarks.seven_b model=qwen2_5_vl_3b batch=1 train=[recompute=true]
    python -m benchmarks.seven_b model=tiny                                # two cores, for the benchmark's own sake

First every stage of `train.py` runs at that size with `budget=debug`: data and lessons from the simulator, a few steps of each
loop, rollouts and judging. Then steps of the joint phase of alignment are timed on decisions with pictures, in turns with MPE
and CSE and without, so that other load on the machine touches both alike; then replies. FLOP are counted, not estimated.
Point maps come from the small encoder of this project unless `train` gives CUT3R's: `train=[model.point_map.encoder=cut3r,…]`.
"""

from __future__ import annotations

import dataclasses
import gc
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode
from transformers import Qwen2_5_VLForConditionalGeneration

import train
from configs.arguments import command, read_arguments
from configs.compose import compose
from configs.schema.model import ModelConfig
from configs.schema.train import TrainConfig
from configs.validate import build
from data.files import new_folder, read_json
from proprio_mllm.evaluation.lessons import Lessons
from proprio_mllm.model.backbone import backbone_config, given_config
from proprio_mllm.model.batch import Batch, Collator, Example
from proprio_mllm.model.building import build_processor, load_model, load_motion
from proprio_mllm.model.groups import train_only
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.training.alignment import PHASES
from proprio_mllm.training.loop import make_optimizer
from proprio_mllm.training.memory import spare_memory
from proprio_mllm.training.pipeline import Pipeline, variant_model
from proprio_mllm.training.processes import processes
from proprio_mllm.training.stages import STAGES
from proprio_mllm.training.stages.inputs import lessons_of, turns_of

ROOT = Path(__file__).parents[1]
_WARM = 2
_REPLY = 24


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        model: whose shapes.
        weights: folder of released weights; None draws random ones.
        train: more overrides of `train.py`.
        batch: decisions of a timed step.
        steps: timed steps, with and without MPE and CSE each.
        peak: TFLOP/s of the device at its best, for the share that is used; 0 leaves that out.
        folder: for weights, data and models; what is there goes on.
        until: the last stage that runs first, `alignment` or `selu`.
    """

    model: str = "qwen2_5_vl_7b"
    weights: str | None = None
    train: tuple[str, ...] = ()
    batch: int = 4
    steps: int = 8
    peak: float = 0.0
    folder: str = "outputs/seven_b"
    until: Literal["alignment", "selu"] = "selu"


@dataclass(frozen=True)
class Timed:
    """Median seconds of a step, its TFLOP, and the largest memory of the device so far, GB (0 on a CPU)."""

    seconds: float
    tflop: float
    gigabytes: float


def random_weights(model: ModelConfig, folder: Path) -> Path:
    """Writes a backbone with random weights, as released ones are stored, around a tokenizer of a few words."""
    if not folder.is_dir():
        processor = build_processor(dataclasses.replace(model, weights=None), [" ".join(Lessons().words())] * 2)
        ours = backbone_config(dataclasses.replace(model, weights=None), processor)
        config = ours if model.weights is None else given_config(model.weights)
        for name in ("image_token_id", "video_token_id", "vision_start_token_id", "vision_end_token_id"):
            setattr(config, name, getattr(ours, name))
        torch.set_default_dtype(getattr(torch, model.dtype))
        with new_folder(folder) as work, torch.device(processes().device or "cpu"):
            Qwen2_5_VLForConditionalGeneration(config).save_pretrained(str(work))
            processor.save_pretrained(str(work))
        torch.set_default_dtype(torch.float32)
    return folder


def settings(options: Options, folder: Path) -> list[str]:
    """Overrides of `train.py`."""
    common = [
        "budget=debug",
        f"model={options.model}",
        "model.point_map.encoder=sim",
        "model.places=false",
        "logger.wandb=disabled",
    ]
    words = [*common, f"output={folder}", *options.train]
    model = build(TrainConfig, compose("train", words)).model
    weights = random_weights(model, folder / "weights") if options.weights is None else Path(options.weights)
    return [*words, f"model.weights={weights}"]


def plain(model: ProprioMLLM) -> ModelConfig:
    """The same without MPE and CSE."""
    return variant_model(model.cfg, "no_mpe_cse")


def trained(model: ProprioMLLM, batch: Batch, optimizer: torch.optim.Optimizer, cse: bool) -> None:
    """One step."""
    kept = model.cse
    model.cse = kept if cse else None
    try:
        model(batch).loss.backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    finally:
        model.cse = kept


def clock() -> float:
    """Seconds, once the device has done what it was given."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def steps(model: ProprioMLLM, batches: Sequence[tuple[Batch, Batch]], optimizer: torch.optim.Optimizer) -> list[Timed]:
    """Times steps with MPE and CSE, and without, in turns.

    Args:
        model: what trains.
        batches: the same decisions with the positions of either.
        optimizer: of the whole.
    """
    times: tuple[list[float], list[float]] = ([], [])
    flop = [0.0, 0.0]
    for number, pair in enumerate(batches):
        for which in (0, 1) if number % 2 else (1, 0):
            work = partial(trained, model, pair[which], optimizer, which == 0)
            if number == 0:
                with FlopCounterMode(display=False) as counter:
                    work()
                flop[which] = float(counter.get_total_flops()) / 1e12
                continue
            began = clock()
            work()
            if number >= _WARM:
                times[which].append(clock() - began)
    held = torch.cuda.max_memory_allocated() / 1e9 if torch.cuda.is_available() else 0.0
    return [Timed(statistics.median(seconds), tflop, held) for seconds, tflop in zip(times, flop, strict=True)]


def measured(options: Options, cfg: TrainConfig) -> list[str]:
    """Times training and replies of the model that alignment made."""
    pipeline = Pipeline(STAGES, cfg, lessons=Lessons(cfg.data.robots))
    folder = pipeline.paths.model("alignment")
    model, motion = load_model(folder, trainable=True), load_motion(folder)
    model.to(processes().device)
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    demos = lessons_of(pipeline, model.cfg)
    turns = turns_of(pipeline, model, demos, motion)
    rng = np.random.default_rng(cfg.seed)
    drawn = [turns.draw(rng, options.batch) for _ in range(_WARM + options.steps)]
    collators = Collator(model.processor, model.cfg), Collator(model.processor, plain(model))
    batches = [(collators[0](rows).to(model.device), collators[1](rows).to(model.device)) for rows in drawn]
    train_only(model, PHASES["joint"].groups)
    spare_memory(model, cfg.recompute, cfg.shard)
    model.train()
    full, bare = steps(model, batches, make_optimizer(model, cfg.alignment.joint))
    tokens = statistics.mean(int(pair[0].attention_mask.sum()) for pair in batches)
    reached = full.tflop / full.seconds
    share = f", {100 * reached / options.peak:.0f} % of {options.peak:g}" if options.peak else ""
    memory = f", {full.gigabytes:.1f} GB" if full.gigabytes else ""
    return [
        f"a joint step of {options.batch} decisions, {tokens:.0f} tokens: {full.seconds:.3f} s, {tokens / full.seconds:.0f} "
        f"tokens/s, {full.tflop:.2f} TFLOP, {reached:.2f} TFLOP/s{share}{memory}",
        f"without MPE and CSE: {bare.seconds:.3f} s, {bare.tflop:.2f} TFLOP; the two cost "
        f"{100 * (full.seconds / bare.seconds - 1):+.1f} % of time, {100 * (full.tflop / bare.tflop - 1):+.1f} % of FLOP",
        *(replies(model, drawn, size) for size in (1, options.batch)),
    ]


def replies(model: ProprioMLLM, drawn: Sequence[Sequence[Example]], size: int) -> str:
    """Times replies of a fixed length to decisions."""
    model.eval()
    rows = [row for rows in drawn for row in rows][:size]
    asked = Collator(model.processor, model.cfg)(rows, generation=True).to(model.device)
    times = []
    for longest in (1, _REPLY):
        began = clock()
        said = model.generate(asked, longest)
        times.append((clock() - began, max(map(len, said))))
    (first, _), (whole, words) = times
    each = (whole - first) / max(words - 1, 1)
    return f"{size} at once: first token after {first:.3f} s, then {1 / max(each, 1e-9) * len(rows):.0f} tokens/s"


@command(ValueError)
def main(arguments: Sequence[str]) -> int:
    """Command line."""
    options = read_arguments(Options, arguments)
    folder = Path(options.folder).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    words = settings(options, folder)
    began = time.monotonic()
    cfg = build(TrainConfig, compose("train", words))
    stages = Pipeline(STAGES, cfg).ancestors(options.until)
    for stage in ("data", "collect"):  # whose processes need no more than the simulator
        done = subprocess.run([sys.executable, "train.py", f"stage={stage}", *words], cwd=ROOT, check=False)
        if done.returncode:
            return done.returncode
    for stage in stages:
        if train.job(dataclasses.replace(cfg, stage=stage)):
            return 1
        gc.collect()
    name = torch.cuda.get_device_name() if torch.cuda.is_available() else f"{torch.get_num_threads()} threads"
    print(f"{options.model} on {name}, torch {torch.__version__}, {'random' if options.weights is None else 'given'} weights")
    paths = Pipeline(STAGES, cfg).paths
    spent = {stage: read_json(paths.stage(stage) / "done.json")["metrics"]["seconds"] for stage in stages}
    told = ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in spent.items())
    print(f"all stages, a few steps each: {time.monotonic() - began:.0f} s ({told})")
    for line in measured(options, cfg):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
