"""A ground station for tests: it asks, and hears what pymavlink makes of what comes."""

from __future__ import annotations

import threading
from typing import Any

from pymavlink.dialects.v20 import common

from bridge.links.link import Link
from protocol.errors import LinkClosedError
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter


def request(command: int, *parameters: float, target: int = 191) -> bytes:
    fields = {f"param{i + 1}": value for i, value in enumerate(parameters)}
    payload = mapping.COMMAND_LONG.pack_fields(command=command, target_system=1, target_component=target, **fields)
    return FrameWriter(255, 190).seal(mapping.COMMAND_LONG, payload)


class Watcher:
    """A ground station that asks one thing after another, once it has heard something, and hears what comes."""

    def __init__(self, link: Link, *asks: bytes, pause_s: float = 0.0) -> None:
        self._link, self._asks, self._pause_s = link, list(asks), pause_s
        self.heard: list[Any] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._listen)

    def __enter__(self) -> Watcher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _listen(self) -> None:
        parser = common.MAVLink(None)
        while not self._ended.is_set():
            if self._asks and self.heard and not self._ended.wait(self._pause_s):
                self._link.send(self._asks.pop(0))
            try:
                self.heard += parser.parse_buffer(self._link.recv(0.01) or b"") or []
            except LinkClosedError:
                return

    def has_heard(self, name: str) -> bool:
        """Whether a message of that name has come."""
        return any(one.get_type() == name for one in list(self.heard))

    def times(self, name: str) -> list[int]:
        return [one.time_usec for one in self.heard if one.get_type() == name]


def message(made: Any) -> bytes:
    """The frame of a pymavlink message of the station's."""
    packed: bytes = made.pack(common.MAVLink(None, 255, 190))
    return packed
