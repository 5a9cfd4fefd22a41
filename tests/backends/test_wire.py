"""What a client may ask, and what it is told."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from typing import Any

import pytest
from openai.types import Model
from openai.types.chat import ChatCompletion

from proprio_mllm.backends.protocol import ChatImage, ChatMessage, ChatReply
from proprio_mllm.backends.server import RefusedError, completion, model_list, read_request

TURN = {"role": "user", "content": "look"}
SCHEMA = {"name": "step", "schema": {"type": "object", "properties": {"b": {}, "a": {}}}, "strict": True}


def body(**fields: Any) -> bytes:
    return json.dumps({"model": "tiny", "messages": [TURN]} | fields).encode()


def test_a_request_is_read_whole(view: Callable[..., ChatImage]) -> None:
    image = view(1, kind="jpeg")
    url = f"data:image/jpeg;base64,{base64.b64encode(image.data).decode()}"
    parts = [{"type": "image_url", "image_url": {"url": url, "detail": "high"}}, {"type": "text", "text": "left?"}]
    turns = [
        {"role": "developer", "content": "plan"},
        {"role": "user", "content": parts},
        {"role": "assistant", "content": "no"},
    ]
    request = read_request(body(messages=turns, max_completion_tokens=7, temperature=0.5, seed=3, n=1), "tiny", False)
    assert request.messages == (
        ChatMessage("system", ("plan",)),
        ChatMessage("user", (image, "left?")),
        ChatMessage("assistant", ("no",)),
    )
    assert (request.max_tokens, request.temperature, request.sample, request.schema) == (7, 0.5, 3, None)


def test_what_is_not_said_is_as_openai_has_it() -> None:
    request = read_request(body(response_format={"type": "text"}), "tiny", False)
    assert (request.max_tokens, request.temperature, request.sample, request.schema) == (2048, 1.0, 0, None)
    assert read_request(body(max_tokens=9), "tiny", False).max_tokens == 9


def test_a_schema_is_handed_on_as_it_came() -> None:
    asked = {"type": "json_schema", "json_schema": SCHEMA}
    schema = read_request(body(response_format=asked), "tiny", True).schema
    assert schema is not None
    assert schema.__name__ == "step"
    assert json.dumps(schema.model_json_schema()) == json.dumps(SCHEMA["schema"])
    with pytest.raises(RefusedError, match=r"cannot hold replies to a schema; allowed: text\. Start it with constrained=true"):
        read_request(body(response_format=asked), "tiny", False)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"messages": []}, "messages: List should have at least 1 item"),
        ({"messages": [{"role": "robot", "content": "x"}]}, r"messages\.0\.role: Input should be 'system'"),
        ({"messages": [{"role": "user", "content": []}]}, r"messages\.0\.content.*List should have at least 1 item"),
        ({"messages": [{"role": "user", "content": [{"type": "sound"}]}]}, r"messages\.0\.content.*'sound'"),
        ({"max_tokens": 0}, "max_tokens: Input should be greater than or equal to 1"),
        ({"temperature": 3}, "temperature: Input should be less than or equal to 2"),
        ({"n": 2}, "n: Input should be 1"),
        ({"stream": True}, "stream: Input should be False"),
        ({"tools": [], "stop": "x", "top_p": 1, "logprobs": True}, "tools: Extra inputs are not permitted.*and 1 more"),
        ({"response_format": {"type": "json_object"}}, r"response_format\.type: Input should be 'text' or 'json_schema'"),
        ({"response_format": {"type": "json_schema"}}, r"response_format\.json_schema: missing"),
    ],
)
def test_what_cannot_be_honoured_is_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(RefusedError, match=message) as caught:
        read_request(body(**fields), "tiny", True)
    assert caught.value.status == 400


def test_what_is_no_json_is_refused() -> None:
    with pytest.raises(RefusedError, match="body: Invalid JSON"):
        read_request(b"{", "tiny", False)


def test_another_model_is_not_found() -> None:
    with pytest.raises(RefusedError, match="model 'gpt' is not served; allowed: tiny") as caught:
        read_request(body(model="gpt"), "tiny", False)
    assert (caught.value.status, caught.value.code) == (404, "model_not_found")


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("/etc/hostname", r"messages\.0\.content\.0: expected data:image/png;base64,.* got '/etc/hostname'"),
        ("https://example.org/a.png", "got 'https://example.org/a.png'"),
        ("data:image/webp;base64,AAAA", "got 'data:image/webp"),
        ("data:image/png;base64,A*", "the picture is not base64"),
    ],
)
def test_pictures_come_with_the_request_alone(url: str, message: str) -> None:
    turn = {"role": "user", "content": [{"type": "image_url", "image_url": {"url": url}}]}
    with pytest.raises(RefusedError, match=message):
        read_request(body(messages=[turn]), "tiny", False)


def test_answers_are_what_openais_types_say() -> None:
    made = completion(ChatReply("Pick(left, Mug_1)", 12, 5, finish_reason="length", model="tiny@abc"), "tiny")
    read = ChatCompletion.model_validate(made, strict=True)
    assert read.choices[0].message.content == "Pick(left, Mug_1)"
    assert read.choices[0].finish_reason == "length"
    assert read.usage is not None
    assert (read.usage.prompt_tokens, read.usage.completion_tokens, read.usage.total_tokens) == (12, 5, 17)
    assert (read.model, read.system_fingerprint) == ("tiny", "tiny@abc")
    refused = ChatCompletion.model_validate(completion(ChatReply("I will not", finish_reason="refusal"), "tiny"), strict=True)
    assert (refused.choices[0].message.refusal, refused.choices[0].finish_reason) == ("I will not", "content_filter")
    assert Model.model_validate(model_list("tiny", 7)["data"][0], strict=True).id == "tiny"
