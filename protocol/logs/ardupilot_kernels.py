"""Finding the records of an ArduPilot dataflash log in its bytes, in compiled code, damaged or not.

A record is 0xA3 0x95, its type and a body whose length the type's format (FMT) says. There is no checksum: a record is
believed by what follows it. Behind damage the next place is sought where two records follow each other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled

Bytes = npt.NDArray[np.uint8]
Lengths = npt.NDArray[np.int32]

POSITION, ROWS, DAMAGED, RESYNCHRONISATIONS, TAIL = range(5)
STATE_SIZE = 5

DONE, DEFINITION, ROOM = range(3)
"""What `walk` ended for: the end of the data; a format was taken; the output is full."""

HEADER = 3
ALTERNATIVES = 4
FMT = 128
_FIRST, _SECOND = 0xA3, 0x95


@compiled
def is_head(data: Bytes, at: int) -> bool:
    """Whether the two bytes that each record begins with are at `at`, as far as the data goes."""
    count = data.shape[0]
    return bool(at >= count or (data[at] == _FIRST and (at + 1 >= count or data[at + 1] == _SECOND)))


@compiled
def alternative(data: Bytes, at: int, lengths: Lengths) -> int:
    """Which of the formats that the type of the record at `at` ever had fits it: the latest behind which a record follows.

    0, the latest of all, where none does; -1 where no record of a known type begins.
    """
    if at + HEADER > data.shape[0] or data[at] != _FIRST or data[at + 1] != _SECOND:
        return -1
    own = lengths[data[at + 2]]
    if own[0] < HEADER:
        return -1
    for k in range(ALTERNATIVES):
        if own[k] >= HEADER and at + own[k] <= data.shape[0] and is_head(data, at + own[k]):
            return k
    return 0


@compiled
def end_of(data: Bytes, at: int, lengths: Lengths) -> int:
    """Where the record at `at` ends, be it behind the end of the data; -1 where none of a known type begins."""
    k = alternative(data, at, lengths)
    return int(at + lengths[data[at + 2], k]) if k >= 0 else -1


@compiled
def chain_begins(data: Bytes, at: int, lengths: Lengths) -> bool:
    """Whether a record of a known type begins at `at` behind which another begins, or the data ends."""
    end = end_of(data, at, lengths)
    return end >= 0 and is_head(data, end)


@compiled
def walk(
    data: Bytes,
    lengths: Lengths,
    current: Lengths,
    state: npt.NDArray[np.int64],
    places: npt.NDArray[np.int64],
    layouts: Lengths,
) -> int:
    """Go on from POSITION to the end of the data, behind the next format, or until the output is full.

    `current` is the layout that a type stands for, `lengths` how long its records are, 0 where it has none: the latest
    first, then those it had before, shape (256, ALTERNATIVES). Of each record, where its body begins goes to `places`,
    and its layout to `layouts`.
    """
    count = data.shape[0]
    while state[POSITION] < count:
        if state[ROWS] == places.shape[0]:
            return ROOM
        at = state[POSITION]
        end = end_of(data, at, lengths)
        if end > count or (end >= 0 and not is_head(data, end)):
            # Bytes may be missing from this record: then another begins within it.
            limit = min(end, count)
            inside = at + 1
            while inside < limit and not (data[inside] == _FIRST and chain_begins(data, inside, lengths)):
                inside += 1
            if inside < limit:
                state[DAMAGED] += inside - at
                state[RESYNCHRONISATIONS] += 1
                state[POSITION] = inside
                continue
        if end > count or (end < 0 and at + HEADER > count and is_head(data, at)):
            state[TAIL] += count - at
            state[POSITION] = count
            return DONE
        if end < 0:
            begin = at
            at += 1
            while at < count and not (data[at] == _FIRST and chain_begins(data, at, lengths)):
                at += 1
            state[DAMAGED] += at - begin
            state[RESYNCHRONISATIONS] += at < count
            state[POSITION] = at
            continue
        kind = np.int64(data[at + 2])
        places[state[ROWS]] = at + HEADER
        layouts[state[ROWS]] = current[kind, alternative(data, at, lengths)]
        state[ROWS] += 1
        state[POSITION] = end
        if kind == FMT:
            return DEFINITION
    return DONE


@compiled
def count_hidden(data: Bytes, places: npt.NDArray[np.int64], size: int) -> tuple[int, int]:
    """How many of the texts of `size` bytes at these places are not empty; how many have bytes behind the first zero."""
    told, hidden = 0, 0
    for i in range(places.shape[0]):
        ended, empty, more = False, True, False
        for k in range(size):
            if data[places[i] + k]:
                empty = False
                more = more or ended
            else:
                ended = True
        told += not empty
        hidden += more
    return told, hidden
