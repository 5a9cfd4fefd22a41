"""Hooks of mkdocs.yml: pages that are written elsewhere become pages of the site.

The start page is README.md, the page for contributors CONTRIBUTING.md, that of changes CHANGELOG.md; the reference is made from
docstrings, which mkdocstrings reads without importing anything. Links are mended for where a page stands now; those to files
that the site does not have keep their text alone.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any, Final

from mkdocs.structure.files import File, Files  # pyright: ignore[reportMissingImports]  # of the extra `docs`

_PAGES: Final = {"index.md": "README.md", "contributing.md": "CONTRIBUTING.md", "changes.md": "CHANGELOG.md"}
_REFERENCE: Final = {
    "controller": ("Controller", ("sim.interfaces.controller",)),
    "gymnasium": ("Gymnasium", ("sim.interfaces.env",)),
    "observation": ("Observations", ("interface.observation", "interface.feedback")),
    "actions": ("Actions and steps", ("interface.actions", "interface.steps", "interface.failures")),
    "planners": ("Planners", ("proprio_mllm.planners.protocol",)),
    "eval": ("eval.py", ("configs.schema.eval",)),
    "train": ("train.py", ("configs.schema.train",)),
    "models": ("Models", ("configs.schema.model",)),
}
_LINK: Final = re.compile(r"(!?)\[([^\]]*)\]\(((?!https?:|#|mailto:)[^)#\s]+)(#[^)]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Adds the pages that are written elsewhere."""
    for name, source in _PAGES.items():
        files.append(File.generated(config, name, content=Path(source).read_text(encoding="utf-8")))
    for name, (title, modules) in _REFERENCE.items():
        parts = [f"# {title}"]
        for module in modules:
            parts += [f"## `{module}`", f"::: {module}\n    options:\n      heading_level: 3"]
        files.append(File.generated(config, f"reference/{name}.md", content="\n\n".join(parts) + "\n"))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Mends the links of a page.

    Args:
        markdown: its text.
        page: where it stands.
        config: unused.
        files: what the site has.
    """
    here = page.file.src_uri
    folder = "" if here in _PAGES else "docs"
    names = {source: name for name, source in _PAGES.items()}

    def mended(match: re.Match[str]) -> str:
        picture, text, target, anchor = match.groups()
        path = posixpath.normpath(posixpath.join(folder, target))
        found = names.get(path) or path.removeprefix("docs/")
        if files.get_file_from_path(found) is None:
            return text
        return f"{picture}[{text}]({posixpath.relpath(found, posixpath.dirname(here) or '.')}{anchor or ''})"

    return _LINK.sub(mended, markdown)
