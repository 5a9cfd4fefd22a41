"""Recorded replies in an SQLite file: what was asked, without the pictures' bytes, and what came back.

A reply is found by the SHA-256 of the canonical JSON of all that decides it: the backend's identity, the messages with pictures
as digests of their bytes, the schema, the longest reply, the temperature and, above temperature 0, the sample's number. That
JSON is kept beside the reply, so that a file is a transcript to be read. The first reply to a question stands.

Paper: none (engineering).
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from proprio_mllm.backends.database import Database, Tables
from proprio_mllm.backends.protocol import BackendSetupError, ChatMessage, ChatReply, ChatRequest

_TABLES: Final = Tables(
    purpose="recorded replies",
    application=0x50524D52,
    version=1,
    statements=(
        "CREATE TABLE replies (key TEXT PRIMARY KEY, purpose TEXT NOT NULL, recorded_at TEXT NOT NULL,"
        " question TEXT NOT NULL, reply TEXT NOT NULL)",
    ),
)


class RecordedReply(BaseModel):
    """A `ChatReply` that is kept; one that was cut off never is."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    text: str
    prompt_tokens: int = Field(ge=0)
    completion_tokens: int = Field(ge=0)
    latency_s: float = Field(ge=0.0, allow_inf_nan=False)
    finish_reason: Literal["stop", "refusal"]
    model: str
    cost_usd: float | None = Field(ge=0.0, allow_inf_nan=False)


class RecordedCall(BaseModel):
    """One question with its reply.

    Attributes:
        key: SHA-256 of the question's canonical JSON.
        purpose: what the call was for.
        recorded_at: UTC, ISO 8601.
        question: all that decides the reply.
        reply: what came back.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    key: str
    purpose: str
    recorded_at: str
    question: dict[str, Any]
    reply: RecordedReply

    @model_validator(mode="after")
    def _key_fits(self) -> RecordedCall:
        if self.key != _digest(_canonical(self.question)):
            raise ValueError(f"key {self.key!r} is not the SHA-256 of the question")
        return self


def question_of(identity: str, request: ChatRequest) -> tuple[str, str]:
    """Key and canonical JSON of all that decides a reply of the backend `identity`."""
    question: dict[str, Any] = {
        "identity": identity,
        "messages": [_recorded(message) for message in request.messages],
        "schema": None if request.schema is None else _schema(request.schema),
        "max_tokens": request.max_tokens,
        "temperature": float(request.temperature),
    }
    if request.temperature > 0.0:
        question["sample"] = request.sample
    text = _canonical(question)
    return _digest(text), text


class ReplyStore:
    """The file; any number of threads and processes may use it at once.

    Args:
        path: made when absent.
        read_only: opens a file that exists and changes nothing.

    Raises:
        BackendSetupError: when the file is damaged, something else, or of another version.
    """

    def __init__(self, path: Path, read_only: bool = False) -> None:
        self.path = path
        self._database = Database(path, _TABLES, read_only)

    def get(self, key: str) -> ChatReply | None:
        """The reply that is recorded under a key, marked as cached.

        Raises:
            BackendError: when the file cannot be read, or the reply is damaged.
        """
        rows = self._database.rows("SELECT reply FROM replies WHERE key = ?", key)
        if not rows:
            return None
        try:
            return ChatReply(**RecordedReply.model_validate_json(rows[0][0]).model_dump(), cached=True)
        except ValidationError as error:
            raise self._damaged(key, error) from error

    def put(self, key: str, question: str, purpose: str, reply: ChatReply) -> bool:
        """Records a reply that is not cut off; whether it is the first to its question.

        Raises:
            BackendError: when the file cannot be written.
        """
        recorded = RecordedReply.model_validate({name: getattr(reply, name) for name in RecordedReply.model_fields})
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return self._insert([(key, purpose, now, question, recorded.model_dump_json())]) == 1

    def calls(self) -> Iterator[RecordedCall]:
        """All calls in the order in which they were recorded.

        Raises:
            BackendSetupError: when one is damaged.
        """
        for (number,) in self._database.rows("SELECT rowid FROM replies ORDER BY rowid"):
            (row,) = self._database.rows("SELECT * FROM replies WHERE rowid = ?", number)
            try:
                values = dict(zip(RecordedCall.model_fields, (*row[:3], *map(json.loads, row[3:])), strict=True))
                yield RecordedCall.model_validate(values)
            except ValueError as error:
                raise self._damaged(row[0], error) from error

    def add(self, calls: Iterable[RecordedCall]) -> int:
        """Records calls of elsewhere, all or none; how many were new.

        Raises:
            BackendError: when the file cannot be written.
        """
        return self._insert(
            (call.key, call.purpose, call.recorded_at, _canonical(call.question), call.reply.model_dump_json())
            for call in calls
        )

    def identities(self) -> dict[str, int]:
        """The backends whose replies it holds, those of the newest replies first, and how many replies each has."""
        rows = self._database.rows(
            "SELECT json_extract(question, '$.identity') AS identity, COUNT(*) FROM replies"
            " GROUP BY identity ORDER BY MAX(rowid) DESC"
        )
        return {str(identity): count for identity, count in rows}

    def close(self) -> None:
        """Closes the file."""
        self._database.close()

    def _insert(self, rows: Iterable[tuple[str, str, str, str, str]]) -> int:
        with self._database.transaction() as connection:
            return connection.executemany("INSERT INTO replies VALUES (?, ?, ?, ?, ?) ON CONFLICT DO NOTHING", rows).rowcount

    def _damaged(self, key: str, error: ValueError) -> BackendSetupError:
        return BackendSetupError(f"{self.path}: the reply {key} is damaged: {' '.join(str(error).split())[:200]}")


def _recorded(message: ChatMessage) -> dict[str, Any]:
    content = [
        part if isinstance(part, str) else {"image": part.digest, "media_type": part.media_type} for part in message.content
    ]
    return {"role": message.role, "content": content}


@functools.cache
def _schema(model: type[BaseModel]) -> dict[str, Any]:
    return model.model_json_schema()


def _canonical(question: dict[str, Any]) -> str:
    return json.dumps(question, ensure_ascii=False, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
