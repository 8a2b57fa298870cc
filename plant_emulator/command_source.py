"""Commands from the controller, compiled: HIL_ACTUATOR_CONTROLS, checked against the ticks that they may answer."""

from __future__ import annotations

import enum

import numpy as np

from protocol.compiled import Packed, compiled, entry_point, pack
from protocol.messages import FloatArray
from protocol.wire.codec import Frame, FrameReader, frame_of
from protocol.wire.framing import Bytes, Table, next_frame, take_payload
from protocol.wire.mapping import ARMED, COMMAND, read_command


class Found(enum.IntEnum):
    """Why reading stopped."""

    NOTHING = 0
    """all that was given has been read"""
    COMMAND = 1
    """a command that may act has arrived"""
    OTHERS = 2
    """other frames have to be handled before it reads on"""


CAUSES = ("refused_commands", "old_commands", "repeated", "unknown_echoes")
REFUSED, OLD, REPEATED, UNKNOWN_ECHO = range(len(CAUSES))
NOTHING, COMMANDED, OTHERS = (int(found) for found in Found)
_FOUND = tuple(Found)
_COMMAND_ID = COMMAND.message_id
_FRAMES_AT_ONCE = 64


@compiled
def receive(
    data: Bytes, at: int, reading: Packed, table: Table, rows: Packed, source: Packed, oldest_us: int, latest_us: int
) -> tuple[int, int, int, int, bool]:
    """Read frames from `at` on, up to the next command that may act.

    Returns why it stopped, where, how many frames it has read into `rows`, and of the newest command that may act the time
    of the tick that it answers (us) and whether it is armed.
    """
    s, r = source[0], reading[0]
    counters = s.counters
    count = 0
    while count < len(rows):
        end = next_frame(data, at, r, table, rows[count])
        if end < 0:
            return NOTHING, len(data), count, s.newest_us, s.armed != 0
        at = end
        row = rows[count]
        count += 1
        if row.message_id != _COMMAND_ID or row.system != s.system or row.component != s.component:
            continue
        take_payload(data, row, s.command_bytes)
        echo_us = np.int64(s.command.time_usec)
        if not read_command(s.command, s.scale, s.tau):
            counters[REFUSED] += 1
        elif echo_us < 0 or echo_us > latest_us or echo_us % s.period_us:
            counters[UNKNOWN_ECHO] += 1
        elif echo_us == s.newest_us:
            counters[REPEATED] += 1
        elif echo_us < max(oldest_us, s.newest_us):
            counters[OLD] += 1
        else:
            if s.newest_us < 0:  # the controller's sequence numbers restart with its first answer
                r.follow = 1
                r.next[:] = -1
                r.next[row.system << 8 | row.component] = (row.sequence + 1) & 0xFF
            s.newest_us = echo_us
            s.armed = s.command.mode & ARMED != 0
            s.newest[:] = s.tau
            return COMMANDED, at, count, int(echo_us), bool(s.armed != 0)
    return OTHERS, at, count, s.newest_us, s.armed != 0


class CommandSource:
    """Reads what the loop's link delivers; only commands of the controller at `sender` are accepted.

    newest      (6,) the newest command that may act, as received
    newest_ns   time of the tick that it answers; negative before the first     armed   whether it was sent armed
    is_read     whether all that was fed has been read
    others      frames that are no commands, since they were last collected: the caller handles them
    memory      what the kernels share: its fields newest (6,) and armed
    raws        every intact frame since they were last collected, as it was on the wire: for the log

    counters    refused_commands  commands rejected because a control is not a number
                old_commands      commands that answer a tick before the oldest that may still be answered
                repeated          commands received again: they remain in force, and do not count as fresh
                unknown_echoes    commands whose time is not that of a tick that was sent
    """

    def __init__(self, reader: FrameReader, sender: tuple[int, int], scale: FloatArray, period_ns: int) -> None:
        self.newest_ns, self.armed, self.is_read = -1, False, True
        self.others: list[Frame] = []
        self.raws: list[bytes] = []
        self._sender = sender
        self._reader = reader
        self._rows = np.zeros(_FRAMES_AT_ONCE, dtype=reader.rows.dtype)
        self.memory = pack(
            {
                "system": sender[0],
                "component": sender[1],
                "scale": scale,
                "tau": np.zeros(6),
                "newest": np.zeros(6),
                "armed": 0,
                "newest_us": -1,
                "period_us": period_ns // 1000,
                "counters": np.zeros(len(CAUSES), dtype=np.int64),
            },
            {"command": COMMAND.dtype},
        )
        self._arguments = (reader.reading, reader.table, self._rows, self.memory)
        self._receive = entry_point(receive, b"", 0, *self._arguments, 0, 0)
        self._oldest_us = self._latest_us = 0
        self._offsets = self._rows["offset"]
        self._data = b""
        self._at = 0
        self.newest: FloatArray = self.memory["newest"][0]

    def expect(self, oldest_ns: int, latest_ns: int) -> None:
        """From now on accept commands that answer the ticks from oldest_ns to latest_ns and are newer than the newest."""
        self._oldest_us, self._latest_us = oldest_ns // 1000, latest_ns // 1000

    def feed(self, data: bytes) -> None:
        """Accept the next bytes of the link."""
        self._data, self._at = self._reader.whole(data), 0

    def read(self) -> Found:
        """Continue reading, up to the next command that may act; see `receive`."""
        data, begun = self._data, self._at
        found, self._at, count, newest_us, self.armed = self._receive(
            data, begun, *self._arguments, self._oldest_us, self._latest_us
        )
        self.newest_ns = newest_us * 1000
        self.is_read = self._at == len(data)
        if count == 1 and found == COMMANDED and self.is_read and not self._offsets.item(0):
            self.raws.append(data)  # the usual case
            return Found.COMMAND
        if count:
            frames = [frame_of(data, row) for row in self._rows[:count].tolist()]
            self.raws += [frame.raw for frame in frames]
            self.others += [
                one for one in frames if one.message_id != _COMMAND_ID or (one.system, one.component) != self._sender
            ]
        if found == NOTHING:
            self._reader.keep_rest(data)
        return _FOUND[found]

    @property
    def strays(self) -> int:
        """How many commands were rejected in all."""
        return int(self.memory["counters"][0].sum())

    def counters(self) -> dict[str, int]:
        """The rejected commands, by cause."""
        return dict(zip(CAUSES, self.memory["counters"][0].tolist(), strict=True))
