"""Which bugs the tests notice: `make mutants`, or `python benchmarks/mutants.py [count=300] [seed=0] [workers=2]`.

Bugs are put one by one into a copy of the checkout, in the modules that make results: a comparison turned round, `and` for
`or`, a sign, a number, a condition dropped. They are sampled with the seed, and the tests of a bug's module run until one
fails. Results are appended to a JSON-lines file, so a killed run goes on; bugs that nothing noticed are listed at the end.
(mutmut and cosmic-ray do this for whole projects; what is wanted here is a sample over some modules, each with its own tests.)
"""

from __future__ import annotations

import ast
import copy
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

import numpy as np
from tqdm import tqdm

from configs.arguments import command, read_arguments

ROOT = Path(__file__).parents[1]
#: Modules that make results, and the tests that answer for them.
MODULES = {
    "interface/facts.py": "tests/interface tests/sim/tasks/test_predicates.py tests/sim/expert/test_jobs.py",
    "interface/requirements.py": "tests/interface",
    "interface/symbolic.py": "tests/interface",
    "interface/belief.py": "tests/interface tests/planners/scripted",
    "sim/tasks/predicates.py": "tests/sim/tasks/test_predicates.py",
    "sim/expert/jobs.py": "tests/sim/expert/test_jobs.py",
    "sim/session/contingency.py": "tests/sim/session/test_contingency.py",
    "data/filter.py": "tests/data/test_filter_table.py tests/data/test_retarget.py",
    "data/metrics.py": "tests/data/test_retarget.py",
    "data/motion.py": "tests/data/test_motion.py",
    "proprio_mllm/evaluation/attribution.py": "tests/evaluation/test_attribution.py",
    "proprio_mllm/evaluation/ledger.py": "tests/evaluation/test_ledger.py",
    "proprio_mllm/evaluation/episode.py": "tests/evaluation/test_episode.py",
    "proprio_mllm/report/metrics.py": "tests/report/test_metrics.py",
    "proprio_mllm/report/statistics.py": "tests/report/test_statistics.py",
    "proprio_mllm/report/comparison.py": "tests/report/test_comparison.py",
    "proprio_mllm/training/critic.py": "tests/training/test_critic.py",
    "proprio_mllm/training/goals.py": "tests/training/test_goals.py",
    "proprio_mllm/training/loop.py": "tests/training/test_loop.py tests/training/test_processes.py",
    "proprio_mllm/model/mpe.py": "tests/model/test_mpe.py",
    "proprio_mllm/model/cse.py": "tests/model/test_spatial.py",
    "proprio_mllm/model/quantizer.py": "tests/model/test_motion_tokenizer.py",
    "proprio_mllm/model/motion_tokenizer.py": "tests/model/test_motion_tokenizer.py",
}
_COMPARED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        count: bugs.
        seed: of their choice.
        workers: copies of the checkout that are tested side by side.
        out: JSON-lines file that takes the results.
        only: part of a module's path, to try that alone.
    """

    count: int = 300
    seed: int = 0
    workers: int = 2
    out: str = "outputs/mutants.jsonl"
    only: str = ""


def places(tree: ast.Module) -> Iterator[ast.AST]:
    """Nodes of a module that a bug can be put into; messages, annotations, decorators and docstrings are no code."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop(0)
        if isinstance(node, ast.BinOp | ast.AugAssign):
            wanted = type(node.op) in _COMPUTED
        elif isinstance(node, ast.Constant):
            wanted = isinstance(node.value, bool | int | float)
        elif isinstance(node, ast.UnaryOp):
            wanted = isinstance(node.op, ast.Not)
        else:
            wanted = isinstance(node, ast.Compare | ast.BoolOp | ast.IfExp)
        if wanted:
            yield node
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "exc", "msg"):
                continue
            waiting += [one for one in (value if isinstance(value, list) else [value]) if isinstance(one, ast.AST)]


def broken(node: ast.AST) -> ast.AST:
    """A node with a bug in it."""
    match node:
        case ast.Compare(ops=[first, *rest]):
            node.ops = [_COMPARED[type(first)](), *rest]
        case ast.BoolOp():
            node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        case ast.IfExp():
            node.body, node.orelse = node.orelse, node.body
        case ast.BinOp() | ast.AugAssign():
            node.op = _COMPUTED[type(node.op)]()
        case ast.UnaryOp():
            return node.operand
        case ast.Constant(value=bool()):
            node.value = not node.value
        case ast.Constant(value=int() as number):
            node.value = number + 1
        case ast.Constant(value=float() as number):
            node.value = 1.5 * number + 0.5
    return node


def with_bug(source: str, number: int) -> tuple[str, int, str]:
    """A module with the bug of a number in it, the line, and what stood there and stands there now."""
    tree = ast.parse(source)
    wanted = list(places(tree))[number]
    before, line = ast.unparse(wanted), wanted.lineno  # type: ignore[attr-defined]
    after = broken(copy.deepcopy(wanted))

    class Replace(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            return ast.copy_location(after, node) if node is wanted else self.generic_visit(node)

    changed = ast.fix_missing_locations(Replace().visit(tree))
    return ast.unparse(changed) + "\n", line, f"{before} -> {ast.unparse(after)}"


def noticed(checkout: Path, module: str, source: str) -> bool:
    """Whether a test of the module fails, or does not end, in a checkout with this source in its place."""
    path = checkout / module
    sound = path.read_text(encoding="utf-8")
    path.write_text(source, encoding="utf-8")
    try:
        words = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", *MODULES[module].split()]
        environment = os.environ | {"PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": "1"}
        return bool(subprocess.run(words, cwd=checkout, env=environment, capture_output=True, timeout=600).returncode)
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_text(sound, encoding="utf-8")


def copied(into: Path) -> Path:
    """A copy of the tracked files."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in names.split("\0"):
        if name and (ROOT / name).is_file():
            (into / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, into / name)
    return into


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line."""
    options = read_arguments(Options, arguments)
    sources = {name: (ROOT / name).read_text(encoding="utf-8") for name in MODULES if options.only in name}
    every = [(name, number) for name, source in sources.items() for number in range(len(list(places(ast.parse(source)))))]
    order = np.random.default_rng(options.seed).permutation(len(every))[: options.count]
    out = Path(options.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    lines = [json.loads(line) for line in out.read_text().splitlines()] if out.is_file() else []
    known = {(one["module"], one["bug"], one["line"]): one for one in lines}
    found: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder, tqdm(total=len(order), unit="bug") as bar:
        free: SimpleQueue[Path] = SimpleQueue()
        for number in range(options.workers):
            free.put(copied(Path(folder) / str(number)))

        def tried(index: int) -> dict[str, object]:
            module, number = every[index]
            source, line, bug = with_bug(sources[module], number)
            result = known.get((module, bug, line))
            if result is None:
                checkout = free.get()
                result = {"module": module, "line": line, "bug": bug, "noticed": noticed(checkout, module, source)}
                free.put(checkout)
                with out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(result) + "\n")
            bar.update(1)
            return result

        with ThreadPoolExecutor(options.workers) as pool:
            found = list(pool.map(tried, order.tolist()))
    for name in sources:
        own = [one["noticed"] for one in found if one["module"] == name]
        print(f"{sum(map(bool, own)):4d} of {len(own):4d} noticed  {name}")
    print(f"{sum(bool(one['noticed']) for one in found)} of {len(found)} noticed")
    for one in found:
        if not one["noticed"]:
            print(f"not noticed: {one['module']}:{one['line']}: {one['bug']}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
