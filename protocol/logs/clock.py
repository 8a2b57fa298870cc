"""The time of each record of a log that an autopilot wrote of itself, whatever stamps single records carry."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled

LATEST_US = 1 << 52
"""No log is of a later time than this (the year 2112)."""

_BACK_US = 60_000_000
_AHEAD_US = 1_000_000
_LOOK_AHEAD = 8


@compiled
def turns_back(stamps: npt.NDArray[np.int64], at: int, earliest_us: int, last: int, step: int) -> bool:
    """Whether most of the few stamps behind the one at `at` do not go on from it, so that it stands alone.

    A stamp far ahead of `last`, the time so far, is one to go on from where later ones are not before it. One far behind
    it (the autopilot started anew), or the first of all, where later ones are near it. The last of all is judged by the
    widest `step` so far.
    """
    stamp = stamps[at]
    agree, seen = 0, 0
    for j in range(at + 1, min(stamps.shape[0], at + 1 + 4 * _LOOK_AHEAD)):
        other = stamps[j]
        if earliest_us <= other < LATEST_US:
            seen += 1
            if 0 <= last < stamp:
                agree += other >= stamp - _AHEAD_US
            else:
                agree += abs(other - stamp) <= _BACK_US
            if seen == _LOOK_AHEAD:
                break
    if seen == 0:
        return bool(last >= 0 and abs(stamp - last) > max(_BACK_US, 2 * step))
    return 2 * agree < seen


@compiled
def steady_times(stamps: npt.NDArray[np.int64], earliest_us: int) -> npt.NDArray[np.int64]:
    """The time of each record, in the order of the file, from the stamps (us) that they carry; -1 is none.

    A record without a stamp has the time of the one before it, and so has one whose stamp cannot be: before earliest_us
    (0: not known), after the year 2112, or a second ahead of the records before or a minute behind them while the next
    records turn back from it.
    """
    count = stamps.shape[0]
    times = np.full(count, -1, dtype=np.int64)
    last = earliest_us if earliest_us > 0 else -1
    step = 0
    for i in range(count):
        stamp = stamps[i]
        good = earliest_us <= stamp < LATEST_US
        if good and (last < 0 or stamp > last + _AHEAD_US or stamp < last - _BACK_US):
            good = not turns_back(stamps, i, earliest_us, last, step)
        if good:
            times[i] = stamp
            if stamp > last or stamp < last - _BACK_US:
                step = max(step, stamp - last if last >= 0 else 0)
                last = stamp
        elif last >= 0:
            times[i] = last
    if last < 0:  # no two stamps are near each other: the log is slow, or there is but one
        for i in range(count):
            if earliest_us <= stamps[i] < LATEST_US:
                last = max(last, stamps[i])
            times[i] = last
    first = 0
    while first < count and times[first] < 0:
        first += 1
    begin = times[first] if first < count else max(earliest_us, 0)
    for i in range(first):
        times[i] = begin
    return times
