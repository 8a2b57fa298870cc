"""The time of each record of an ArduPilot log, by the rules of pymavlink's DFReader.

Since Copter 3.3 the first field is TimeUS, before that TimeMS: since the autopilot's start. GPS records then had the GPS time
of week in TimeMS, and their own time since the start in T. Older logs have GPS times only, PX4's of that kind a TIME record.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.logs.clock import LATEST_US, steady_times

_GPS_EPOCH_S = 315_964_800
_LEAP_S = 18
_WEEK_S = 604_800
_GPS = ("GPS", "GPS2")
_FOREIGN_CLOCKS = ("ACC", "GYR")
"""The TimeMS of records whose names begin so is not of the autopilot's clock."""


class Timed(NamedTuple):
    """Records of one kind: name, first field, numbers in the order of the file, and the way to a field as whole numbers.

    That gives None for a field that is not there or holds no whole numbers.
    """

    name: str
    first: str
    numbers: npt.NDArray[np.int64]
    field: Callable[[str], npt.NDArray[Any] | None]

    def whole(self, name: str) -> npt.NDArray[np.int64]:
        """The field of each record; -1 where it is none that a time or a week can be."""
        values = self.field(name)
        if values is None:
            return np.full(len(self.numbers), -1, dtype=np.int64)
        return np.where((values >= 0) & (values < LATEST_US), values, -1).astype(np.int64)


def record_times(count: int, kinds: Sequence[Timed]) -> npt.NDArray[np.int64]:
    """The time (us) of each of `count` records, in the order of the file."""
    stamps = np.full(count, -1, dtype=np.int64)
    timed = False
    for kind in kinds:
        if kind.first == "TimeUS":
            stamps[kind.numbers] = kind.whole("TimeUS")
        elif kind.first == "TimeMS" and not kind.name.startswith(_FOREIGN_CLOCKS):
            stamps[kind.numbers] = 1000 * kind.whole("TimeMS")
        elif kind.name in _GPS and kind.field("T") is not None:
            stamps[kind.numbers] = 1000 * kind.whole("T")
        else:
            continue
        timed = True
    if not timed:
        stamps = _without_own_times(count, kinds)
    times = steady_times(stamps, 0)
    times += _base_us(kinds) if timed else 0
    return np.clip(times, 0, LATEST_US, out=times)


def _base_us(kinds: Sequence[Timed]) -> int:
    """The Unix time (us) of the autopilot's start, by the first GPS record that has a time; 0 where none has."""
    bases: list[tuple[int, int]] = []
    for kind in kinds:
        if kind.name == "GPS" and kind.field("TimeUS") is not None and kind.field("GWk") is not None:
            own, unix = kind.whole("TimeUS"), _unix_us(kind, "GWk", "GMS")
        elif kind.name in _GPS and kind.field("T") is not None:
            own, unix = 1000 * kind.whole("T"), _unix_us(kind, "Week", "TimeMS")
            own = np.where(own > 0, own, -1)
        else:
            continue
        good = np.flatnonzero((own >= 0) & (unix >= 0))[:1]
        bases += [(int(kind.numbers[row]), int(unix[row] - own[row])) for row in good]
    return min(bases)[1] if bases else 0


def _unix_us(kind: Timed, week: str, ms: str) -> npt.NDArray[np.int64]:
    """The Unix time of the GPS week and time of week of each record; -1 where it has none."""
    weeks, of_week = kind.whole(week), kind.whole(ms)
    unix = 1_000_000 * (_GPS_EPOCH_S - _LEAP_S + _WEEK_S * weeks) + 1000 * of_week
    return np.where((weeks > 0) & (weeks < 1 << 16) & (of_week >= 0) & (of_week <= 1000 * _WEEK_S), unix, -1)


def _without_own_times(count: int, kinds: Sequence[Timed]) -> npt.NDArray[np.int64]:
    """Stamps of a log whose records have no time of their own: those of PX4's TIME records, or of its GPS records."""
    stamps = np.full(count, -1, dtype=np.int64)
    for kind in kinds:
        if kind.name == "TIME" and kind.field("StartTime") is not None:
            stamps[kind.numbers] = kind.whole("StartTime")
            return stamps
    for kind in kinds:
        for week, ms in (("Week", "TimeMS"), ("GWk", "GMS"), ("Wk", "TWk")):
            if kind.name in _GPS and kind.field(week) is not None:
                stamps[kind.numbers] = _unix_us(kind, week, ms)
                break
    return stamps
