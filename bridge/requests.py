"""Requests of a link's peer to one component: commands, and messages at a rate or once. Each is acknowledged.

MAV_CMD_SET_MESSAGE_INTERVAL (511), parameters: message id, interval in us (-1: stop, 0: default), and
MAV_CMD_REQUEST_MESSAGE (512), parameter: message id, are accepted for the messages that are offered; other commands have
their own handlers. Intervals count in simulation time in both clock modes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from protocol.wire import mapping, requests
from protocol.wire.codec import Frame, layout
from protocol.wire.requests import Request, Result
from protocol.wire.schedule import Schedule

Handler = Callable[[Request], Result]
"""Carries out a request, or refuses it with a reason."""


class Requests:
    """The requests of one link to the component `who`.

    schedule: the messages of that component on the link, which 511 and 512 change and which sends the answers. offered:
    names of its messages that may be requested. commands: command -> handler.

    counters  requests          commands for this component         requests_refused  those that were refused
    """

    def __init__(
        self,
        who: tuple[int, int],
        schedule: Schedule,
        offered: Iterable[str],
        commands: Mapping[int, Handler] | None = None,
    ) -> None:
        self._who = who
        self._schedule = schedule
        self._offered = {layout(name).message_id for name in offered}
        self._commands = {
            requests.SET_MESSAGE_INTERVAL: self._set_interval,
            requests.REQUEST_MESSAGE: self._ask_once,
            **(commands or {}),
        }
        self.counters = {"requests": 0, "requests_refused": 0}

    def handle(self, frame: Frame) -> bool:
        """Carry out or refuse a COMMAND_LONG; whether it was one for this component."""
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
        self._schedule.answer((mapping.COMMAND_ACK, payload))
        return True

    def _set_interval(self, request: Request) -> Result:
        number, interval_us = requests.wanted_message(request), requests.wanted_interval_us(request)
        if number is None or number not in self._offered or interval_us is None:
            return Result.DENIED
        if interval_us == 0.0:
            self._schedule.set_rate(number, self._schedule.default_hz[number])
        else:
            self._schedule.set_rate(number, 1e6 / interval_us if interval_us > 0.0 else None)
        return Result.ACCEPTED

    def _ask_once(self, request: Request) -> Result:
        number = requests.wanted_message(request)
        if number is None or number not in self._offered:
            return Result.DENIED
        self._schedule.ask_once(number)
        return Result.ACCEPTED
