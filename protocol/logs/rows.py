"""Compiled processing of the rows that the scanner found: repair stamps, count frames and copy them into tables."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled
from protocol.logs.records import SIMULATION_OR_DATE_US, State
from protocol.wire.framing import Bytes, Output, Table, byte

_DAY_US = 86_400_000_000
_MINUTE_US = 60_000_000
_LOOK_AHEAD = 8


@compiled
def mend_stamps(frames: npt.NDArray[np.void]) -> int:
    """Replace damaged stamps by the previous one (at the start: by the next one); returns how many.

    A stamp more than a minute from the previous one is damaged if one of the next few is not that far away; if all are, the
    clock was set or the recording paused, and it is kept. A stamp that is not a valid date is always damaged.
    """
    count = frames.shape[0]
    mended = 0
    last = -1
    for i in range(count):
        stamp = frames[i]["stamp_us"]
        good = 0 <= stamp < SIMULATION_OR_DATE_US
        if good and (last < 0 or abs(stamp - last) > _MINUTE_US):
            agree, return_to_last = 0, False
            seen = 0
            for j in range(i + 1, min(count, i + 1 + _LOOK_AHEAD)):
                other = frames[j]["stamp_us"]
                seen += 1
                agree += abs(other - stamp) <= _MINUTE_US
                return_to_last = return_to_last or (last >= 0 and abs(other - last) <= _MINUTE_US)
            if last < 0:
                good = agree * 2 >= seen
            elif return_to_last:
                good = False
            elif agree == 0:
                good = abs(stamp - last) < _DAY_US
        if good:
            last = stamp
        else:
            mended += 1
            frames[i]["stamp_ok"] = 0
            frames[i]["stamp_us"] = last
    following = -1
    for k in range(count):
        i = count - 1 - k
        if frames[i]["stamp_us"] < 0:
            frames[i]["stamp_us"] = max(following, 0)
        else:
            following = frames[i]["stamp_us"]
    return mended


@compiled
def count_rows(frames: npt.NDArray[np.void], chosen: npt.NDArray[np.uint8], slots: Table, counts: State) -> None:
    """Count the frames of each slot (`slots` gives slot + 1 of a message id, or 0) into `counts`.

    Unchosen and unknown frames, and those with flags of unknown meaning, are not counted; an empty `chosen` selects all.
    """
    for i in range(frames.shape[0]):
        frame = frames[i]
        if frame["known"] and not frame["flags"] & 0xFE and (chosen.shape[0] == 0 or chosen[i]):
            slot = slots[frame["message_id"]]
            if slot:
                counts[slot - 1] += 1


@compiled
def fill_rows(
    data: Bytes,
    frames: npt.NDArray[np.void],
    chosen: npt.NDArray[np.uint8],
    slots: Table,
    places: State,
    sizes: State,
    head: int,
    rows: Output,
) -> None:
    """Copy each frame that `count_rows` counts into the row at `places` of its slot, and advance that place.

    A row is a head of `head` bytes (stamp, system, component, sequence) and the payload, `sizes` bytes long; `rows` must
    be zero at first, since a payload may lack trailing zeros. Extra fields of a newer definition are not copied.
    """
    for i in range(frames.shape[0]):
        frame = frames[i]
        if not frame["known"] or frame["flags"] & 0xFE or (chosen.shape[0] > 0 and not chosen[i]):
            continue
        slot = int(slots[np.uint64(frame["message_id"])]) - 1
        if slot < 0:
            continue
        place, size = places[np.uint64(slot)], sizes[np.uint64(slot)]
        places[np.uint64(slot)] = place + head + size
        stamp = frame["stamp_us"]
        for k in range(8):
            rows[np.uint64(place + k)] = stamp >> (8 * k) & 0xFF
        rows[np.uint64(place + 8)] = frame["system"]
        rows[np.uint64(place + 9)] = frame["component"]
        rows[np.uint64(place + 10)] = frame["sequence"]
        at = frame["offset"]
        first = at + (10 if frame["version"] == 2 else 6)
        place += head
        for k in range(min(size, byte(data, at + 1))):
            rows[place + k] = data[first + k]
