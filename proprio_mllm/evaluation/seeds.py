"""Seeds of an episode: hashed from (task, robot, trial) and the run's seed, never from a clock or a process id.

The planner is not part of the hash: every planner meets the same contingencies in the same trial, so planners are compared in
pairs.
"""

from __future__ import annotations

import hashlib

import numpy as np


def episode_seed(seed: int, task: str, robot: str, trial: int) -> int:
    """Seed of an episode in [0, 2^31)."""
    key = f"{seed}|{task}|{robot}|{trial}".encode()
    return int.from_bytes(hashlib.blake2b(key, digest_size=8).digest(), "big") % 2**31


def stream(seed: int, name: str) -> np.random.Generator:
    """An independent random stream of an episode, by purpose (`planner`, `start` …)."""
    digest = hashlib.blake2b(name.encode(), digest_size=4).digest()
    return np.random.default_rng([seed, int.from_bytes(digest, "big")])
