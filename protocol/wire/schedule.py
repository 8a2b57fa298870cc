"""What one component says on one link, and when: one scheduler over the table of streams.

A message is said at its rate, once when asked for, or as an answer. The order within one occasion is: answers, then the
messages in the order of the table, so that equal runs say equal bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TypeAlias

from protocol.due import NEVER, Due
from protocol.wire.codec import Layout, layout
from protocol.wire.streams import STREAMS

Saying: TypeAlias = tuple[Layout, bytes]
"""A message and its payload, not yet sealed."""
Encoder: TypeAlias = Callable[[int], Iterable[Saying]]
"""Makes what a stream says at a time (ns): one message, several, or none."""


class Schedule:
    """The streams of one component on one link.

    encoders   by message name: what makes each. A new message is a row of the table and an entry here.
    rates_hz   where they are other than the table's; None: said when asked for

    next_ns   until then nothing is due
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
        """Have something said at the next occasion, before all else."""
        self._answers += sayings
        self.next_ns = 0

    def ask_once(self, number: int) -> None:
        """Have a message said at the next occasion. Raises KeyError for an id that has no encoder."""
        self._once.add(self._known(number))
        self.next_ns = 0

    def set_rate(self, number: int, rate_hz: float | None) -> None:
        """Have a message said at a rate from now on; None: no longer. Raises KeyError for an id that has no encoder."""
        self._due.pop(self._known(number), None)
        if rate_hz:
            self._due[number] = Due(rate_hz)
        self.next_ns = 0

    def answers(self) -> list[Saying]:
        """The answers alone, for occasions at which nothing else is said."""
        answers, self._answers = self._answers, []
        return answers

    def due(self, t_ns: int) -> list[Saying]:
        """What is to be said at t_ns."""
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
            raise KeyError(f"no message {number} is said here")
        return number
