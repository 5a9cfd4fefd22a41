"""The structure of a checkout: `python tools/structure.py [FOLDER] [--compare OTHER] [--json]`, or `--check` to judge it.

Counts modules, lines, import cycles (imports under TYPE_CHECKING and inside functions included), the classes with most public
methods, the largest modules and functions, public names, `python -m` commands, and the files that name an action, which is what
a new skill would have to touch. Nothing is imported: the code is read as text.

`--check` fails on an import cycle, and on an import that `[tool.structure.allowed]` of pyproject.toml does not list: for each
package what it may import, of this project and, for the interface, of others. The most specific package decides.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

PACKAGES = ("configs", "interface", "robots", "data", "sim", "proprio_mllm")


def modules_of(root: Path) -> dict[str, Path]:
    """Dotted names of all modules below a checkout, with their files."""
    found: dict[str, Path] = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports_of(tree: ast.AST, name: str, modules: dict[str, Path]) -> set[str]:
    """Modules of the project that a module imports, wherever in its code."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full in modules else node.module)
    return {other for other in found if other in modules and other != name}


def cycles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(edges[node]):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            component = []
            while not component or component[-1] != node:
                component.append(stack.pop())
            if len(component) > 1:
                found.append(sorted(component))

    sys.setrecursionlimit(10_000)
    for node in sorted(edges):
        if node not in index:
            visit(node)
    return sorted(found)


def within(module: str, packages: Sequence[str]) -> str:
    """The most specific of some packages that a module belongs to, empty when it belongs to none."""
    return max((one for one in packages if module == one or module.startswith(f"{one}.")), key=len, default="")


def foreign(root: Path) -> Iterator[str]:
    """Imports that the allowlists of a checkout do not list."""
    allowed = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["structure"]["allowed"]
    modules = modules_of(root)
    for name, path in modules.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        home = within(name, list(allowed))
        for other in sorted(imports_of(tree, name, modules)):
            if not within(other, [home, *allowed[home]]):
                yield f"{name} imports {other}; {home} may import {', '.join(allowed[home]) or 'nothing'}"
        if home == "interface":
            outside = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
            outside |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
            for other in sorted({one.split(".")[0] for one in outside} - set(sys.stdlib_module_names) - {"interface", "numpy"}):
                yield f"{name} imports {other}; the interface needs numpy and the standard library alone"


def measure(root: Path) -> dict[str, Any]:
    """All figures of a checkout."""
    modules = modules_of(root)
    texts = {name: path.read_text(encoding="utf-8") for name, path in modules.items()}
    trees = {name: ast.parse(text) for name, text in texts.items()}
    lines = {name: len(text.splitlines()) for name, text in texts.items()}
    methods: dict[str, int] = {}
    functions: dict[str, int] = {}
    public = 0
    for name, tree in trees.items():
        public += sum(not node.name.startswith("_") for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef))
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                own = [one for one in node.body if isinstance(one, ast.FunctionDef) and not one.name.startswith("_")]
                methods[f"{name}.{node.name}"] = len(own)
            elif isinstance(node, ast.FunctionDef):
                functions[f"{name}.{node.name}"] = (node.end_lineno or node.lineno) - node.lineno + 1

    def most(values: dict[str, int]) -> dict[str, int]:
        return dict(sorted(values.items(), key=lambda item: (-item[1], item[0]))[:5])

    return {
        "modules": len(modules),
        "lines": sum(lines.values()),
        "lines per package": {
            package: sum(n for name, n in lines.items() if name.split(".")[0] == package) for package in PACKAGES
        },
        "import cycles": cycles({name: imports_of(tree, name, modules) for name, tree in trees.items()}),
        "most public methods": most(methods),
        "largest modules": most(lines),
        "longest functions": most(functions),
        "public names": public,
        "python -m commands": sum('__name__ == "__main__"' in text for text in texts.values()),
        "files that name Slice": sum(bool(re.search(r'"Slice"', text)) for text in texts.values()),
        "files that name Lift": sum(bool(re.search(r'"Lift"', text)) for text in texts.values()),
    }


def say(*parts: object) -> None:
    """A line of the report."""
    sys.stdout.write(" ".join(map(str, parts)) + "\n")


def main() -> int:
    """Prints the figures; with `--check` what is wrong, and exit code 1 when something is."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path())
    parser.add_argument("--compare", type=Path, help="another checkout, shown first")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    if options.check:
        found = [f"import cycle: {' '.join(one)}" for one in measure(options.folder)["import cycles"]]
        found += foreign(options.folder)
        for line in found:
            say(line)
        return int(bool(found))
    columns = [measure(folder) for folder in ([options.compare] if options.compare else []) + [options.folder]]
    if options.json:
        say(json.dumps(columns, indent=1))
        return 0
    for name in columns[0]:
        values = [column[name] for column in columns]
        if name == "import cycles":
            say(f"{name}: {' -> '.join(str(len(value)) for value in values)}")
            for component in values[-1]:
                say("   ", " ".join(component))
        elif isinstance(values[0], dict):
            say(f"{name}:")
            for value in values:
                say("   ", ", ".join(f"{key} {number}" for key, number in value.items()))
        else:
            say(f"{name}: {' -> '.join(map(str, values))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
