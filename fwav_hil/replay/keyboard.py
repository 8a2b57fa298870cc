"""Keys pressed while a log plays: polled without waiting, and only where standard input is this process's terminal."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Mapping
from types import MappingProxyType, TracebackType

from bridge.recording.replay import Player

SEEK_S = 5.0
HELP = "space: pause, resume   n: one frame   left, right: 5 s back, ahead   up, down: 60 s   q: end"

KEYS: Mapping[bytes, Callable[[Player], None]] = MappingProxyType(
    {
        b" ": lambda player: player.hold(),
        b"n": lambda player: player.step(),
        b"q": lambda player: player.stop(),
        b"\x1b[C": lambda player: player.seek(SEEK_S),
        b"\x1b[D": lambda player: player.seek(-SEEK_S),
        b"\x1b[A": lambda player: player.seek(12 * SEEK_S),
        b"\x1b[B": lambda player: player.seek(-12 * SEEK_S),
    }
)


class Keyboard:
    """Controls a player by key presses. Ctrl-C keeps its usual effect.

    active   whether there is a terminal to read from, with this process in its foreground
    """

    def __init__(self) -> None:
        self.active = False
        self._file = -1
        self._rest = b""
        try:
            self._file = sys.stdin.fileno()
            self.active = os.isatty(self._file) and os.tcgetpgrp(self._file) == os.getpgrp()
        except (OSError, ValueError, AttributeError):  # closed, replaced, or none
            self.active = False

    def attend(self, player: Player) -> None:
        """Carry out the keys pressed since the last call."""
        if not self.active or not select.select([self._file], [], [], 0)[0]:
            return
        data = self._rest + os.read(self._file, 256)
        if not data:
            self.active = False  # the terminal has gone
            return
        self._rest = b""
        at = 0
        while at < len(data):
            size = 3 if data[at] == 0x1B and data[at + 1 : at + 2] in (b"", b"[", b"O") else 1
            key = data[at : at + size]
            if len(key) < size:
                self._rest = key  # the rest of an arrow key is still to come
                return
            key = key.replace(b"\x1bO", b"\x1b[")  # as terminals in application mode send them
            if key in KEYS:
                KEYS[key](player)
            at += size

    def __enter__(self) -> Keyboard:
        if self.active:
            self._before = termios.tcgetattr(self._file)
            tty.setcbreak(self._file)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.active:
            termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)
