"""`--help` names every group, value and field, with its meaning from the schema."""

from __future__ import annotations

import dataclasses
import re

import pytest

import eval as evaluation
import train
from configs.arguments import read_arguments
from configs.compose import compose, groups
from configs.help import help_text
from configs.schema.eval import EvalConfig
from configs.schema.train import TrainConfig
from proprio_mllm.backends.serve import ServeConfig
from proprio_mllm.report.export import main as export_main


@dataclasses.dataclass(frozen=True)
class _Inner:
    """Inner.

    Attributes:
        steps: how many,
            over two lines.
        a, b: share one meaning.
    """

    steps: int = 1
    a: int = 1
    b: int = 1


def test_every_group_and_field_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    for main, root, chosen in (
        (evaluation.main, "eval", ("planner", "robot")),
        (train.main, "train", ("model", "data", "budget")),
    ):
        assert main(["--help"]) == 0
        text = capsys.readouterr().out
        for name in chosen:
            assert all(value in text for value in (name, *groups()[name]))

        def leaves(values: dict, prefix: str = "") -> list[str]:
            found = []
            for key, value in values.items():
                found += leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else [prefix + key]
            return found

        assert all(f"  {name}=" in text for name in leaves(compose(root)))
        assert max(map(len, text.splitlines())) < 140
        if root == "eval":  # groups that are not chosen show their fields too
            assert "  backend.token_limit_field=max_tokens" in text and "  experiment.planners=…" in text
            told = " ".join(text.split())
            assert "folder of the stored model (kind mllm)" in told and "(kind file, plain)" in told
            assert "name printed in tables. planner" in told  # which every kind has


def test_meanings_come_from_the_docstrings() -> None:
    text = help_text("eval", EvalConfig, "About.")
    assert text.startswith("About.\n")
    line = text[text.index("  trials=1 ") :].splitlines()[:2]
    assert " ".join(" ".join(line).split()) == (
        "trials=1 episodes per task; the contingencies and the random streams differ between trials."
    )
    assert "[easy, medium, hard, natural]" in text.replace("\n" + " " * 44, " ")
    assert "learning rate" in help_text("train", TrainConfig, "")


def test_lines_that_go_on_and_fields_that_share_one() -> None:
    from configs.help import _meanings

    assert _meanings(_Inner) == {"steps": "how many, over two lines.", "a": "share one meaning.", "b": "share one meaning."}


def test_reports_have_a_help_without_a_run(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        export_main(["--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert said.startswith("Runs for other tools: `python -m proprio_mllm report export RUN [RUN ...] format=sft|jsonl")
    assert re.search(r"^  format=… ", said, re.M)


def test_tools_without_groups_have_a_help_too(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        read_arguments(ServeConfig, ["port=1", "--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert said.startswith("Serves a checkpoint as an OpenAI-compatible model")
    assert re.search(r"^  port=8377 +on 127\.0\.0\.1; 0 takes a free one\.$", said, re.M)
