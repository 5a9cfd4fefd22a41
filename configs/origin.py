"""Where a result was made: the commit of the code, and the processor, whose last bits floating-point results depend on."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path
from typing import Final

#: Beside released weights, what made them.
PROVENANCE: Final = "provenance.json"
_ROOT: Final = Path(__file__).parents[1]


def origin() -> dict[str, str | None]:
    """`commit`, marked `+` where files differ from it and None outside a checkout, and `processor`."""
    return {"commit": _commit(), "processor": _processor()}


def _commit() -> str | None:
    if not (_ROOT / ".git").exists():  # installed, perhaps inside somebody else's checkout
        return None
    try:
        head, changed = (
            subprocess.run(["git", "-C", str(_ROOT), *words], capture_output=True, text=True, timeout=10, check=True).stdout
            for words in (("rev-parse", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return head.strip() + ("+" if changed.strip() else "")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
