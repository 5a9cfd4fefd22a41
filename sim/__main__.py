"""Commands of the simulator: `python -m sim` lists them."""

from __future__ import annotations

import sys
from typing import Final

from configs.arguments import dispatch

COMMANDS: Final = {
    "doctor": ("sim.tools.doctor", "what this machine has of what is needed, and what to do about the rest"),
    "look": ("sim.tools.look", "pictures of rooms, object types and robots"),
    "catalogue": ("sim.tools.catalogue", "types, rooms, robots, actions, failure codes and cameras, as a list or JSON"),
    "video": ("sim.tools.video", "film of an episode that you or the expert plan"),
    "motion": ("sim.tools.motion", "film of a human clip beside the robots that it was retargeted to"),
    "collect": ("sim.collection.collect", "shards to train on: views, demonstrations, planning in words"),
    "benchmark": ("sim.benchmark.commands", "the 359 tasks and their certificates: check, refresh, tabulate, or generate them"),
    "play": ("sim.play.server", "a room to play in, in the browser"),
    "serve": ("sim.interfaces.remote.serve", "the Controller over HTTP"),
}


def main() -> int:
    """The command line; returns the exit code."""
    return dispatch("python -m sim", COMMANDS, sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
