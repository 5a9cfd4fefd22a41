"""A small SQLite file that threads and processes of one machine share: replies, money.

Writes are transactions that reach the disk before they return, so that a process that is killed at any moment leaves a file
that can be read. A file knows what it is for and the version of its tables. Write-ahead logging lets readers read while one
writes; it needs a local disk.

Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import sqlite3
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from proprio_mllm.backends.protocol import BackendError, BackendSetupError

__all__ = ["Database", "Tables"]

#: How long a write waits for those of others.
_BUSY_S: Final = 30.0
_POLL_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Tables:
    """What a file holds.

    Attributes:
        purpose: in words, for messages.
        application: number that marks such files.
        version: of the statements below; a file of another one is refused.
        statements: that make the tables.
    """

    purpose: str
    application: int
    version: int
    statements: tuple[str, ...]


class Database:
    """One connection, used by one thread at a time.

    Args:
        path: made with its folder when absent.
        tables: what it holds.
        read_only: opens a file that exists and changes nothing.

    Raises:
        BackendSetupError: when the file is damaged, something else, of another version, or cannot be opened.
    """

    def __init__(self, path: Path, tables: Tables, read_only: bool = False) -> None:
        self.path = path
        self._tables = tables
        self._lock = threading.RLock()
        if read_only and not path.is_file():
            raise BackendSetupError(f"there is no {path} with {tables.purpose}")
        with self._explained():
            self._connection = self._read() if read_only else self._written()

    def rows(self, statement: str, *values: Any) -> list[tuple[Any, ...]]:
        """Rows of a query.

        Raises:
            BackendError: when the file cannot be read.
        """
        with self._lock, self._explained():
            return self._connection.execute(statement, values).fetchall()

    @contextlib.contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """A block that no other writer comes between; an error in it undoes it.

        Raises:
            BackendError: when the file cannot be written.
        """
        with self._lock, self._explained(), _transaction(self._connection):
            yield self._connection

    def close(self) -> None:
        """Closes the file."""
        with self._lock:
            self._connection.close()

    def _written(self) -> sqlite3.Connection:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        connection = _connection(str(self.path.absolute()))
        try:
            with _transaction(connection):
                if not connection.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0]:
                    for statement in self._tables.statements:
                        connection.execute(statement)
                    connection.execute(f"PRAGMA application_id = {self._tables.application}")
                    connection.execute(f"PRAGMA user_version = {self._tables.version}")
                self._check(connection)
            _log_ahead(connection)
        except BaseException:
            connection.close()
            raise
        return connection

    def _read(self) -> sqlite3.Connection:
        address = f"file:{quote(str(self.path.absolute()))}?mode=ro"
        try:
            return self._checked(_connection(address))
        except sqlite3.OperationalError:
            # A log beside the file cannot be made in a folder of others: a file without one is read as it stands.
            if self.path.with_name(f"{self.path.name}-wal").exists():
                raise
            return self._checked(_connection(f"{address}&immutable=1"))

    def _checked(self, connection: sqlite3.Connection) -> sqlite3.Connection:
        try:
            self._check(connection)
        except BaseException:
            connection.close()
            raise
        return connection

    def _check(self, connection: sqlite3.Connection) -> None:
        application = connection.execute("PRAGMA application_id").fetchone()[0]
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if application != self._tables.application:
            raise BackendSetupError(f"{self.path} is a database, but not one of {self._tables.purpose}")
        if version != self._tables.version:
            known = self._tables.version
            raise BackendSetupError(f"{self.path}: version {version} of {self._tables.purpose} is unknown; known: {known}")

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Turns SQLite's errors into those of backends."""
        try:
            yield
        except sqlite3.OperationalError as error:
            if "locked" in str(error) or "busy" in str(error):
                raise BackendError(f"{self.path}: others kept it locked for {_BUSY_S:g} s") from error
            raise BackendSetupError(f"{self.path} cannot be used: {error}") from error
        except sqlite3.ProgrammingError as error:
            raise BackendError(f"{self.path}: {error}") from error
        except sqlite3.DatabaseError as error:
            raise BackendSetupError(
                f"{self.path} is damaged or no database of {self._tables.purpose} ({error}); move it away to start a new one"
            ) from error
        except OSError as error:
            raise BackendSetupError(f"{self.path} cannot be used: {error}") from error


def _connection(address: str) -> sqlite3.Connection:
    uri = address.startswith("file:")
    return sqlite3.connect(address, timeout=_BUSY_S, isolation_level=None, check_same_thread=False, uri=uri)


def _log_ahead(connection: sqlite3.Connection) -> None:
    """Switches the log on; SQLite does not wait by itself for others that do the same."""
    deadline = time.monotonic() + _BUSY_S
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            break
        except sqlite3.OperationalError:
            if time.monotonic() > deadline:
                raise
            time.sleep(_POLL_S)
    connection.execute("PRAGMA synchronous = FULL")


@contextlib.contextmanager
def _transaction(connection: sqlite3.Connection) -> Iterator[None]:
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        if connection.in_transaction:  # a full disk ends it by itself
            connection.execute("ROLLBACK")
        raise
    connection.execute("COMMIT")
