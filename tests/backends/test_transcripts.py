"""Recorded replies on the command line: listed, shown, written as lines and taken in again."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel

from proprio_mllm.backends.cache import CachedBackend, ReplayBackend, main
from proprio_mllm.backends.protocol import ChatReply
from proprio_mllm.backends.replies import question_of
from tests.backends.loopback import IMAGE, ROOT, Answering, ask, finished, started


class Steps(BaseModel):
    steps: list[str]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "replies.sqlite"
    cached = CachedBackend(Answering(reply=lambda request: ChatReply("Grüße\nWait()", 7, 3, 0.1 + 0.2, model="m")), path)
    cached.complete(ask("first"))
    cached.complete(ask("second", purpose="reflection", schema=Steps, temperature=0.7, sample=2))
    cached.close()
    return path


def test_listing(path: Path, capsys) -> None:
    assert main([str(path)]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith(question_of("answering", ask("first"))[0][:12])
    assert "plan" in first and "7+3" in first and first.endswith("Grüße Wait()")
    assert "reflection" in second


def test_showing(path: Path, capsys) -> None:
    key = question_of("answering", ask("first"))[0]
    assert main([str(path), f"show={key[:9]}"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(key)
    assert f"--- user\nfirst\n[image/png {IMAGE.digest}]" in text
    assert text.endswith("Grüße\nWait()\n")
    assert main([str(path), "show=zzz"]) == 2
    assert "0 keys of" in capsys.readouterr().err
    assert main([str(path), "show="]) == 2


def test_lines_out_and_in(path: Path, tmp_path: Path, capsys) -> None:
    lines, copy = tmp_path / "lines.jsonl", tmp_path / "copy.sqlite"
    assert main([str(path), f"export={lines}"]) == 0
    assert main([str(copy), f"import={lines}"]) == 0
    assert "2 of 2 calls" in capsys.readouterr().out
    assert main([str(copy), f"import={lines}"]) == 0
    assert "0 of 2 calls" in capsys.readouterr().out
    replay = ReplayBackend("answering", copy)
    assert replay.complete(ask("first")) == ReplayBackend("answering", path).complete(ask("first"))
    assert replay.complete(ask("second", schema=Steps, temperature=0.7, sample=2)).latency_s == 0.1 + 0.2
    assert IMAGE.data not in lines.read_bytes()
    again = tmp_path / "again.jsonl"
    assert main([str(copy), f"export={again}"]) == 0
    assert again.read_bytes() == lines.read_bytes()
    assert len(list(tmp_path.glob(".*"))) == 0


def change(line: str, **values: object) -> str:
    raw = json.loads(line)
    for name, value in values.items():
        *parents, last = name.split("__")
        node = raw
        for parent in parents:
            node = node[parent]
        node[last] = value
    return json.dumps(raw)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (lambda line: line[:-9], "line 2: "),
        (lambda line: "[1]", "line 2: expected an object, got list"),
        (lambda line: change(line, version=9), "line 2: version 9 is unknown; known: 1"),
        (lambda line: change(line, key="0" * 64), "line 2: .*is not the SHA-256 of the question"),
        (lambda line: change(line, question__max_tokens=5), "line 2: .*is not the SHA-256 of the question"),
        (lambda line: change(line, question__messages=[]), "line 2: .*is not the SHA-256 of the question"),
        (lambda line: change(line, question__colour="red"), "line 2: .*is not the SHA-256 of the question"),
        (lambda line: change(line, reply__finish_reason="length"), "line 2: .*finish_reason"),
        (lambda line: change(line, reply__prompt_tokens=-1), "line 2: .*prompt_tokens"),
        (lambda line: change(line, reply__cost_usd=float("nan")), "line 2: .*cost_usd"),
        (lambda line: change(line, extra=1), "line 2: .*extra"),
    ],
)
def test_bad_lines_are_named_and_nothing_is_taken(path: Path, tmp_path: Path, capsys, bad, message: str) -> None:
    lines, copy = tmp_path / "lines.jsonl", tmp_path / "copy.sqlite"
    main([str(path), f"export={lines}"])
    first, second = lines.read_text().splitlines()
    lines.write_text(f"{first}\n{bad(second)}\n")
    capsys.readouterr()
    assert main([str(copy), f"import={lines}"]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert re.search(message, error), error
    assert main([str(copy)]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("arguments", [[], ["{path}", "colour=red"], ["{path}", "more"], ["{path}", "show=a", "show=b"]])
def test_wrong_arguments(path: Path, capsys, arguments: list[str]) -> None:
    assert main([argument.format(path=path) for argument in arguments]) == 2
    assert "expected FILE [show=KEY]" in capsys.readouterr().err


def test_files_that_are_not_there(tmp_path: Path, capsys) -> None:
    assert main([str(tmp_path / "none.sqlite")]) == 2
    assert "there is no" in capsys.readouterr().err
    assert main([str(tmp_path / "new.sqlite"), f"import={tmp_path / 'none.jsonl'}"]) == 2
    assert "none.jsonl" in capsys.readouterr().err


def test_an_export_does_not_replace_the_recorded_replies(path: Path, tmp_path: Path, capsys) -> None:
    recorded = path.read_bytes()
    for target in (path, tmp_path):
        assert main([str(path), f"export={target}"]) == 2
        assert "it is not replaced" in capsys.readouterr().err
    assert path.read_bytes() == recorded


@pytest.mark.parametrize("arguments", [["--help"], ["FILE"]])
def test_a_reader_that_has_seen_enough_is_no_error(path: Path, arguments: list[str]) -> None:
    given = [str(path) if argument == "FILE" else argument for argument in arguments]
    reading, writing = os.pipe()
    os.close(reading)
    try:
        command = [sys.executable, "-m", "proprio_mllm.backends.cache", *given]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": ""}
        done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, timeout=60, env=environment)
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


def test_as_a_program(path: Path) -> None:
    code = "import runpy, sys\nsys.argv[1:1] = ['report', 'replies']\nrunpy.run_module('proprio_mllm', run_name='__main__')"
    (written,) = finished(started(code, path))
    assert len(written.splitlines()) == 2
