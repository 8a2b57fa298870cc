"""The messages of one component on one link, and when they are sent: one scheduler over the table of streams.

A message is sent at its rate, once on request, or as an answer. The order of messages due together is: answers, then the
others in the order of the table, so that equal runs send equal bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TypeAlias

from protocol.due import NEVER, Due
from protocol.wire.codec import Layout, layout
from protocol.wire.streams import STREAMS

Saying: TypeAlias = tuple[Layout, bytes]
"""A message and its payload, not yet sealed as a frame."""
Encoder: TypeAlias = Callable[[int], Iterable[Saying]]
"""Makes the messages of a stream at a time (ns): one, several, or none."""


class Schedule:
    """The streams of one component on one link.

    encoders   encoder by message name. A new message needs a row of the table and an entry here.
    rates_hz   rates that differ from the table's; None: sent on request only

    next_ns   when the next message is due
    """

    def __init__(self, encoders: Mapping[str, Encoder], rates_hz: Mapping[str, float | None] | None = None) -> None:
        rows = {row.message: row for row in STREAMS}
        in_order = sorted(encoders, key=list(rows).index)
        self._encoders = {layout(name).message_id: encoders[name] for name in in_order}
        rates = {name: rows[name].rate_hz for name in in_order} | dict(rates_hz or {})
        self.default_hz = {layout(name).message_id: rates[name] for name in in_order}
        self._due = {number: Due(rate_hz) for number, rate_hz in self.default_hz.items() if rate_hz}
        self._once: set[int] = set()
        self._answers: list[Saying] = []
        self.next_ns = 0

    def answer(self, *sayings: Saying) -> None:
        """Send these messages with the next ones, before all others."""
        self._answers += sayings
        self.next_ns = 0

    def ask_once(self, number: int) -> None:
        """Send a message once, with the next ones. Raises KeyError for an id without encoder."""
        self._once.add(self._known(number))
        self.next_ns = 0

    def set_rate(self, number: int, rate_hz: float | None) -> None:
        """Send a message at a rate from now on; None: stop. Raises KeyError for an id without encoder."""
        self._due.pop(self._known(number), None)
        if rate_hz:
            self._due[number] = Due(rate_hz)
        self.next_ns = 0

    def answers(self) -> list[Saying]:
        """The pending answers only."""
        answers, self._answers = self._answers, []
        return answers

    def due(self, t_ns: int) -> list[Saying]:
        """The messages to send at t_ns."""
        if t_ns < self.next_ns:
            return []
        sayings = self.answers()
        once, self._once = self._once, set()
        for number, encode in self._encoders.items():
            due = self._due.get(number)
            if (due is not None and due.at(t_ns)) or number in once:
                sayings += encode(t_ns)
        if not (self._answers or self._once):
            self.next_ns = min((due.next_ns for due in self._due.values()), default=NEVER)
        return sayings

    def _known(self, number: int) -> int:
        if number not in self._encoders:
            raise KeyError(f"message {number} has no encoder here")
        return number
