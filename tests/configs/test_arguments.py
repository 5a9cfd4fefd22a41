"""Commands of the tools: a list, help of each, and a near miss is named."""

from __future__ import annotations

import importlib
import io
import sys

import pytest

from configs.arguments import announce, dispatch
from proprio_mllm.__main__ import COMMANDS as PROPRIO
from proprio_mllm.report.commands import COMMANDS as REPORT
from sim.__main__ import COMMANDS as SIM


def test_there_are_few_tools_and_each_has_a_main() -> None:
    assert len(SIM) + len(PROPRIO) <= 14
    for module, meaning in [*SIM.values(), *PROPRIO.values(), *REPORT.values()]:
        assert callable(importlib.import_module(module).main)
        assert meaning


@pytest.mark.parametrize(("program", "commands"), [("python -m sim", SIM), ("python -m proprio_mllm", PROPRIO)])
def test_without_a_command_they_are_listed(program: str, commands: dict[str, tuple[str, str]], capsys) -> None:
    assert dispatch(program, commands, []) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"usage: {program} COMMAND")
    assert all(f"  {name} " in said for name in commands)


def test_an_unknown_command_names_the_nearest(capsys) -> None:
    assert dispatch("python -m sim", SIM, ["colect"]) == 2
    said = capsys.readouterr().err
    assert "'colect'" in said
    assert "did you mean 'collect'" in said


@pytest.mark.parametrize("command", sorted(REPORT))
def test_every_report_has_a_help(command: str, capsys) -> None:
    try:
        code = importlib.import_module("proprio_mllm.report.commands").main([command, "--help"])
    except SystemExit as end:
        code = end.code
    assert code == 0
    assert len(capsys.readouterr().out) > 50


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("arguments", "told"), [(["out=x"], "tool: starting\n"), (["--help"], "")])
def test_a_terminal_gets_a_word_at_once(arguments: list[str], told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = _Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    announce("tool", arguments)
    assert terminal.getvalue() == told


def test_a_file_gets_none(capsys: pytest.CaptureFixture[str]) -> None:
    announce("tool", [])
    assert capsys.readouterr().err == ""
