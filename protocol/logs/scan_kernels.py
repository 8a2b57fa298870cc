"""Finding MAVLink frames in the bytes of a log, in compiled code: framing, checksum, resynchronisation, time stamps.

A record is a stamp (8 bytes, big endian, microseconds) and a frame; a raw stream has no stamps (`stamp_size` 0). Where a
record does not follow on the one before it, the next frame is sought byte by byte and believed by its checksum.

A message that the dialect lacks has an unknown checksum seed (crc_extra). A frame of it is believed first where the
framing around it is consistent and where at least one seed, of the 256, explains its checksum; once frames agree on
the seed it is as good as known, and their checksums are verified too.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocol.compiled import compiled, inlined
from protocol.logs.candidates import (
    agreeing_ahead,
    best_of_overlapping,
    may_begin,
    unknown_fits,
    untrimmed_fits,
)
from protocol.logs.records import LEARNED, LEARNED_SHIFT, OWN, State, checksum_verdict, near, stamp_at
from protocol.wire.framing import (
    KNOWN,
    SIZE_SHIFT,
    Bytes,
    Table,
    byte,
    crc_of,
    frame_end,
    message_of,
    seeded,
    signature_size,
    uint16_at,
)

(
    POSITION,
    SEARCH,
    COUNT,
    LAST_STAMP,
    RAW_STAMP,
    SIGNATURE,
    DAMAGED,
    CRC_FAILURES,
    RESYNCHRONISATIONS,
    CUT,
    UNSTAMPED,
    LEARNT,
) = range(12)
STATE_SIZE = 12

UNTRIMMED = 3
"""A verdict beside those of `checksum_verdict`: the checksum is that of the frame before its trailing zeros were cut off."""

_AGREEING = 2  # frames beyond the first that must agree on a seed


@compiled
def learn(table: Table, votes: Table, message: int, seed: int, state: State) -> None:
    """Take note that this seed explains a frame of this message; enough in a row that agree make it a learned one."""
    vote = int(votes[message])
    if vote >> 8 and (vote & 0xFF) == seed:
        votes[message] = vote + 256
        if vote >> 8 == _AGREEING:
            table[message] = (table[message] & OWN) | LEARNED | seed << LEARNED_SHIFT
            state[LEARNT] += 1
    else:
        votes[message] = 256 | seed


@inlined
def write_row(
    data: Bytes, at: int, length: int, stamp: int, known: int, frames: npt.NDArray[np.void], count: int
) -> None:
    """Write the columns of the frame at `at`, `length` bytes long, into row `count`."""
    row = frames[count]
    row["stamp_us"] = stamp
    row["offset"] = at
    row["length"] = length
    row["message_id"] = message_of(data, at)
    first = at + 4 if data[np.uint64(at)] == 0xFD else at + 2
    row["version"] = 2 if first == at + 4 else 1
    row["flags"] = byte(data, at + 2) if first == at + 4 else 0
    row["sequence"] = byte(data, first)
    row["system"] = byte(data, first + 1)
    row["component"] = byte(data, first + 2)
    row["signed"] = signature_size(data, at) > 0
    row["known"] = known
    row["stamp_ok"] = stamp >= 0
    row["stale_checksum"] = 0


@compiled
def take_run(
    data: Bytes, until: int, stamp_size: int, table: Table, state: State, frames: npt.NDArray[np.void]
) -> None:
    """The way through a log without damage: records of known messages, one behind the other. Stops before any other."""
    floor, count, last, raw, signature = state[POSITION], state[COUNT], state[LAST_STAMP], state[RAW_STAMP], 0
    size, room = len(data) - 12, frames.shape[0]
    begun = count
    while floor < until and count < room:
        at = floor + stamp_size
        if at > size or (data[np.uint64(at)] != 0xFD and data[np.uint64(at)] != 0xFE):
            break
        end = frame_end(data, at)
        entry = int(table[np.uint64(message_of(data, at))])
        signature = signature_size(data, at)
        if not entry & KNOWN or end + signature > size + 10:
            break
        if data[np.uint64(at)] == 0xFE and end - at - 6 > (entry >> SIZE_SHIFT & 0xFF):
            break
        if seeded(crc_of(data, at + 1, end), entry & 0xFF) != uint16_at(data, end):
            break
        stamp = -1
        if stamp_size:
            stamp = stamp_at(data, floor)
            if near(stamp, last) or (raw >= 0 and near(stamp, raw)):
                last = stamp
            raw = stamp
        floor = end + 2 + signature
        write_row(data, at, floor - at, stamp, 1, frames, count)
        count += 1
    if count > begun:
        state[POSITION], state[COUNT], state[LAST_STAMP], state[RAW_STAMP] = floor, count, last, raw
        state[SIGNATURE] = signature_size(data, frames[count - 1]["offset"])


@compiled
def scan_slice(
    data: Bytes, until: int, stamp_size: int, table: Table, votes: Table, state: State, frames: npt.NDArray[np.void]
) -> bool:
    """Find the frames that begin before `until`; False where `frames` is full first: call again with more room.

    `state` carries on from call to call: begin with zeros, but SEARCH, LAST_STAMP and RAW_STAMP -1.
    """
    while True:
        if state[SEARCH] < 0:
            take_run(data, until, stamp_size, table, state, frames)
        floor = state[POSITION]  # the end of the record before
        if floor >= until:
            return True
        if state[COUNT] == frames.shape[0]:
            return False
        at = -1
        verdict = 0
        if state[SEARCH] < 0:
            at = floor + stamp_size
            verdict = checksum_verdict(data, at, table)
            if verdict <= 0 and stamp_size and checksum_verdict(data, floor, table) > 0:
                # A record may hold several frames behind one stamp, as QGroundControl writes what it sends.
                at = floor
                verdict = checksum_verdict(data, at, table)
            elif verdict < 0:
                message = message_of(data, at)
                fits = verdict > -257 and unknown_fits(data, at, table, state[LAST_STAMP], stamp_size)
                if fits:
                    learn(table, votes, message, -1 - verdict, state)
                    if table[message] & KNOWN and not table[message] & LEARNED:
                        # Another dialect's message of that number, where as many as it takes agree on the seed.
                        ahead = agreeing_ahead(data, at, -1 - verdict, table, state[LAST_STAMP], stamp_size)
                        for _ in range(min(ahead, _AGREEING)):
                            learn(table, votes, message, -1 - verdict, state)
                    verdict = checksum_verdict(data, at, table)
                if verdict < 0 and untrimmed_fits(data, at, table, state[LAST_STAMP], stamp_size):
                    verdict = UNTRIMMED
                elif verdict < 0 and (not fits or table[message] & KNOWN):
                    state[CRC_FAILURES] += table[message] & KNOWN != 0
                    verdict = 0
            if verdict == 0:
                state[SEARCH] = floor - state[SIGNATURE]
        if verdict == 0:
            at = state[SEARCH]
            while at < until:
                if may_begin(data, at, table, stamp_size):
                    verdict = checksum_verdict(data, at, table)
                    if verdict > 0:
                        at = best_of_overlapping(
                            data, at, floor - state[SIGNATURE], table, state[LAST_STAMP], stamp_size
                        )
                        verdict = checksum_verdict(data, at, table)
                        break
                    if (
                        -257 < verdict < 0
                        and not table[message_of(data, at)] & KNOWN
                        and at >= floor + stamp_size
                        and unknown_fits(data, at, table, state[LAST_STAMP], stamp_size)
                    ):
                        learn(table, votes, message_of(data, at), -1 - verdict, state)
                        break
                    if (
                        verdict < 0
                        and at >= floor + stamp_size
                        and untrimmed_fits(data, at, table, state[LAST_STAMP], stamp_size)
                    ):
                        verdict = UNTRIMMED
                        break
                    verdict = 0
                at += 1
            if verdict == 0:
                state[SEARCH] = at
                return True
            state[RESYNCHRONISATIONS] += 1
            state[SEARCH] = -1
        accept_frame(data, at, verdict, stamp_size, state, frames)


@compiled
def accept_frame(
    data: Bytes, at: int, verdict: int, stamp_size: int, state: State, frames: npt.NDArray[np.void]
) -> None:
    """Write the row of the frame at `at`, and go on behind it."""
    floor = state[POSITION]
    reaches_back = at - stamp_size < floor and near(stamp_at(data, at - stamp_size), state[LAST_STAMP])
    if state[SIGNATURE] and (at < floor or (stamp_size and reaches_back)):
        # The frame before has its checksum but not the whole signature that it announced.
        last = frames[state[COUNT] - 1]
        whole = floor - state[SIGNATURE]
        floor = min(floor, max(whole, at - stamp_size))
        last["length"] = floor - last["offset"]
        state[CUT] += 1
    stamp = stamp_at(data, at - 8) if stamp_size and at - 8 >= floor else -1
    if stamp_size and at - stamp_size < floor:
        state[DAMAGED] += at - floor
    else:
        state[DAMAGED] += at - stamp_size - floor
    end = frame_end(data, at) + 2
    signature = signature_size(data, at)
    write_row(data, at, end + signature - at, stamp, verdict in (1, UNTRIMMED), frames, state[COUNT])
    frames[state[COUNT]]["stale_checksum"] = verdict == UNTRIMMED
    if stamp_size and at == floor:
        state[UNSTAMPED] += 1
    else:
        if near(stamp, state[LAST_STAMP]) or (state[RAW_STAMP] >= 0 and near(stamp, state[RAW_STAMP])):
            state[LAST_STAMP] = stamp
        state[RAW_STAMP] = stamp
    state[SIGNATURE] = signature
    state[POSITION] = end + signature
    state[COUNT] += 1


@compiled
def is_cut_short(data: Bytes, floor: int, stamp_size: int) -> bool:
    """Whether what is left from `floor` on is the beginning of a record that the end of the file cuts short."""
    at, count = floor + stamp_size, len(data)
    if at >= count:
        return bool(count > floor)
    if data[at] != 0xFD and data[at] != 0xFE:
        return False
    end = frame_end(data, at)
    return end < 0 or end + 2 + signature_size(data, at) > count
