"""The requests of a link's peer to one component: commands, and messages at a rate or once. Each is answered.

MAV_CMD_SET_MESSAGE_INTERVAL (511), parameters: message id, interval in us (-1: no longer, 0: as by default), and
MAV_CMD_REQUEST_MESSAGE (512), parameter: message id, are obeyed for the messages that are offered; other commands by their
own handlers. Times are those of whoever asks what is due: simulation time in both clock modes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from protocol.wire import mapping, requests
from protocol.wire.codec import Frame, Layout
from protocol.wire.requests import Request, Result
from protocol.wire.streams import Due

Handler = Callable[[Request], Result]
"""Obeys a request, or says why not."""
Saying = tuple[Layout, bytes]
"""A message and its payload, not yet sealed."""
NEVER = 1 << 62


class Requests:
    """What one link has asked of the component `who`.

    offered: message id -> default rate (Hz), or None where the message is sent on request only. commands: command ->
    handler.

    next_ns   until then nothing is due
    counters  requests          commands for this component         requests_refused  those that were not obeyed
    """

    def __init__(
        self, who: tuple[int, int], offered: Mapping[int, float | None], commands: Mapping[int, Handler] | None = None
    ) -> None:
        self._who = who
        self._offered = offered
        self._commands = {
            requests.SET_MESSAGE_INTERVAL: self._set_interval,
            requests.REQUEST_MESSAGE: self._ask_once,
            **(commands or {}),
        }
        self._streams = {number: Due(rate_hz) for number, rate_hz in offered.items() if rate_hz}
        self._once: list[int] = []
        self._replies: list[Saying] = []
        self.next_ns = 0
        self.counters = {"requests": 0, "requests_refused": 0}

    def take(self, frame: Frame) -> bool:
        """Obey or refuse a COMMAND_LONG; whether it was one for this component."""
        if frame.message_id != mapping.COMMAND_LONG.message_id:
            return False
        request = requests.decode_request(frame.payload)
        if not request.is_for(self._who):
            return False
        handler = self._commands.get(request.command)
        result = handler(request) if handler else Result.UNSUPPORTED
        self.counters["requests"] += 1
        self.counters["requests_refused"] += result is not Result.ACCEPTED
        payload = requests.encode_acknowledgement(request.command, result, (frame.system, frame.component))
        self.reply(mapping.COMMAND_ACK, payload)
        return True

    def reply(self, message: Layout, payload: bytes) -> None:
        """Have something said at the next occasion."""
        self._replies.append((message, payload))
        self.next_ns = 0

    def replies(self) -> list[Saying]:
        """The answers alone, once."""
        replies, self._replies = self._replies, []
        return replies

    def stream(self, number: int, rate_hz: float | None) -> None:
        """Have a message sent at a rate from now on; None: no longer."""
        self._streams.pop(number, None)
        if rate_hz:
            self._streams[number] = Due(rate_hz)
        self.next_ns = 0

    def ask_once(self, number: int) -> None:
        """Have a message sent at the next occasion."""
        if number not in self._once:
            self._once.append(number)
        self.next_ns = 0

    def due(self, t_ns: int, make: Callable[[int, int], Iterable[Saying]]) -> list[Saying]:
        """What is to be said at t_ns: answers, then `make`'s message, or several, for each id that is due and t_ns."""
        replies = self.replies()
        if t_ns < self.next_ns:
            return replies
        once, self._once = self._once, []
        numbers = [number for number, due in self._streams.items() if due.at(t_ns)]
        self.next_ns = min((due.next_ns for due in self._streams.values()), default=NEVER)
        for number in (*(number for number in once if number not in numbers), *numbers):
            replies += make(number, t_ns)
        return replies

    def _set_interval(self, request: Request) -> Result:
        number, interval_us = requests.wanted_message(request), requests.wanted_interval_us(request)
        if number not in self._offered or number is None or interval_us is None:
            return Result.DENIED
        default_hz = self._offered[number]
        self.stream(number, default_hz if interval_us == 0.0 else 1e6 / interval_us if interval_us > 0.0 else None)
        return Result.ACCEPTED

    def _ask_once(self, request: Request) -> Result:
        number = requests.wanted_message(request)
        if number not in self._offered or number is None:
            return Result.DENIED
        self.ask_once(number)
        return Result.ACCEPTED
