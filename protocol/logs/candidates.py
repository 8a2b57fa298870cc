"""Where a frame may begin among damaged bytes, in compiled code: which places are worth a checksum, which to believe."""

from __future__ import annotations

from protocol.compiled import compiled
from protocol.logs.records import checksum_verdict, near, stamp_at, untrimmed_length
from protocol.wire.framing import Bytes, Table, frame_end, message_of, signature_size

_LOOK_AHEAD = 64


@compiled
def record_follows(data: Bytes, end: int, stamp: int, stamp_size: int) -> bool:
    """Whether the bytes at `end` look like the next record of a log that was at time `stamp`, or are the log's end."""
    count = len(data)
    if end + stamp_size >= count:
        return True
    if data[end + stamp_size] != 0xFD and data[end + stamp_size] != 0xFE:
        return False
    return stamp_size == 0 or near(stamp_at(data, end), stamp)


@compiled
def may_begin(data: Bytes, at: int, table: Table, stamp_size: int) -> bool:
    """Whether a checksum at `at` is worth its time: a frame's first byte, and a message or a stamp that is one."""
    if (data[at] != 0xFD and data[at] != 0xFE) or at + 12 > len(data):
        return bool(data[at] == 0xFE) and at + 8 <= len(data)
    return bool(table[message_of(data, at)] != 0) or stamp_size == 0 or near(stamp_at(data, at - 8), -1)


@compiled
def unknown_fits(data: Bytes, at: int, table: Table, last: int, stamp_size: int) -> bool:
    """Whether the framing around a frame that no known seed explains is that of a log, and no known frame is inside."""
    end = frame_end(data, at) + 2 + signature_size(data, at)
    if stamp_size:
        stamp = stamp_at(data, at - 8)
        if not near(stamp, -1) or not record_follows(data, end, stamp, stamp_size):
            return False
        if not near(stamp, last) and end + stamp_size >= len(data):
            return False
    elif not record_follows(data, end, -1, 0):
        return False
    for inside in range(at + 1, end):
        if (data[inside] == 0xFD or data[inside] == 0xFE) and checksum_verdict(data, inside, table) == 1:
            return False
    return True


@compiled
def untrimmed_fits(data: Bytes, at: int, table: Table, last: int, stamp_size: int) -> bool:
    """Whether a frame with a wrong checksum is one whose zeros were cut off behind it: it has a stamp, or a frame follows."""
    end = frame_end(data, at)
    if end < 0 or data[at] != 0xFD:
        return False
    if stamp_size:
        framed = near(stamp_at(data, at - stamp_size), last)
    else:
        framed = record_follows(data, end + 2 + signature_size(data, at), -1, 0)
    return framed and untrimmed_length(data, at, table) > 0


@compiled
def agreeing_ahead(data: Bytes, at: int, seed: int, table: Table, last: int, stamp_size: int) -> int:
    """How many frames of the message at `at` follow soon, record upon record, whose checksums the same seed explains."""
    message, agreeing = message_of(data, at), 0
    for _ in range(_LOOK_AHEAD):
        at = frame_end(data, at) + 2 + signature_size(data, at) + stamp_size
        verdict = checksum_verdict(data, at, table) if at < len(data) else 0
        if verdict in (0, -257) or (stamp_size and not near(stamp_at(data, at - stamp_size), last)):
            break
        agreeing += message_of(data, at) == message and verdict == -1 - seed
    return agreeing


@compiled
def standing(data: Bytes, at: int, floor: int, last: int, stamp_size: int) -> int:
    """How much around a frame with a good checksum speaks for it: its own stamp, and what follows it (0 to 2)."""
    stamp = stamp_at(data, at - stamp_size)
    own = stamp_size > 0 and at - stamp_size >= floor and near(stamp, last)
    after = record_follows(data, frame_end(data, at) + 2 + signature_size(data, at), last, stamp_size)
    return int(own) + int(after)


@compiled
def best_of_overlapping(data: Bytes, at: int, floor: int, table: Table, last: int, stamp_size: int) -> int:
    """Of the frames with good checksums that overlap the one at `at`, the one for which most speaks; the first of equals."""
    best, score = at, standing(data, at, floor, last, stamp_size)
    if score == 2:
        return best
    for other in range(at + 1, frame_end(data, at) + 2):
        if (data[other] == 0xFD or data[other] == 0xFE) and checksum_verdict(data, other, table) > 0:
            its = standing(data, other, floor, last, stamp_size)
            if its > score:
                best, score = other, its
    return best
