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

Bytes = npt.NDArray[np.uint8]
Table = npt.NDArray[np.int32]
State = npt.NDArray[np.int64]

FRAME = np.dtype(
    [
        ("stamp_us", "<i8"),
        ("offset", "<i8"),
        ("message_id", "<u4"),
        ("length", "<u2"),
        ("system", "u1"),
        ("component", "u1"),
        ("sequence", "u1"),
        ("version", "u1"),
        ("signed", "u1"),
        ("flags", "u1"),
        ("known", "u1"),
        ("stamp_ok", "u1"),
    ]
)
"""One row a frame; `protocol.log_scan` says what each column means."""

IDS = 1 << 24
# An entry of the table of messages: seed, longest MAVLink 1 payload, whether known; a seed learned, whether learned.
KNOWN, LEARNED = 1 << 16, 1 << 25
SIZE_SHIFT, LEARNED_SHIFT = 8, 17
_OWN = KNOWN | 0xFFFF

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

_DAY_US = 86_400_000_000
_SIMULATION_OR_DATE_US = 1 << 52  # the year 2112; simulation times begin at 0
_AGREEING = 2  # frames beyond the first that must agree on a seed
_MINUTE_US = 60_000_000
_LOOK_AHEAD = 8
_1, _2, _3, _4, _5, _6, _7 = (np.uint64(n) for n in range(1, 8))


def _crc_tables() -> Table:
    """tables[k, x]: the checksum's change by byte x when k bytes follow it (CRC-16/MCRF4XX, reflected 0x8408)."""
    tables = np.zeros((8, 256), dtype=np.int32)
    first = np.arange(256, dtype=np.int32)
    for _ in range(8):
        first = np.where(first & 1, first >> 1 ^ 0x8408, first >> 1).astype(np.int32)
    tables[0] = first
    for k in range(1, 8):
        tables[k] = tables[k - 1] >> 8 ^ first[tables[k - 1] & 0xFF]
    return tables


_TABLES = _crc_tables()
_FLAT = _TABLES.reshape(-1)
_BY_HIGH_BYTE = np.zeros(256, dtype=np.int32)
_BY_HIGH_BYTE[_TABLES[0] >> 8] = np.arange(256, dtype=np.int32)  # the high bytes are a permutation


@compiled
def byte(data: Bytes, at: int) -> int:
    """data[at] as a signed number; both casts are for speed and for numba's rules of types.

    An unsigned number and a signed one together would be a float; a signed index is first looked at for its sign.
    """
    return int(np.int64(data[np.uint64(at)]))


@compiled
def table_entry(row: int, number: int) -> int:
    """One value of the checksum's tables."""
    return int(_FLAT[np.uint64(row << 8 | number)])


@inlined
def crc_of(data: Bytes, start: int, stop: int) -> int:
    """Checksum of data[start:stop], without a seed; eight bytes at a time."""
    crc = 0xFFFF
    i = start
    while i + 8 <= stop:
        crc ^= byte(data, i) | byte(data, i + 1) << 8
        crc = (
            table_entry(7, crc & 0xFF)
            ^ table_entry(6, crc >> 8)
            ^ table_entry(5, byte(data, i + 2))
            ^ table_entry(4, byte(data, i + 3))
            ^ table_entry(3, byte(data, i + 4))
            ^ table_entry(2, byte(data, i + 5))
            ^ table_entry(1, byte(data, i + 6))
            ^ table_entry(0, byte(data, i + 7))
        )
        i += 8
    while i < stop:
        crc = (crc >> 8) ^ table_entry(0, (crc ^ byte(data, i)) & 0xFF)
        i += 1
    return crc


@compiled
def frame_end(data: Bytes, at: int) -> int:
    """Where the checksum of the frame that begins at `at` begins, going by its header; -1 where no frame begins."""
    if at + 8 > data.shape[0]:
        return -1
    if data[at] == 0xFD and at + 12 <= data.shape[0]:
        return at + 10 + byte(data, at + 1)
    if data[at] == 0xFE:
        return at + 6 + byte(data, at + 1)
    return -1


@compiled
def message_of(data: Bytes, at: int) -> int:
    """The message id of the frame at `at`."""
    if data[at] == 0xFE:
        return byte(data, at + 5)
    return byte(data, at + 7) | byte(data, at + 8) << 8 | byte(data, at + 9) << 16


@compiled
def signature_size(data: Bytes, at: int) -> int:
    """Bytes of signature behind the checksum of the frame at `at`, going by its header."""
    return 13 if data[at] == 0xFD and data[at + 2] & 1 else 0


@compiled
def checksum_verdict(data: Bytes, at: int, table: Table) -> int:
    """What the checksum says of a frame at `at`.

    1: it is one of a known message; 2: of a message whose seed was learned; 0: no frame begins here, or it is not whole;
    -1 - seed: only that seed would explain it; -257: nothing explains it.
    """
    end = frame_end(data, at)
    if end < 0 or end + 2 + signature_size(data, at) > data.shape[0]:
        return 0
    entry = int(table[message_of(data, at)])
    if data[at] == 0xFE and entry & KNOWN and byte(data, at + 1) > (entry >> SIZE_SHIFT & 0xFF):
        return 0
    crc = crc_of(data, at + 1, end)
    rest = (byte(data, end) | byte(data, end + 1) << 8) ^ (crc >> 8)
    seed = int(_BY_HIGH_BYTE[rest >> 8])
    if table_entry(0, seed) != rest:
        return -257
    seed ^= crc & 0xFF
    if entry & KNOWN and seed == (entry & 0xFF):
        return 1
    if entry & LEARNED and seed == (entry >> LEARNED_SHIFT & 0xFF):
        return 2
    return -1 - seed


@compiled
def stamp_at(data: Bytes, at: int) -> int:
    """The stamp at `at`, as a signed integer; -1 where none fits."""
    if at < 0 or at + 8 > data.shape[0]:
        return -1
    stamp = 0
    for i in range(8):
        stamp = stamp << 8 | byte(data, at + i)
    return stamp


@compiled
def near(one: int, other: int) -> bool:
    """Whether two stamps are of the same day or so; before there is one to compare with, whether it is a date at all."""
    if one < 0 or one >= _SIMULATION_OR_DATE_US:
        return False
    return other < 0 or abs(one - other) < _DAY_US


@compiled
def record_follows(data: Bytes, end: int, stamp: int, stamp_size: int) -> bool:
    """Whether the bytes at `end` look like the next record of a log that was at time `stamp`, or are the log's end."""
    count = data.shape[0]
    if end + stamp_size >= count:
        return True
    if data[end + stamp_size] != 0xFD and data[end + stamp_size] != 0xFE:
        return False
    return stamp_size == 0 or near(stamp_at(data, end), stamp)


@compiled
def may_begin(data: Bytes, at: int, table: Table, stamp_size: int) -> bool:
    """Whether a checksum at `at` is worth its time: a frame's first byte, and a message or a stamp that is one."""
    if (data[at] != 0xFD and data[at] != 0xFE) or at + 12 > data.shape[0]:
        return bool(data[at] == 0xFE) and at + 8 <= data.shape[0]
    return bool(table[message_of(data, at)] != 0) or stamp_size == 0 or near(stamp_at(data, at - 8), -1)


@compiled
def unknown_fits(data: Bytes, at: int, table: Table, last: int, stamp_size: int) -> bool:
    """Whether the framing around a frame that no known seed explains is that of a log, and no known frame is inside."""
    end = frame_end(data, at) + 2 + signature_size(data, at)
    if stamp_size:
        stamp = stamp_at(data, at - 8)
        if not near(stamp, -1) or not record_follows(data, end, stamp, stamp_size):
            return False
        if not near(stamp, last) and end + stamp_size >= data.shape[0]:
            return False
    elif not record_follows(data, end, -1, 0):
        return False
    for inside in range(at + 1, end):
        if (data[inside] == 0xFD or data[inside] == 0xFE) and checksum_verdict(data, inside, table) == 1:
            return False
    return True


@compiled
def learn(table: Table, votes: Table, message: int, seed: int, state: State) -> None:
    """Take note that this seed explains a frame of this message; enough in a row that agree make it a learned one."""
    vote = int(votes[message])
    if vote >> 8 and (vote & 0xFF) == seed:
        votes[message] = vote + 256
        if vote >> 8 == _AGREEING:
            table[message] = (table[message] & _OWN) | LEARNED | seed << LEARNED_SHIFT
            state[LEARNT] += 1
    else:
        votes[message] = 256 | seed


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


@compiled
def take_run(
    data: Bytes, until: int, stamp_size: int, table: Table, state: State, frames: npt.NDArray[np.void]
) -> None:
    """The way through a log without damage: records of known messages, one behind the other. Stops before any other."""
    floor, count, last, raw, signature = state[POSITION], state[COUNT], state[LAST_STAMP], state[RAW_STAMP], 0
    size, room = data.shape[0] - 12, frames.shape[0]
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
        crc = crc_of(data, at + 1, end)
        crc = (crc >> 8) ^ table_entry(0, (crc ^ entry) & 0xFF)
        if crc != (byte(data, end) | byte(data, end + 1) << 8):
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
                if not fits or table[message] & KNOWN:
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
                    verdict = 0
                at += 1
            if verdict == 0:
                state[SEARCH] = at
                return True
            state[RESYNCHRONISATIONS] += 1
            state[SEARCH] = -1
        take(data, at, verdict, stamp_size, state, frames)


@compiled
def take(data: Bytes, at: int, verdict: int, stamp_size: int, state: State, frames: npt.NDArray[np.void]) -> None:
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
    write_row(data, at, end + signature - at, stamp, verdict == 1, frames, state[COUNT])
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
    at, count = floor + stamp_size, data.shape[0]
    if at >= count:
        return bool(count > floor)
    if data[at] != 0xFD and data[at] != 0xFE:
        return False
    end = frame_end(data, at)
    return end < 0 or end + 2 + signature_size(data, at) > count


@compiled
def mend_stamps(frames: npt.NDArray[np.void]) -> int:
    """Replace stamps that damage has made absurd by the one before (the next, at the start); returns how many.

    A stamp that is a minute or more away from the one before is damaged where one of the next few is not; where they all
    are, the clock was set or the recording paused, and it stands. One without a date is damaged anyhow.
    """
    count = frames.shape[0]
    mended = 0
    last = -1
    for i in range(count):
        stamp = frames[i]["stamp_us"]
        good = 0 <= stamp < _SIMULATION_OR_DATE_US
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

    Left out are frames not chosen, unknown ones and those with flags of unknown meaning; an empty `chosen` is all.
    """
    for i in range(frames.shape[0]):
        frame = frames[i]
        if frame["known"] and not frame["flags"] & 0xFE and (chosen.shape[0] == 0 or chosen[i]):
            slot = slots[frame["message_id"]]
            if slot:
                counts[slot - 1] += 1


@inlined
def copy_bytes(source: Bytes, start: int, target: Bytes, place: int, count: int) -> None:
    """Copy bytes, eight at a time: read all before any is written, so that the compiler makes one move of them."""
    k = 0
    while k + 8 <= count:
        i, j = np.uint64(start + k), np.uint64(place + k)
        b0, b1, b2, b3 = source[i], source[i + _1], source[i + _2], source[i + _3]
        b4, b5, b6, b7 = source[i + _4], source[i + _5], source[i + _6], source[i + _7]
        target[j], target[j + _1], target[j + _2], target[j + _3] = b0, b1, b2, b3
        target[j + _4], target[j + _5], target[j + _6], target[j + _7] = b4, b5, b6, b7
        k += 8
    while k < count:
        target[np.uint64(place + k)] = source[np.uint64(start + k)]
        k += 1


@compiled
def fill_rows(
    data: Bytes,
    frames: npt.NDArray[np.void],
    chosen: npt.NDArray[np.uint8],
    slots: Table,
    places: State,
    sizes: State,
    head: int,
    rows: Bytes,
) -> None:
    """Copy each frame that `count_rows` counts into the row at `places` of its slot, which then moves on.

    A row is a head of `head` bytes (stamp, system, component, sequence) and the payload, `sizes` bytes long; `rows` must
    be zero at first, since a payload may lack trailing zeros. What a newer definition has more is left out.
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
