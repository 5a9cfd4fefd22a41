"""Replies held to a schema, where xgrammar is installed (extra `constrained`); the message where it is not."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest
from pydantic import BaseModel, Field

from proprio_mllm.backends.local import encode
from proprio_mllm.backends.protocol import BackendSetupError, ChatReply, ChatRequest, RequestError

INSTALLED = importlib.util.find_spec("xgrammar") is not None
needs_xgrammar = pytest.mark.skipif(not INSTALLED, reason="xgrammar is not installed; pip install 'proprio-mllm[constrained]'")


class Step(BaseModel):
    """Fields in an order that is not the alphabet's."""

    verb: Literal["Pick", "Place"]
    arms: list[Literal["left", "right"]] = Field(min_length=1, max_length=2)
    done: bool


class Odd(BaseModel):
    """A schema that no grammar can be made of."""

    @classmethod
    def model_json_schema(cls, *args: Any, **kwargs: Any) -> dict[str, Any]:
        return {"type": "nothing"}


@pytest.mark.skipif(INSTALLED, reason="xgrammar is installed")
def test_a_missing_extra_is_named(folder: Path, open_chat: Callable[..., Any]) -> None:
    with pytest.raises(BackendSetupError, match=r"pip install 'proprio-mllm\[constrained\]'"):
        open_chat(folder, constrained=True)


@needs_xgrammar
def test_replies_keep_to_the_schema(folder: Path, open_chat: Callable[..., Any], ask: Callable[..., ChatRequest]) -> None:
    chat, free = open_chat(folder, constrained=True), open_chat(folder)
    assert chat.identity == free.identity.replace('"constrained":false', '"constrained":true')
    steps: set[Step] = set()
    for sample in range(4):
        request = ask("pick the mug", schema=Step, temperature=1.5, sample=sample, max_tokens=200)
        reply = chat.complete(request)
        assert reply.finish_reason == "stop"
        step = Step.model_validate_json(reply.text)
        assert list(step.model_dump()) == ["verb", "arms", "done"]
        assert reply.text == step.model_dump_json().replace(",", ", ").replace(":", ": ")
        steps.add(reply.text)
    assert len(steps) > 1
    plain = ask("pick the mug")
    assert chat.complete(plain).text == free.complete(plain).text, "no schema, no grammar"


@needs_xgrammar
def test_rows_of_a_batch_keep_to_their_own_schemas(
    folder: Path, open_chat: Callable[..., Any], ask: Callable[..., ChatRequest], view: Callable[..., Any]
) -> None:
    class Seen(BaseModel):
        many: bool

    chat = open_chat(folder, constrained=True)
    requests = [
        ask("pick", schema=Step, max_tokens=99),
        ask(view(1), "many?", schema=Seen, max_tokens=99),
        ask("pick the mug now", max_tokens=5),
        ask("pick", schema=Step, max_tokens=4),
    ]
    expected = [chat.complete(request).text for request in requests]
    loaded = chat._open()
    replies: list[ChatReply] = chat._answer([encode(loaded.processor, request, 4096) for request in requests])
    assert [reply.text for reply in replies] == expected
    assert [reply.finish_reason for reply in replies] == ["stop", "stop", "length", "length"]
    Seen.model_validate_json(expected[1])


@needs_xgrammar
def test_a_schema_without_a_grammar_is_its_requests_error(
    folder: Path, open_chat: Callable[..., Any], ask: Callable[..., ChatRequest]
) -> None:
    chat = open_chat(folder, constrained=True)
    with pytest.raises(RequestError, match="no grammar can be made of the schema 'Odd'"):
        chat.complete(ask("pick", schema=Odd))
    assert chat.complete(ask("pick")).completion_tokens == 10
