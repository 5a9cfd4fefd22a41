"""What decides a backend's replies, in one line.

URL, key and kind do not: the same model behind another server, or its recorded replies, is the same backend. Paper: none
(engineering).
"""

from __future__ import annotations

import json
from pathlib import Path

from configs.schema.backend import BackendConfig
from data.code_files import source_digest


def identity_of(cfg: BackendConfig) -> str:
    """Canonical JSON of model, revision and what is fixed in the configuration; the rest is in every request.

    Of a scripted backend it is the digest of its file, which has to be loaded. A local checkpoint is known by the folder's name
    and `revision`, for which `LocalChat` takes the checkpoint's fingerprint when none is given, and runs what the server of
    this project tells of its model; replaying such a run needs it, `backend.revision=…` as the ledger's `models` show it.
    """
    if cfg.source is not None:
        return _canonical({"script": source_digest(cfg.source)})
    return _canonical(
        {
            "model": _known_as(cfg),
            "revision": cfg.revision,
            "structured": cfg.structured,
            "dtype": cfg.dtype,
            "constrained": cfg.constrained,
        }
    )


def _known_as(cfg: BackendConfig) -> str:
    """A model's name; of a folder its last part, since the digest says what is in it, wherever it lies."""
    path = Path(cfg.model).expanduser()
    here = cfg.kind == "local" or (cfg.kind == "replay" and path.is_dir())
    return path.resolve().name if here else cfg.model


def _canonical(values: dict[str, object]) -> str:
    return json.dumps(values, ensure_ascii=False, sort_keys=True, separators=(",", ":"))
