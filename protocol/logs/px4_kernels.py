"""Finding the messages of a PX4 log in its bytes, in compiled code, damaged or not.

A message is its size (2 bytes, little endian), its type (1 byte) and its body. There is no checksum: a message is believed
by its type, a size that fits it, and by what follows. Behind damage the next place is sought where two messages follow
each other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled

Bytes = npt.NDArray[np.uint8]
Sizes = npt.NDArray[np.int32]

POSITION, ROWS, OTHERS, DAMAGED, RESYNCHRONISATIONS, TAIL = range(6)
STATE_SIZE = 6

DONE, DEFINITION, ROOM = range(3)
"""What `walk` ended for: the end of the data; a definition lies at POSITION; an output is full."""

_HEAD = 3
_NO_FIT, _CUT = -1, -2
_DATA, _FORMAT, _SUBSCRIBE, _UNSUBSCRIBE = ord("D"), ord("F"), ord("A"), ord("R")
_KNOWN = np.frombuffer(b"OSBLCMQIP", dtype=np.uint8)
"""The types, beside those named above, whose bodies `body_fits` knows."""
_SYNC = np.frombuffer(b"\x2f\x73\x13\x20\x25\x0c\xbb\x12", dtype=np.uint8)
_LOOKED_AT = 64
_FOREIGN_IN_A_ROW = 8


@compiled
def uint16(data: Bytes, at: int) -> int:
    """The unsigned number of 2 bytes at `at`."""
    return int(np.int64(data[at]) | np.int64(data[at + 1]) << 8)


@compiled
def is_text(data: Bytes, start: int, stop: int) -> bool:
    """Whether the first bytes of data[start:stop] are printable ASCII, as names and formats are."""
    strange = 0
    for i in range(start, min(stop, start + _LOOKED_AT, data.shape[0])):
        strange += data[i] < 0x20 or data[i] > 0x7E
    return strange == 0


@compiled
def body_fits(data: Bytes, at: int, kind: int, size: int, least: Sizes, most: Sizes) -> bool:
    """Whether a message of that type may have that size and the first bytes of body at `at`, as far as they are there."""
    there = data.shape[0] - at
    if kind == _DATA:
        if size < 2 or there < 2:
            return size >= 2
        number = uint16(data, at)
        return bool(least[number] >= 0 and least[number] <= size - 2 <= most[number])
    if kind == _FORMAT:
        return size >= 3 and is_text(data, at, at + size)
    if kind == _SUBSCRIBE:
        return size >= 4 and is_text(data, at + 3, at + size)
    if kind == _UNSUBSCRIBE or kind == ord("O"):
        return size == 2
    if kind == ord("S"):
        strange = size != 8
        for i in range(min(8, there)):
            strange = strange or data[at + i] != _SYNC[i]
        return not strange
    if kind == ord("B"):
        return size >= 40 and size < 256
    if kind == ord("L"):
        return size >= 9 and (there < 1 or (data[at] >= 0x30 and data[at] <= 0x37))
    if kind == ord("C"):
        return size >= 11 and (there < 1 or (data[at] >= 0x30 and data[at] <= 0x37))
    skipped = 0
    if kind == ord("M") or kind == ord("Q"):
        skipped = 1
    elif kind != ord("I") and kind != ord("P"):
        return False
    if size < 2 + skipped or there <= skipped:
        return size >= 2 + skipped
    length = int(data[at + skipped])
    first = at + skipped + 1
    return length > 0 and first + length <= at + size and is_text(data, first, first + length)


@compiled
def end_of(data: Bytes, at: int, least: Sizes, most: Sizes) -> int:
    """Where the message at `at` ends; -1 where none can be, -2 where the end of the data may cut one short."""
    count = data.shape[0]
    if at + _HEAD > count:
        return _CUT
    size, kind = uint16(data, at), int(data[at + 2])
    if not body_fits(data, at + _HEAD, kind, size, least, most):
        return _NO_FIT
    end = at + _HEAD + size
    return end if end <= count else _CUT


@compiled
def chain_begins(data: Bytes, at: int, least: Sizes, most: Sizes) -> bool:
    """Whether a message begins at `at` behind which another begins, or the data ends."""
    end = end_of(data, at, least, most)
    return end >= 0 and (end == data.shape[0] or end_of(data, end, least, most) >= 0)


@compiled
def is_known(data: Bytes, at: int, kind: int, least: Sizes) -> bool:
    """Whether messages of that type, of a topic with the number at `at` if they are data, are known: one must then fit."""
    if kind == _DATA:
        return bool(at + 2 <= data.shape[0] and least[uint16(data, at)] >= 0)
    known = kind in (_FORMAT, _SUBSCRIBE, _UNSUBSCRIBE)
    for letter in _KNOWN:
        known = known or kind == letter
    return known


@compiled
def foreign_end(data: Bytes, at: int, least: Sizes, most: Sizes) -> int:
    """Where a message ends that is of an unknown type, or of an unknown topic; -1 where what follows does not bear it out.

    It does where a few such messages lead to a known one, or many of them follow each other.
    """
    count = data.shape[0]
    place = at
    for _ in range(_FOREIGN_IN_A_ROW):
        if place + _HEAD > count:
            return _NO_FIT
        size, kind = uint16(data, place), int(data[place + 2])
        letter = (kind >= ord("A") and kind <= ord("Z")) or (kind >= ord("a") and kind <= ord("z"))
        if not letter or size == 0 or place + _HEAD + size > count:
            return _NO_FIT
        if is_known(data, place + _HEAD, kind, least) and not body_fits(data, place + _HEAD, kind, size, least, most):
            return _NO_FIT  # its size is damaged: who believed it would lose the messages behind it
        place += _HEAD + size
        if place == count or chain_begins(data, place, least, most):
            break
    return at + _HEAD + uint16(data, at)


@compiled
def walk(
    data: Bytes,
    least: Sizes,
    most: Sizes,
    current: Sizes,
    state: npt.NDArray[np.int64],
    row_places: npt.NDArray[np.int64],
    row_subscriptions: Sizes,
    other_places: npt.NDArray[np.int64],
) -> int:
    """Go on from POSITION to the end, the next definition (format, subscription, its end), or until an output is full.

    Places are those of bodies of data messages, behind the topic's number, and of whole messages of other types.
    `current` is the subscription that a topic's number now stands for; `least` and `most` its sizes, -1 where there is none.
    """
    count = data.shape[0]
    while state[POSITION] < count:
        if state[ROWS] == row_places.shape[0] or state[OTHERS] == other_places.shape[0]:
            return ROOM
        at = int(state[POSITION])
        end = end_of(data, at, least, most)
        foreign = False
        if end == _NO_FIT:
            end = foreign_end(data, at, least, most)
            foreign = end >= 0
        elif end == _CUT or (end < count and end_of(data, end, least, most) == _NO_FIT):
            # Bytes may be missing from this message: then another begins within it.
            limit = count if end == _CUT else end
            if end == _CUT or foreign_end(data, end, least, most) == _NO_FIT:
                inside = at + 1
                while inside < limit and not chain_begins(data, inside, least, most):
                    inside += 1
                if inside < limit:
                    state[DAMAGED] += inside - at
                    state[RESYNCHRONISATIONS] += 1
                    state[POSITION] = inside
                    continue
            if end == _CUT:
                state[TAIL] += count - at
                state[POSITION] = count
                return DONE
        if end == _NO_FIT:
            begin = at
            at += 1
            while at < count and not chain_begins(data, at, least, most):
                at += 1
            state[DAMAGED] += at - begin
            state[RESYNCHRONISATIONS] += at < count
            state[POSITION] = at
            continue
        kind = int(data[at + 2])
        if foreign:
            state[DAMAGED] += end - at
        elif kind == _DATA:
            number = uint16(data, at + _HEAD)
            row_places[state[ROWS]] = at + _HEAD + 2
            row_subscriptions[state[ROWS]] = current[number]
            state[ROWS] += 1
        elif kind in (_FORMAT, _SUBSCRIBE, _UNSUBSCRIBE):
            return DEFINITION
        else:
            other_places[state[OTHERS]] = at
            state[OTHERS] += 1
        state[POSITION] = end
    return DONE


@compiled
def read_stamps(data: Bytes, places: npt.NDArray[np.int64], offsets: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The unsigned number of 8 bytes at each place, as a signed one; -1 where its offset is, or it is not whole.

    `offsets` are added to the places.
    """
    stamps = np.full(places.shape[0], -1, dtype=np.int64)
    for i in range(places.shape[0]):
        at = places[i] + offsets[i]
        if offsets[i] >= 0 and at + 8 <= data.shape[0] and data[at + 7] < 0x80:
            value = np.int64(0)
            for k in range(8):
                value |= np.int64(data[at + k]) << (8 * k)
            stamps[i] = value
    return stamps
