"""What a run's calls cost, and a cap that they hold to, over all threads and processes of the run.

Before a call the most that it can cost is booked; afterwards its cost takes the place of the booking. A call whose booking
would pass the cap is not made, so the sum of bookings is never less than what was spent, with one exception: attempts that the
OpenAI client repeats by itself after a time-out may be charged too, and a call is booked once.

What becomes of a booking:

- a reply: its cost, or the booking as it stands when the server did not count the tokens;
- a reply that was lost on the way: it stands, since it may have been charged;
- no reply because the server refused or was not reached: nothing;
- a process that was killed in a call: it stands, as for a lost reply. A resumed run goes on with what is left of the cap.

Paper: none (engineering).
"""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from proprio_mllm.backends.database import Database, Tables
from proprio_mllm.backends.prices import Price
from proprio_mllm.backends.protocol import Backend, BackendError, ChatReply, ChatRequest, CostCapError, LostReplyError

_TABLES: Final = Tables(
    purpose="a run's spending",
    application=0x50524D53,
    version=1,
    statements=(
        "CREATE TABLE calls (number INTEGER PRIMARY KEY, at TEXT NOT NULL, backend TEXT NOT NULL, purpose TEXT NOT NULL,"
        " bound_usd REAL NOT NULL, cost_usd REAL)",
    ),
)
_TOTAL: Final = "SELECT COALESCE(SUM(COALESCE(cost_usd, bound_usd)), 0.0) FROM calls"


class Spending:
    """The bookings of a run, in a file.

    Args:
        path: made when absent.
        cap_usd: most that the run may spend; None books without a limit.
        read_only: opens a file that exists, to look at.

    Raises:
        BackendSetupError: when the file is damaged, something else, or of another version.
        ValueError: on a negative cap.
    """

    def __init__(self, path: Path, cap_usd: float | None, read_only: bool = False) -> None:
        if cap_usd is not None and not cap_usd >= 0.0:
            raise ValueError(f"cost_cap_usd {cap_usd} must not be negative")
        self._cap_usd = cap_usd
        self._database = Database(path, _TABLES, read_only)

    def book(self, bound_usd: float, backend: str = "", purpose: str = "") -> int:
        """Books the most that a call can cost; the booking's number.

        Raises:
            CostCapError: when that might pass the cap; nothing is booked.
            BackendError: when the file cannot be written.
        """
        now = datetime.now(UTC).isoformat(timespec="seconds")
        with self._database.transaction() as connection:
            spent = self.total_usd()
            if self._cap_usd is not None and spent + bound_usd > self._cap_usd:
                raise CostCapError(
                    f"backend {backend}: a call of up to {bound_usd:.4f} USD might pass the cap:"
                    f" {spent:.4f} of {self._cap_usd:.4f} USD are spent or booked; a higher cost_cap_usd goes on from here"
                )
            cursor = connection.execute(
                "INSERT INTO calls (at, backend, purpose, bound_usd) VALUES (?, ?, ?, ?)", (now, backend, purpose, bound_usd)
            )
            assert cursor.lastrowid is not None
            return cursor.lastrowid

    def settle(self, number: int, cost_usd: float) -> None:
        """Puts what a call did cost in the place of its booking.

        Raises:
            ValueError: when there is no such booking, or it is settled.
            BackendError: when the file cannot be written.
        """
        with self._database.transaction() as connection:
            statement = "UPDATE calls SET cost_usd = ? WHERE number = ? AND cost_usd IS NULL"
            if connection.execute(statement, (cost_usd, number)).rowcount != 1:
                raise ValueError(f"there is no open booking {number}")

    def total_usd(self) -> float:
        """What is spent or booked."""
        return self._database.rows(_TOTAL)[0][0]

    def open_usd(self) -> float:
        """The part of it that is booked alone: calls under way, and those whose cost will never be known."""
        return self._database.rows(f"{_TOTAL} WHERE cost_usd IS NULL")[0][0]

    def close(self) -> None:
        """Closes the file."""
        self._database.close()


class SpendingBackend:
    """Prices replies and, with a `spending`, holds to its cap.

    Args:
        inner: what is asked; closed with this one.
        price: of its calls.
        spending: where they are booked; closed with this one. None only prices.
        name: of the backend, for the bookings.
    """

    def __init__(self, inner: Backend, price: Price, spending: Spending | None, name: str = "") -> None:
        self.identity = inner.identity
        self._inner = inner
        self._price = price
        self._spending = spending
        self._name = name

    def complete(self, request: ChatRequest) -> ChatReply:
        """The reply with its price; None as price when its tokens were not counted.

        Raises:
            CostCapError: when the call might pass the cap.
            BackendError: as of `inner`.
        """
        if self._spending is None:
            return self._priced(self._inner.complete(request))
        number = self._spending.book(self._price.bound_usd(request), self._name, request.purpose)
        try:
            reply = self._priced(self._inner.complete(request))
        except LostReplyError:
            raise
        except BackendError:
            self._spending.settle(number, 0.0)
            raise
        if reply.cost_usd is not None:
            self._spending.settle(number, reply.cost_usd)
        return reply

    def close(self) -> None:
        """Closes the bookings and the backend that is asked."""
        self._inner.close()
        if self._spending is not None:
            self._spending.close()

    def _priced(self, reply: ChatReply) -> ChatReply:
        # A request that a filter stops before the model is not charged.
        counted = reply.prompt_tokens + reply.completion_tokens > 0 or reply.finish_reason == "refusal"
        cost = self._price.cost_usd(reply.prompt_tokens, reply.completion_tokens) if counted else None
        return dataclasses.replace(reply, cost_usd=cost)
