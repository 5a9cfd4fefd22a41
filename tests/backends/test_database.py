"""A file that threads and processes share: damage, other versions, kills, and many writers."""

from __future__ import annotations

import os
import signal
import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from proprio_mllm.backends import database
from proprio_mllm.backends.database import Database, Tables
from proprio_mllm.backends.protocol import BackendError, BackendSetupError
from tests.backends.loopback import finished, started

TABLES = Tables("tested things", 77, 1, ("CREATE TABLE things (number INTEGER PRIMARY KEY, text TEXT)",))
HEAD = """
import sys
from pathlib import Path
from proprio_mllm.backends.database import Database, Tables
tables = Tables("tested things", 77, 1, ("CREATE TABLE things (number INTEGER PRIMARY KEY, text TEXT)",))
"""


def add(one: Database, text: str) -> None:
    with one.transaction() as connection:
        connection.execute("INSERT INTO things (text) VALUES (?)", (text,))


def add_and_fail(one: Database) -> None:
    with one.transaction() as connection:
        connection.execute("INSERT INTO things (text) VALUES ('a')")
        raise KeyError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "new folder" / "things?#.sqlite"


def test_what_is_written_is_there(path: Path) -> None:
    with_one = Database(path, TABLES)
    add(with_one, "a")
    assert Database(path, TABLES, read_only=True).rows("SELECT text FROM things") == [("a",)]
    with_one.close()
    again = Database(path, TABLES)
    add(again, "b")
    assert again.rows("SELECT number, text FROM things WHERE text = ?", "b") == [(2, "b")]
    again.close()
    with pytest.raises(BackendError, match=r"things.*closed"):
        again.rows("SELECT 1")


def test_an_error_undoes_a_transaction(path: Path) -> None:
    one = Database(path, TABLES)
    with pytest.raises(KeyError):
        add_and_fail(one)
    assert one.rows("SELECT * FROM things") == []


def test_a_reader_changes_nothing(path: Path) -> None:
    with pytest.raises(BackendSetupError, match=r"there is no .* with tested things"):
        Database(path, TABLES, read_only=True)
    assert not path.parent.exists()
    Database(path, TABLES).close()
    with pytest.raises(BackendSetupError, match="readonly"):
        add(Database(path, TABLES, read_only=True), "a")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_of_others(path: Path) -> None:
    Database(path, TABLES).close()
    path.parent.chmod(0o555)
    try:
        assert Database(path, TABLES, read_only=True).rows("SELECT * FROM things") == []
        with pytest.raises(BackendSetupError, match="cannot be used"):
            Database(path.with_name("other.sqlite"), TABLES)
    finally:
        path.parent.chmod(0o755)


def test_other_versions_and_other_files(path: Path) -> None:
    Database(path, TABLES).close()
    with pytest.raises(BackendSetupError, match="version 1 of tested things is unknown; known: 2"):
        Database(path, Tables("tested things", 77, 2, ()))
    with pytest.raises(BackendSetupError, match="is a database, but not one of other things"):
        Database(path, Tables("other things", 78, 1, ()))
    foreign = path.with_name("foreign.sqlite")
    with sqlite3.connect(foreign) as connection:
        connection.execute("CREATE TABLE theirs (a)")
    before = foreign.read_bytes()
    with pytest.raises(BackendSetupError, match="not one of tested things"):
        Database(foreign, TABLES)
    assert foreign.read_bytes() == before


@pytest.mark.parametrize("read_only", [False, True])
def test_damage_is_said(path: Path, read_only: bool) -> None:
    path.parent.mkdir()
    path.write_bytes(b"this is no database, however long it may be" * 100)
    with pytest.raises(BackendSetupError, match=r"is damaged or no database of tested things .*move it away"):
        Database(path, TABLES, read_only)


def test_damage_inside(path: Path) -> None:
    one = Database(path, TABLES)
    for number in range(200):
        add(one, str(number) * 100)
    one.close()
    content = bytearray(path.read_bytes())
    content[8192:] = b"\xff" * (len(content) - 8192)
    path.write_bytes(content)
    with pytest.raises(BackendSetupError, match="is damaged"):
        Database(path, TABLES).rows("SELECT text FROM things")


def test_a_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BackendSetupError, match="cannot be used"):
        Database(tmp_path / "file" / "things.sqlite", TABLES)


def test_somebody_keeps_it_locked(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_BUSY_S", 0.1)
    one, other = Database(path, TABLES), Database(path, TABLES)
    with one.transaction(), pytest.raises(BackendError, match=r"others kept it locked for 0\.1 s") as caught:
        add(other, "a")
    assert type(caught.value) is BackendError
    add(other, "a")


def test_many_threads_and_processes(path: Path) -> None:
    code = f"{HEAD}one = Database(Path(sys.argv[1]), tables)\n" + (
        "for number in range(30):\n"
        "    with one.transaction() as connection:\n"
        "        connection.execute('INSERT INTO things (text) VALUES (?)', (sys.argv[2],))\n"
    )
    processes = [started(code, path, name) for name in "ab"]
    one = Database(path, TABLES)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: add(one, "c"), range(30)))
    finished(*processes)
    assert one.rows("SELECT text, COUNT(*) FROM things GROUP BY text ORDER BY text") == [("a", 30), ("b", 30), ("c", 30)]


def test_opening_at_once(tmp_path: Path) -> None:
    code = f"{HEAD}sys.stdin.read(1)\n" + (
        "for number in range(60):\n    Database(Path(sys.argv[1]) / f'{number}.sqlite', tables).close()\n"
    )
    processes = [started(code, tmp_path) for _ in range(3)]
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("x")
        process.stdin.flush()
    finished(*processes)


def test_a_process_that_is_killed_while_it_writes(path: Path) -> None:
    code = f"{HEAD}one = Database(Path(sys.argv[1]), tables)\n" + (
        "for number in range(10**6):\n"
        "    with one.transaction() as connection:\n"
        "        connection.execute('INSERT INTO things (text) VALUES (?)', ('x' * 20000,))\n"
        "    print(number, flush=True)\n"
    )
    for _ in range(3):
        process = started(code, path)
        assert process.stdout is not None
        said = [process.stdout.readline() for _ in range(5)][-1]
        time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        said = (process.communicate()[0].splitlines() or [said])[-1]
        one = Database(path, TABLES)
        assert one.rows("PRAGMA integrity_check") == [("ok",)]
        count = one.rows("SELECT COUNT(*) FROM things WHERE LENGTH(text) = 20000")[0][0]
        assert count >= int(said)
        add(one, "after")
        one.close()
