"""Every text the model reads or writes besides its episodes: grounding, questions about motion, judging.

Two styles with the same content: `full` sentences for models that read English, and `terse` for models that learn the format
from scratch, where every token costs time. In terse lists object ids follow one another without separators (`Mug_1Cup_2`): an
id starts with a letter and ends with a digit, so the list is unambiguous, and each id is two tokens.

The paper gives its prompts in part; the wording here is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from interface.observation import HistoryItem
from proprio_mllm.model.chat import Message
from proprio_mllm.model.vocabulary import motion_text

Style = Literal["terse", "full"]

_SYSTEM: dict[str, dict[Style, str]] = {
    "look": {"terse": "look", "full": "You answer questions about what the robot sees, relative to its own body."},
    "judge": {"terse": "judge", "full": "You tell what has come of a robot's work, from its camera view and its log."},
    "move": {"terse": "move", "full": "You read and write the robot's motion as motion tokens."},
}


def _system(task: str, style: Style) -> Message:
    if style not in ("terse", "full"):
        raise ValueError(f"prompt style {style!r} is not allowed; allowed: terse, full")
    return Message("system", _SYSTEM[task][style])


def _ids(ids: Sequence[str], style: Style) -> str:
    return "".join(ids) if style == "terse" else answers(ids)


def _body(motion: Sequence[int] | None, style: Style) -> str:
    if motion is None:
        return ""
    return motion_text(motion) if style == "terse" else f"Recent body motion: {motion_text(motion)}\n"


def last_steps(history: Sequence[HistoryItem], last: int, style: Style) -> str:
    """The newest steps of a log with their results, oldest first, a line each."""
    shown = list(history)[-last:] if last else []
    # The feedback repeats the actions with their results; the step alone stands in where there is none.
    lines = [item.feedback or item.step for item in shown]
    return "\n".join(lines) or ("" if style == "terse" else "nothing yet")


def with_answer(prompt: Sequence[Message], answer: str) -> tuple[Message, ...]:
    """The prompt with the assistant's supervised answer."""
    return (*prompt, Message("assistant", answer))


def looking(
    pairs: Sequence[tuple[str, str]], motion: Sequence[int] | None = None, style: Style = "terse"
) -> tuple[Message, ...]:
    """Question and answer pairs about one image as consecutive turns; the image stands before the first question.

    Args:
        pairs: (question, answer); an empty last answer leaves the conversation open for generation.
        motion: motion tokens before the first question.
        style: terse or full.

    Raises:
        ValueError: without pairs.
    """
    if not pairs:
        raise ValueError("at least one question is needed")
    messages = [_system("look", style)]
    for number, (question, answer) in enumerate(pairs):
        first = number == 0
        messages.append(Message("user", (_body(motion, style) if first else "") + question, images=int(first)))
        if answer or number + 1 < len(pairs):
            messages.append(Message("assistant", answer))
    return tuple(messages)


def described_motion(
    motion: Sequence[int] | None, caption: str, image: bool = False, style: Style = "terse"
) -> tuple[Message, ...]:
    """Motion to text, with or without the view at the motion's end; None leaves the motion out, which teaches the words."""
    ask = "say " if style == "terse" else "Describe this motion: "
    shown = "" if motion is None else motion_text(motion)
    return with_answer((_system("move", style), Message("user", f"{ask}{shown}", images=int(image))), caption)


def body_state_prompt(motion: Sequence[int] | str, hands: str, height: str, style: Style = "terse") -> tuple[Message, ...]:
    """Motion to the body's state at its end: which hands are open, and how high the pelvis is.

    Args:
        motion: motion tokens, or words that say the same.
        hands: `left right`, `left`, `right` or `none`.
        height: metres, such as `0.85`; empty leaves the conversation open for generation, as an empty `hands` does before it.
        style: terse or full.
    """
    terse = style == "terse"
    shown = f"{motion}\n" if isinstance(motion, str) else _body(motion, style)
    open_hands = f"{shown}open" if terse else f"{shown}Which of your hands are open?"
    messages = [_system("move", style), Message("user", open_hands)]
    if hands:
        question = "height" if terse else "How high is your pelvis, in metres?"
        messages += [Message("assistant", hands), Message("user", question)]
    return with_answer(messages, height) if height else tuple(messages)


def made_motion(caption: str, motion: Sequence[int], style: Style = "terse") -> tuple[Message, ...]:
    """Text to motion."""
    ask = "do " if style == "terse" else "Write the motion for: "
    return with_answer((_system("move", style), Message("user", f"{ask}{caption}")), motion_text(motion))


def filled_motion(masked: Sequence[int | None], motion: Sequence[int], style: Style = "terse") -> tuple[Message, ...]:
    """Masked motion: None in `masked` is hidden; the answer is the whole window."""
    ask = "fill " if style == "terse" else "Fill in the hidden tokens: "
    return with_answer((_system("move", style), Message("user", f"{ask}{motion_text(masked)}")), motion_text(motion))


def self_ask_prompt(
    relation: str,
    visible: Sequence[str],
    history: Sequence[HistoryItem],
    motion: Sequence[int] | None = None,
    style: Style = "terse",
    last: int = 8,
) -> tuple[Message, ...]:
    """Which objects are in a state? The reply lists ids as `answers` writes them, or `none`.

    Args:
        relation: what holds of the objects sought, for example `open`, `held`, `on Table_1`.
        visible: ids in view.
        history: earlier steps.
        motion: motion tokens or None.
        style: terse or full.
        last: number of earlier steps shown.
    """
    if style == "terse":
        text = f"{_body(motion, style)}see {_ids(visible, style)}\ndid\n{last_steps(history, last, style)}\nwhich {relation}?"
    else:
        text = (
            f"{_body(motion, style)}In view: {_ids(visible, style)}\nLog:\n{last_steps(history, last, style)}\n"
            f"Which objects are {relation}? List their ids, or say none."
        )
    return (_system("judge", style), Message("user", text, images=1))


def answers(ids: Sequence[str]) -> str:
    """A reply that lists object ids: joined by a comma and a space, `none` when empty."""
    return ", ".join(ids) or "none"
