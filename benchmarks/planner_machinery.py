"""Whether the planners' machinery works, measured with a script that knows the expert's plan: no result of any model.

    python benchmarks/planner_machinery.py [--tasks 20] [--robot h1] [--mistakes 0.15] [--memory outputs/memory] [--out FILE.md]

The same tasks, contingencies and script (`benchmarks/imperfect_expert.py`) for every planner, in one run:

* reflection: success at difficulty medium, where half of the skills fail by chance, with reflection and without;
* mistakes: success at easy when the script slips (wrong arm, wrong height, too far, malformed) in a share of its steps;
* scheduling: steps and simulated seconds of DAG-Plan's graphs on both arms against the same graphs one node at a time.

Retrieval is measured by `benchmarks/retrieval.py`. The tasks are the first of each family whose certified plan has two arm
actions, walks and no step twice, so that the script can tell from a log how far the plan has come.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import sim.tasks  # noqa: F401  # chooses the OpenGL backend before anything draws
from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.validate import build
from interface.episode import EpisodeRecord, Outcome
from proprio_mllm.evaluation.run import evaluate
from proprio_mllm.planners.memory import MemoryFileError, check_memory
from robots.spec import available_robots
from sim.benchmark.certificates import load_certificates
from sim.tasks.task import Task, load_benchmark, write_tasks

SCRIPT = Path(__file__).with_name("imperfect_expert.py")
PLANNERS = ("gpt4o", "llm_planner", "rap", "dag_plan")
LABELS = {"gpt4o": "plain prompting", "llm_planner": "LLM-Planner", "rap": "RAP", "dag_plan": "DAG-Plan"}


def chosen(robot: str, count: int) -> list[Task]:
    """Tasks whose certified plans the script can follow, families in turn."""
    tasks = {task.id: task for task in load_benchmark()}
    instructions = [task.instruction for task in tasks.values()]
    families: dict[str, list[Task]] = {}
    for certificate in load_certificates():
        task, plan = tasks[certificate.task], certificate.plan
        arms = sum(step.count("left") + step.count("right") + 2 * step.count("Both(") for step in plan)
        plain = not any(word in step for step in plan for word in ("Move", "Rotate", "Open", "Release"))
        once = len(set(plan)) == len(plan) and instructions.count(task.instruction) == 1
        if certificate.robot == robot and plain and arms >= 2 and once:
            families.setdefault(task.family, []).append(task)
    turns = max(map(len, families.values()))
    return [family[turn] for turn in range(turns) for family in families.values() if turn < len(family)][:count]


def run(planner: str, overrides: Sequence[str], tasks: Path, output: Path, memory: str) -> tuple[EpisodeRecord, ...]:
    """Records of a run."""
    own = [f"planner.memory={memory}"] if planner in ("llm_planner", "rap") else []
    values = [
        f"planner={planner}", "backend=scripted", f"backend.source={SCRIPT}:answer", "workers=0", "threads=4", *own, *overrides,
        f"tasks={tasks}", f"output={output}",
    ]  # fmt: skip
    return evaluate(build(EvalConfig, compose("eval", values))).records


def line(name: str, records: Sequence[EpisodeRecord]) -> str:
    """A row of the table."""
    solved = [record for record in records if record.outcome is Outcome.SUCCESS]
    calls, reflections = (np.mean([getattr(r, name) for r in records]) for name in ("planner_calls", "reflections"))
    invalid = sum(record.invalid_output for record in records)
    steps, seconds = (f"{np.mean([getattr(r, k) for r in solved]):.1f}" if solved else "" for k in ("steps", "makespan_s"))
    return f"| {name} | {len(solved)}/{len(records)} | {calls:.1f} | {reflections:.1f} | {invalid} | {steps} | {seconds} |"


def scheduling(robot: str, count: int, folder: Path, memory: str) -> list[str]:
    """DAG-Plan's graphs on both arms and one node at a time, over the tasks that both solve; no budget ends an episode."""
    os.environ["MISTAKES"] = "0"
    tasks = [task for task in chosen(robot, 4 * count) if task.category != "single"][: 2 * count]
    file = folder / "scheduling.jsonl"
    write_tasks([dataclasses.replace(task, time_limit=40) for task in tasks], file)
    records: list[dict[str, EpisodeRecord]] = []
    for parallel in ("true", "false"):
        changes = [f"robot={robot}", "reflection=off", f"planner.parallel={parallel}"]
        found = run("dag_plan", changes, file, folder / f"scheduling-{parallel}", memory)
        records.append({record.task: record for record in found if record.outcome is Outcome.SUCCESS})
    both = sorted(set(records[0]) & set(records[1]))
    rows = [
        f"Scheduling: {len(both)} of {len(tasks)} tasks for two arms that both ways solve.",
        "",
        "| DAG-Plan | steps | seconds | arms at work % |",
        "|---|---|---|---|",
    ]
    for name, found in zip(("both arms at once", "one node at a time"), records, strict=True):
        steps, seconds, arms = (
            np.mean([getattr(found[task], key) for task in both]) for key in ("steps", "makespan_s", "arm_utilisation")
        )
        rows.append(f"| {name} | {steps:.2f} | {seconds:.1f} | {100 * arms:.0f} |")
    faster = sum(records[0][task].makespan_s < records[1][task].makespan_s for task in both)
    return [*rows, "", f"Both arms at once take less time in {faster} of {len(both)} tasks."]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", type=int, default=20)
    parser.add_argument("--robot", default="h1", choices=available_robots())
    parser.add_argument("--mistakes", type=float, default=0.15)
    parser.add_argument("--memory", default="outputs/memory")
    parser.add_argument("--planners", default=",".join(PLANNERS))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    planners = options.planners.split(",")
    unknown = [name for name in planners if name not in PLANNERS]
    if unknown or not 0.0 <= options.mistakes <= 1.0 or options.tasks < 1:
        allowed = f"--planners of {','.join(PLANNERS)}; --mistakes in [0, 1]; --tasks at least 1"
        parser.error(f"--planners {options.planners} --mistakes {options.mistakes} --tasks {options.tasks}; allowed: {allowed}")
    if {"llm_planner", "rap"} & set(planners):
        try:
            check_memory(Path(options.memory))
        except MemoryFileError as error:
            parser.error(str(error))
    tasks = chosen(options.robot, options.tasks)
    rows = [
        f"{len(tasks)} tasks of {len({task.family for task in tasks})} families, {options.robot}; a script in a model's place.",
        "",
        "| planner | solved | calls | reflections | invalid | steps | seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tasks.jsonl"
        write_tasks(tasks, file)
        for planner in planners:
            for mistakes, difficulty, reflection in (
                (0.0, "easy", "on"),
                (options.mistakes, "easy", "on"),
                (options.mistakes, "easy", "off"),
                (0.0, "medium", "on"),
                (0.0, "medium", "off"),
            ):
                os.environ["MISTAKES"] = str(mistakes)
                name = f"{LABELS[planner]}, {difficulty}, mistakes {mistakes:g}, reflection {reflection}"
                output = Path(folder) / f"{planner}-{mistakes}"
                changes = [f"robot={options.robot}", f"difficulty={difficulty}", f"reflection={reflection}"]
                rows.append(line(name, run(planner, changes, file, output, options.memory)))
                sys.stdout.write(rows[-1] + "\n")
                sys.stdout.flush()
        if "dag_plan" in planners:
            rows += ["", *scheduling(options.robot, options.tasks, Path(folder), options.memory)]
    text = "\n".join(rows) + "\n"
    sys.stdout.write("\n" + text)
    if options.out is not None:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
