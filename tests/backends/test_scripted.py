"""A function of a file in a model's place, and what is said when it is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.protocol import Backend, BackendError, BackendSetupError, ChatReply
from proprio_mllm.backends.scripted import ScriptedChat
from tests.backends.loopback import ask

GOOD = """
from proprio_mllm.backends.protocol import BackendError, ChatReply

def text(request):
    return f"{request.purpose}: {request.messages[-1].text}"

def reply(request):
    return ChatReply("cut", 3, 1, finish_reason="length", model="mine")

def number(request):
    return 5

def failing(request):
    return {}["nothing"]

def overloaded(request):
    raise BackendError("come back later")
"""


def scripted(tmp_path: Path, name: str, text: str = GOOD) -> ScriptedChat:
    (tmp_path / "answers.py").write_text(text)
    return ScriptedChat(BackendConfig("scripted", "scripted", source=f"{tmp_path / 'answers.py'}:{name}", cache=None))


def test_texts_and_replies(tmp_path: Path) -> None:
    backend = scripted(tmp_path, "text")
    assert isinstance(backend, Backend)
    answer = backend.complete(ask("hello"))
    assert (answer.text, answer.model, answer.cost_usd) == ("plan: hello", "script", 0.0)
    assert answer.latency_s > 0.0
    backend.close()
    reply = scripted(tmp_path, "reply").complete(ask())
    assert reply == ChatReply("cut", 3, 1, reply.latency_s, "length", "mine")


def test_the_identity_is_the_code(tmp_path: Path) -> None:
    first = scripted(tmp_path, "text").identity
    assert scripted(tmp_path, "text").identity == first
    assert scripted(tmp_path, "reply").identity != first
    assert scripted(tmp_path, "text", GOOD + "\n# edited\n").identity != first


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        ("number", BackendSetupError, r"answers\.py:number returned int; allowed: str, ChatReply"),
        ("failing", BackendError, r"answers\.py:failing failed at answers\.py:\d+: KeyError: 'nothing'"),
        ("overloaded", BackendError, r"^come back later$"),
    ],
)
def test_functions_that_fail(tmp_path: Path, name: str, kind: type, message: str) -> None:
    with pytest.raises(BackendError, match=message) as caught:
        scripted(tmp_path, name).complete(ask())
    assert type(caught.value) is kind


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("absent", GOOD, r"answers\.py has no function 'absent'; it has: failing, number, overloaded, reply, text"),
        ("ChatReply", GOOD, r"has no function 'ChatReply'"),
        ("text", "import nothing_of_this_name", r"answers\.py cannot be run: ModuleNotFoundError"),
        ("a b", GOOD, r"backend\.source='.*a b' is not allowed; allowed: FILE\.py:FUNCTION"),
    ],
)
def test_files_without_a_function(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(BackendSetupError, match=f"backend scripted: .*{message}"):
        scripted(tmp_path, name, text)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(BackendSetupError, match=r"there is no file .*gone\.py"):
        ScriptedChat(BackendConfig("scripted", "scripted", source=f"{tmp_path / 'gone.py'}:text"))


def test_a_configuration_without_a_source() -> None:
    with pytest.raises(BackendSetupError, match=r"backend\.source is null; allowed: FILE\.py:FUNCTION"):
        ScriptedChat(BackendConfig("local", "scripted", model="m"))
