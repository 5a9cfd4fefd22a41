"""`python -m sim serve [host=... port=... worlds=... idle_s=...]`: serves until interrupted."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from typing import Final

from configs.arguments import read_arguments
from configs.validate import ConfigError
from sim.interfaces.remote.server import RemoteServer, ServerConfig

TOKEN_VARIABLE: Final = "DUALTHOR_TOKEN"


def main(arguments: Sequence[str]) -> int:
    """Command line; returns the exit code."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    try:
        config = read_arguments(ServerConfig, arguments)
        server = RemoteServer(config, os.environ.get(TOKEN_VARIABLE) or None)
    except (ConfigError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except ValueError as error:
        sys.stderr.write(f"{error}; set {TOKEN_VARIABLE}\n")
        return 2
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: threading.Thread(target=server.stop).start())
    sys.stdout.write(f"serving {server.url}, at most {config.worlds} worlds; stop with Ctrl-C\n")
    sys.stdout.flush()
    server.serve()
    return 0
