"""Pose samples from the emulator: ATT_POS_MOCAP and the HIL_SENSOR that follows it, in compiled code.

A law gets fields of ATT_POS_MOCAP only; of HIL_SENSOR only the time is read: it marks the tick.
HIL_GPS, HIL_STATE_QUATERNION and ODOMETRY are ignored.
"""

from __future__ import annotations

import numpy as np

from controller.sources.source import Found, PoseSource
from protocol.compiled import Packed, compiled, entry_point, pack
from protocol.messages import FloatArray
from protocol.wire.codec import FrameReader, frame_of
from protocol.wire.framing import Bytes, Table, next_frame, take_payload
from protocol.wire.mapping import POSE, TICK, read_pose

CAUSES = ("unknown_sender", "bad_pose", "tick_without_pose", "backwards", "bad_time")
UNKNOWN_SENDER, BAD_POSE, TICK_WITHOUT_POSE, BACKWARDS, BAD_TIME = range(len(CAUSES))
LATEST_US = 1 << 53
"""Times from here on (285 years) are rejected: in nanoseconds they would overflow."""

NOTHING, SAMPLE, AGAIN, OTHERS = (int(found) for found in Found)
_POSE_ID, _TICK_ID = POSE.message_id, TICK.message_id
_OTHERS_AT_ONCE = 64


@compiled
def receive(data: Bytes, at: int, reading: Packed, table: Table, rows: Packed, source: Packed) -> tuple[int, int, int]:
    """Read frames from `at` on, up to the next sample: (why it stopped, where it stopped, frames of others in `rows`)."""
    s, r = source[0], reading[0]
    counters = s.counters
    others = 0
    while True:
        end = next_frame(data, at, r, table, rows[others])
        if end < 0:
            return NOTHING, len(data), others
        at = end
        row = rows[others]
        number = row.message_id
        if number not in (_POSE_ID, _TICK_ID):
            others += 1
            if others == len(rows):
                return OTHERS, at, others
            continue
        if row.system != s.system or row.component != s.component:
            counters[UNKNOWN_SENDER] += 1
            continue
        if number == _POSE_ID:
            take_payload(data, row, s.pose_bytes)
            s.pose_us = -1
            if read_pose(s.pose, s.pose_q):
                s.pose_us = np.int64(s.pose.time_usec)
            else:
                counters[BAD_POSE] += 1
            continue
        take_payload(data, row, s.tick_bytes)
        if s.tick.id != 0:
            continue  # another instance of the sensor
        t_us = np.int64(s.tick.time_usec)
        if not 0 <= t_us < LATEST_US:
            counters[BAD_TIME] += 1
        elif t_us < s.newest_us:
            counters[BACKWARDS] += 1
        elif t_us == s.newest_us:
            return AGAIN, at, others
        elif s.pose_us != t_us:
            counters[TICK_WITHOUT_POSE] += 1
        else:
            if s.newest_us < 0:  # the emulator's sequence numbers restart with its first tick
                r.follow = 1
                r.next[:] = -1
                r.next[row.system << 8 | row.component] = (row.sequence + 1) & 0xFF
            s.newest_us = t_us
            s.q[:] = s.pose_q
            return SAMPLE, at, others


class HilSource(PoseSource):
    """Joins the pose and the tick of one time into a sample; only frames of the emulator at `sender` are accepted.

    counters   unknown_sender     frames of these messages from a sender other than the emulator
               bad_pose           poses with NaN, or a quaternion not of unit length
               tick_without_pose  ticks whose pose was lost: no sample
               backwards          ticks older than the newest one
               bad_time           ticks whose time is out of all range
    """

    def __init__(self, reader: FrameReader, sender: tuple[int, int]) -> None:
        super().__init__()
        self._reader = reader
        self._rows = np.zeros(_OTHERS_AT_ONCE, dtype=reader.rows.dtype)
        self._memory = pack(
            {
                "system": sender[0],
                "component": sender[1],
                "pose_us": -1,
                "newest_us": -1,
                "q": np.zeros(6),
                "pose_q": np.zeros(6),
                "counters": np.zeros(len(CAUSES), dtype=np.int64),
            },
            {"pose": POSE.dtype, "tick": TICK.dtype},
        )
        self._newest_us = self._memory["newest_us"]
        self._arguments = (reader.reading, reader.table, self._rows, self._memory)
        self._receive = entry_point(receive, b"", 0, *self._arguments)
        self._data = b""
        self._at = 0
        self.q: FloatArray = self._memory["q"][0]

    def feed(self, data: bytes) -> None:
        """Take the next bytes of the link."""
        self._data, self._at = self._reader.whole(data), 0

    def read(self) -> Found:
        """Continue reading, up to the next sample; see `receive`."""
        data = self._data
        found, self._at, others = self._receive(data, self._at, *self._arguments)
        self.is_read = self._at == len(data)
        if others:
            self.others += [frame_of(data, row) for row in self._rows[:others].tolist()]
        if found == SAMPLE:
            self.t_ns = self._newest_us.item() * 1000
        elif found == NOTHING:
            self._reader.keep_rest(data)
        return _FOUND[found]

    def counters(self) -> dict[str, int]:
        """The rejected frames, by cause."""
        return dict(zip(CAUSES, self._memory["counters"][0].tolist(), strict=True))


_FOUND = tuple(Found)
