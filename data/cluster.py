"""A Ray instance to work on: one on this machine for the time of a run, or a cluster that is there.

Without an address Ray is started on the loopback interface, with as many CPUs as there are workers, without dashboard and
usage reports. With one, the same code runs on a cluster, where this project has to be installed on every node.

Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from typing import Any, Final

#: One thread per worker, drawing without a screen, nothing from a hub.
_ENVIRONMENT: Final = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"),
    "HF_HUB_OFFLINE": "1",
}
#: Ray's own settings: it reports nothing, and workers without a GPU of their own see the machine's, as in a process pool.
_QUIET: Final = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_ENABLE_METRICS_COLLECTION": "0",
}
#: The name is the one that Ray has for it; where it is 0, its own address is 127.0.0.1 on every system.
_LOOPBACK: Final = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_OBJECT_STORE_BYTES: Final = 200_000_000


def import_ray(address: str | None = None) -> Any:
    """The module `ray`.

    Args:
        address: of a cluster; without one Ray is told, before it is first imported, to keep to the loopback interface.

    Raises:
        ValueError: when it is not installed; the message names the extra.
    """
    os.environ.update(_QUIET)
    if address is None:
        os.environ[_LOOPBACK] = "0"
    try:
        import ray
    except ImportError as error:
        raise ValueError("scheduler=ray needs Ray, which is not installed: pip install 'proprio-mllm[ray]'") from error
    return ray


@contextlib.contextmanager
def ray_instance(workers: int, address: str | None) -> Iterator[Any]:
    """Ray, started or connected for the time of the block; one that this process already uses is used and left as it is.

    Args:
        workers: CPUs of an instance started here.
        address: of a running cluster.

    Raises:
        ValueError: when there is no cluster at the address.
    """
    ray = import_ray(address)
    if ray.is_initialized():
        yield ray
        return
    quiet = {"include_dashboard": False, "log_to_driver": False, "logging_level": logging.ERROR}
    if address is None:
        before = {name: os.environ.get(name) for name in _ENVIRONMENT}
        os.environ.update(_ENVIRONMENT)  # its processes take over the environment of this moment
        try:
            ray.init("local", num_cpus=workers, object_store_memory=_OBJECT_STORE_BYTES, _node_ip_address="127.0.0.1", **quiet)
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)
    else:
        del quiet["include_dashboard"]
        try:
            ray.init(address, runtime_env={"env_vars": _ENVIRONMENT | _QUIET}, **quiet)
        except (ConnectionError, ValueError) as error:
            raise ValueError(f"ray_address={address!r}: no cluster answers there ({error})") from error
    try:
        yield ray
    finally:
        ray.shutdown()
