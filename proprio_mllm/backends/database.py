"""SQLite files that threads and processes of one machine share: recorded replies, a run's spending.

Every write is a transaction that is on the disk before it returns, so a process that is killed at any moment leaves a file that
can be read. A file is marked with what it is for and with the version of its tables. Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import sqlite3
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from proprio_mllm.backends.protocol import BackendError, BackendSetupError

#: How long a call waits for the writes of others.
_BUSY_S: Final = 30.0


@dataclass(frozen=True, slots=True)
class Tables:
    """What a file holds.

    Attributes:
        purpose: in words, for messages.
        application: number that marks such files.
        version: of the statements; a file of another version is refused.
        statements: that make the tables.
    """

    purpose: str
    application: int
    version: int
    statements: tuple[str, ...]


class Database:
    """One connection to a file, used by one thread at a time.

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
        with self._explained(), contextlib.ExitStack() as stack:
            path.parent.mkdir(parents=True, exist_ok=True)
            # isolation_level=None: transactions begin where `transaction` says, not before the first write
            self._connection = sqlite3.connect(path, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
            stack.callback(self._connection.close)
            if read_only:
                self._connection.execute("PRAGMA query_only = ON")
                self._check()
            else:
                with self.transaction():
                    self._make_tables()
                    self._check()
            stack.pop_all()

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
        with self._lock, self._explained():
            self._connection.execute("BEGIN IMMEDIATE")
            with self._connection:  # commits, or rolls back on an error
                yield self._connection

    def close(self) -> None:
        """Closes the file."""
        with self._lock:
            self._connection.close()

    def _make_tables(self) -> None:
        if self.rows("SELECT COUNT(*) FROM sqlite_master") == [(0,)]:
            marks = (
                f"PRAGMA application_id = {self._tables.application}",
                f"PRAGMA user_version = {self._tables.version}",
            )
            for statement in (*self._tables.statements, *marks):
                self._connection.execute(statement)

    def _check(self) -> None:
        tables = self._tables
        if self.rows("PRAGMA application_id") != [(tables.application,)]:
            raise BackendSetupError(f"{self.path} is a database, but not one of {tables.purpose}")
        ((version,),) = self.rows("PRAGMA user_version")
        if version != tables.version:
            raise BackendSetupError(f"{self.path}: version {version} of {tables.purpose} is unknown; known: {tables.version}")

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
