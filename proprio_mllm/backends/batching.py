"""Calls of many threads answered together.

Whenever the answerer is free it takes what waits, oldest first, up to a limit, so nobody waits for a batch to fill. There is no
thread of its own: the thread whose call has waited longest answers the batch that its call is in, so an unexpected error is
raised where somebody sees it, and the other calls of that batch are then asked one by one.

The one batcher of this project: an in-process checkpoint gathers its requests in one, and a model's process the observations of
many episodes (`proprio_mllm.evaluation.asking`). Which calls meet in a batch depends on timing; a row's answer does not depend
on the rows beside it, up to the rounding of sums. Paper: none (engineering).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from proprio_mllm.backends.protocol import BackendError

Q = TypeVar("Q")
A = TypeVar("A")


class _Call(Generic[Q, A]):
    """A question and, later, its answer or the error that belongs to it."""

    __slots__ = ("alone", "answer", "question")

    def __init__(self, question: Q) -> None:
        self.question = question
        self.answer: A | Exception | None = None
        self.alone = False


class Batcher(Generic[Q, A]):
    """Hands the questions of many threads to one function, several at a time and never two batches at once.

    Args:
        answer: one answer, or the error in its place, for each question, in order.
        limit: most questions in one batch.

    Raises:
        ValueError: when the limit is not positive.
    """

    def __init__(self, answer: Callable[[Sequence[Q]], Sequence[A | Exception]], limit: int) -> None:
        if limit < 1:
            raise ValueError(f"limit {limit} must be positive")
        self._answer = answer
        self._limit = limit
        self._changed = threading.Condition()
        self._waiting: deque[_Call[Q, A]] = deque()
        self._busy = self._closed = False
        #: Questions answered, and batches they came in.
        self.questions = self.batches = 0

    def ask(self, question: Q) -> A:
        """The answer to a question; blocks until it is there.

        Raises:
            Exception: the one given in place of an answer; a BackendError when the batcher is closed.
        """
        call: _Call[Q, A] = _Call(question)
        with self._changed:
            self._waiting.append(call)
        try:
            while batch := self._turn(call):
                self._serve(batch)
        finally:
            with self._changed:
                if call in self._waiting:
                    self._waiting.remove(call)
                self._changed.notify_all()
        if isinstance(call.answer, Exception):
            raise call.answer
        assert call.answer is not None
        return call.answer

    def close(self) -> None:
        """Waits for the batch under way; who still waits then, or comes later, gets an error."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._busy)

    def _turn(self, call: _Call[Q, A]) -> list[_Call[Q, A]]:
        """The batch that this call's thread is to answer; empty when the call has its answer."""
        with self._changed:
            self._changed.wait_for(
                lambda: call.answer is not None or (not self._busy and (self._closed or self._waiting[0] is call))
            )
            if call.answer is not None:
                return []
            if self._closed:
                raise BackendError("the backend is closed")
            batch = [self._waiting.popleft()]
            while not call.alone and self._waiting and len(batch) < self._limit and not self._waiting[0].alone:
                batch.append(self._waiting.popleft())
            self._busy = True
            return batch

    def _serve(self, batch: list[_Call[Q, A]]) -> None:
        """Answers a batch; on an error nobody foresaw, which is raised, all but the first wait again, each alone."""
        answers: Sequence[A | Exception] = ()
        try:
            answers = self._answer([call.question for call in batch])
            if len(answers) != len(batch):
                raise ValueError(f"{len(answers)} answers to {len(batch)} questions")
        finally:
            with self._changed:
                if len(answers) == len(batch):
                    self.questions, self.batches = self.questions + len(batch), self.batches + 1
                    for call, answer in zip(batch, answers, strict=True):
                        call.answer = answer
                else:
                    for call in reversed(batch[1:]):
                        call.alone = True
                        self._waiting.appendleft(call)
                self._busy = False
                self._changed.notify_all()
