"""What counts as a reply, and what each wrong one is called."""

from __future__ import annotations

import time

import pytest

from proprio_mllm.backends.protocol import ChatReply
from proprio_mllm.planners.chat.replies import Plan, ReplyError, read_json, read_reply, read_steps


@pytest.mark.parametrize(
    "text",
    [
        '{"steps": ["Done()"]}',
        '```json\n{"reasoning": "x", "steps": ["Done()"], "more": 1}\n```',
        'Sure! {not json} Here: {"steps": ["Done()"]} I hope that helps {"steps": []}',
    ],
)
def test_the_first_whole_object_counts(text: str) -> None:
    assert read_reply(ChatReply(text), Plan).steps == ["Done()"]


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        (ChatReply("I cannot", finish_reason="refusal"), "refused: 'I cannot'"),
        (ChatReply('{"steps": ["Done()"', 5, 2048, finish_reason="length"), "truncated after 2048 tokens"),
        (ChatReply('{"steps": ["Done()"]}', 5, 2048, finish_reason="length"), "truncated"),
        (ChatReply("  \n"), "empty reply"),
        (ChatReply("Pick(left, Mug_1)"), "no JSON object in 'Pick"),
        (ChatReply('["Done()"]'), "no JSON object"),
        (ChatReply('{"plan": []}'), "steps: Field required"),
        (ChatReply('{"steps": "Done()"}'), "steps: Input should be a valid list"),
        (ChatReply('{"steps": [1]}'), "steps.0: "),
    ],
)
def test_each_wrong_reply_has_its_name(reply: ChatReply, message: str) -> None:
    with pytest.raises(ReplyError, match=message.replace("(", r"\(").replace("[", r"\[")):
        read_reply(reply, Plan)


def test_deep_nesting_is_an_error_and_not_a_crash() -> None:
    with pytest.raises(ReplyError, match="no JSON object"):
        read_json('{"a":' * 3000 + "1")


def test_a_number_too_long_to_read_is_a_wrong_reply() -> None:
    with pytest.raises(ReplyError, match="no JSON object"):
        read_json('{"steps": ["Done()"], "n": ' + "9" * 5000 + "}")


def test_half_a_character_is_a_question_mark() -> None:
    half = r'{"steps": ["walk \ud83d"], "reasoning": "whole \ud83d\ude00"}'
    plan = read_reply(ChatReply(half), Plan)
    assert (plan.steps, plan.reasoning) == (["walk ?"], "whole \U0001f600")


def test_a_reply_of_braces_alone_is_soon_given_up() -> None:
    before = time.process_time()
    with pytest.raises(ReplyError, match="no JSON object"):
        read_json("{" * 200_000)
    assert time.process_time() - before < 2.0


def test_steps_are_read_up_to_the_limit() -> None:
    assert [step.to_text() for step in read_steps(["MoveAhead(1)", "Done()", "nonsense"], 2)] == ["MoveAhead(1)", "Done()"]
    with pytest.raises(ReplyError, match="not an action: 'walk'"):
        read_steps(["walk"], 1)
    with pytest.raises(ReplyError, match="no steps"):
        read_steps([], 1)
