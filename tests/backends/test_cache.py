"""Recorded replies: what makes two requests the same, what is kept, who pays, and replaying without a model."""

from __future__ import annotations

import dataclasses
import json
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from pydantic import BaseModel

from proprio_mllm.backends.cache import CachedBackend, ReplayBackend
from proprio_mllm.backends.protocol import Backend, BackendError, BackendSetupError, ChatImage, ChatMessage, ChatReply
from proprio_mllm.backends.replies import ReplyStore, question_of
from tests.backends.loopback import IMAGE, Answering, ask, finished, started

WRITER = """
import sys
from pathlib import Path
from proprio_mllm.backends.cache import CachedBackend
from proprio_mllm.backends.protocol import ChatMessage, ChatReply, ChatRequest

class Inner:
    identity = "answering"
    asked = 0
    def complete(self, request):
        self.asked += 1
        return ChatReply(f"{sys.argv[2]} says " + "x" * 20000)
    def close(self): ...

inner = Inner()
cached = CachedBackend(inner, Path(sys.argv[1]))
"""


class Steps(BaseModel):
    steps: list[str]


class Other(BaseModel):
    steps: list[int]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "replies.sqlite"


def test_the_second_time_nobody_is_asked(path: Path) -> None:
    made = ChatReply("Wait()", 5, 2, 1.5, "stop", "model-1", 0.25)
    inner = Answering(reply=lambda request: made)
    cached = CachedBackend(inner, path)
    assert isinstance(cached, Backend)
    assert cached.complete(ask()) == made
    assert cached.complete(ask()) == dataclasses.replace(made, cached=True)
    cached.close()
    assert inner.closed
    assert CachedBackend(Answering(), path).complete(ask()) == dataclasses.replace(made, cached=True)
    assert len(inner.asked) == 1


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({}, True),
        ({"purpose": "reflection"}, True),
        ({"sample": 3}, True),  # at temperature 0 all samples are one
        ({"temperature": 0}, True),
        ({"temperature": 0.5}, False),
        ({"temperature": 0.5, "sample": 1}, False),
        ({"max_tokens": 2049}, False),
        ({"schema": Steps}, False),
        ({"text": "what then?"}, False),
    ],
)
def test_what_makes_requests_the_same(change: dict, same: bool) -> None:
    assert (question_of("a", ask())[0] == question_of("a", ask(**change))[0]) is same


def test_what_makes_requests_different() -> None:
    def key(identity: str = "a", **change: object) -> str:
        return question_of(identity, dataclasses.replace(ask(temperature=0.5, schema=Steps), **change))[0]

    other_image = (ChatMessage("user", ("what now?", ChatImage(IMAGE.data + b"."))),)
    other_order = (ChatMessage("user", (IMAGE, "what now?")),)
    one_text, two_texts = (ChatMessage("user", ("a", "b")),), (ChatMessage("user", ("a\n\nb",)),)
    keys = [key(), key("b"), key(sample=1), key(schema=Other), key(schema=None), key(temperature=0.6)]
    keys += [key(messages=messages) for messages in (other_image, other_order, one_text, two_texts)]
    assert len(set(keys)) == len(keys)
    assert key() == key()


def test_pictures_are_recorded_as_digests() -> None:
    question = json.loads(question_of("a", ask())[1])
    assert question["messages"][1]["content"] == ["what now?", {"image": IMAGE.digest, "media_type": "image/png"}]
    assert question["identity"] == "a"


def test_errors_and_cut_replies_are_not_recorded(path: Path) -> None:
    def fail(request: object) -> ChatReply:
        raise BackendError("backend tested: overloaded")

    inner = Answering(reply=fail)
    cached = CachedBackend(inner, path)
    for _ in range(2):
        with pytest.raises(BackendError, match="overloaded"):
            cached.complete(ask())
    inner.reply = lambda request: ChatReply("cu", finish_reason="length")
    assert [cached.complete(ask()).cached for _ in range(2)] == [False, False]
    inner.reply = lambda request: ChatReply("", finish_reason="refusal")
    assert [cached.complete(ask()).cached for _ in range(2)] == [False, True]
    assert len(inner.asked) == 5


def test_threads_that_ask_the_same_pay_once(path: Path) -> None:
    def slow(request: object) -> ChatReply:
        time.sleep(0.05)
        return ChatReply("slow")

    inner = Answering(reply=slow)
    cached = CachedBackend(inner, path)
    with ThreadPoolExecutor(12) as pool:
        replies = list(pool.map(lambda number: cached.complete(ask(f"question {number % 3}")), range(24)))
    assert {reply.text for reply in replies} == {"slow"}
    assert len(inner.asked) == 3
    assert sum(not reply.cached for reply in replies) == 3
    assert len(cached._asking) == 0


def test_threads_that_ask_different_things_do_not_wait_for_each_other(path: Path) -> None:
    both = threading.Barrier(2, timeout=5.0)

    def meet(request: object) -> ChatReply:
        both.wait()
        return ChatReply("met")

    cached = CachedBackend(Answering(reply=meet), path)
    with ThreadPoolExecutor(2) as pool:
        assert [reply.text for reply in pool.map(cached.complete, [ask("a"), ask("b")])] == ["met", "met"]


def test_of_two_processes_the_first_reply_stands(path: Path) -> None:
    one, other = Answering(), Answering()
    late = CachedBackend(one, path)

    def overtaken(request: object) -> ChatReply:
        CachedBackend(other, path).complete(ask())
        return ChatReply("late", 7, 1, 2.0, "stop", "m", 0.5)

    one.reply, other.reply = overtaken, lambda request: ChatReply("early", 1, 1, 1.0, "stop", "n", 0.1)
    assert late.complete(ask()) == ChatReply("early", 7, 1, 2.0, "stop", "n", 0.5)  # what was paid is what it cost
    assert late.complete(ask()).text == "early"


def test_processes_share_a_file(path: Path) -> None:
    code = WRITER + (
        "for number in range(20):\n"
        "    print(cached.complete(ChatRequest((ChatMessage('user', (f'question {number}',)),))).text.split()[0])\n"
    )
    written = finished(*(started(code, path, name) for name in ("one", "two", "three")))
    # whoever asked: all got the same replies
    assert len(set(written)) == 1
    assert len(written[0].split()) == 20


def test_a_process_that_is_killed_while_it_records(path: Path) -> None:
    code = WRITER + (
        "for number in range(10**6):\n"
        "    cached.complete(ChatRequest((ChatMessage('user', (f'question {number}',)),)))\n"
        "    print(number, flush=True)\n"
    )
    process = started(code, path, "killed")
    assert process.stdout is not None
    for _ in range(10):
        process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    store = ReplyStore(path)
    calls = list(store.calls())
    assert len(calls) >= 10
    assert all(call.reply.text == "killed says " + "x" * 20000 for call in calls)
    cached = CachedBackend(Answering(), path)
    assert cached.complete(dataclasses.replace(ask(), messages=(ChatMessage("user", ("question 3",)),))).cached


def test_a_reply_that_cannot_be_recorded_is_given_all_the_same(path: Path, caplog) -> None:
    inner = Answering()
    cached = CachedBackend(inner, path)

    def full(*_: object) -> bool:
        raise BackendSetupError("database or disk is full")

    cached._store.put = full  # type: ignore[method-assign]
    assert cached.complete(ask("a")).text == "reply to a"
    assert "a reply is not recorded: database or disk is full" in caplog.text


def test_replaying(path: Path) -> None:
    CachedBackend(Answering(), path).complete(ask("a"))
    replay = ReplayBackend("answering", path)
    assert isinstance(replay, Backend)
    assert replay.complete(ask("a")).text == "reply to a"
    assert replay.complete(ask("a")).cached
    message = (
        r"replies\.sqlite holds no reply to the 'reflection' request [0-9a-f]{12} that begins 'b b .*' \(of .*, it holds 1\)"
    )
    with pytest.raises(BackendError, match=message) as caught:
        replay.complete(ask("b\n" * 200, purpose="reflection"))
    assert len(str(caught.value)) < 400
    assert type(caught.value) is BackendError
    with pytest.raises(BackendSetupError, match="nor any of another; it holds replies of: answering"):
        ReplayBackend("another", path).complete(ask("a"))


def test_replaying_nothing(path: Path) -> None:
    with pytest.raises(BackendSetupError, match=r"there is no .*replies\.sqlite with recorded replies"):
        ReplayBackend("answering", path)
    assert not path.exists()


def test_a_damaged_file(path: Path) -> None:
    path.write_bytes(b"damaged" * 1000)
    with pytest.raises(BackendSetupError, match=r"replies\.sqlite is damaged or no database of recorded replies"):
        CachedBackend(Answering(), path)


def test_a_damaged_reply(path: Path) -> None:
    cached = CachedBackend(Answering(), path)
    cached.complete(ask())
    with cached._store._database.transaction() as connection:
        connection.execute("""UPDATE replies SET reply = '{"text": 5}'""")
    with pytest.raises(BackendSetupError, match=r"the reply [0-9a-f]{64} is damaged: .*text"):
        cached.complete(ask())
    with pytest.raises(BackendSetupError, match="is damaged"):
        list(cached._store.calls())
