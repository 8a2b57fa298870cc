"""Packing and parsing every message of the contract, unsigned, against pymavlink doing the same."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common

from benchmarks.row import ALTERNATIONS, row
from protocol.wire.codec import FrameReader, FrameWriter, layout
from protocol.wire.streams import STREAMS

BATCHES, CALLS = 12, 300
"""Short batches, ours and theirs by turns, so that a noisy moment meets both; the best batch counts."""
BAR = 4.0


def codec() -> dict[str, dict[str, Any]]:
    """Times of one pack and one parse, the slowest message against pymavlink by ratio; all of them in the notes."""
    names = [stream.message for stream in STREAMS]
    calls = {name: _calls(name) for name in names}
    ours: dict[str, dict[str, float]] = {"pack": {}, "parse": {}}
    theirs: dict[str, dict[str, float]] = {"pack": {}, "parse": {}}
    for _ in range(ALTERNATIONS * BATCHES):
        for name in names:
            for what, (our_call, their_call) in calls[name].items():
                ours[what][name] = min(ours[what].get(name, 1e9), _microseconds(our_call))
                theirs[what][name] = min(theirs[what].get(name, 1e9), _microseconds(their_call))
    results = {}
    for what in ("pack", "parse"):
        ratios = {name: theirs[what][name] / ours[what][name] for name in names}
        worst = min(ratios, key=lambda name: ratios[name])
        results[f"codec_{what}"] = row(
            ours[what][worst], "us", f"pymavlink, {worst}", theirs[what][worst], f"<= 1/{BAR:g} of pymavlink's",
            ok=ratios[worst] >= BAR, note=", ".join(f"{name} {ratios[name]:.1f}x" for name in names),
        )  # fmt: skip
    return results


def _calls(name: str) -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """What is timed: values in, frame out; frame in, values out. Both sides from and to the same."""
    ours = layout(name)
    values = ours.unpack(bytes(range(1, 256))[: ours.size].ljust(ours.size, b"\1"))
    writer = FrameWriter(1, 1)
    reader = FrameReader(is_datagram=True)
    frames = itertools.cycle([writer.seal(ours, ours.pack(*values)) for _ in range(256)])  # numbered in line
    parser = common.MAVLink(None, srcSystem=1, srcComponent=1)
    sender = common.MAVLink(None, srcSystem=1, srcComponent=1)
    message_class = common.mavlink_map[ours.message_id]
    given = list(_arguments(parser.parse_buffer(next(frames))[0]))

    def our_pack() -> bytes:
        return writer.seal(ours, ours.pack(*values))

    def their_pack() -> object:
        return message_class(*given).pack(sender)

    def our_parse() -> object:
        return ours.unpack(reader.read(next(frames))[0].payload)

    def their_parse() -> object:
        return parser.parse_buffer(next(frames))[0]

    assert our_pack()[10:-2] == bytes(their_pack())[10:-2], name  # type: ignore[call-overload]
    return {"pack": (our_pack, their_pack), "parse": (our_parse, their_parse)}


def _arguments(message: Any) -> list[Any]:
    """What the message's class takes: for texts the bytes, which pymavlink keeps beside what it made of them."""
    return [getattr(message, f"_{field}_raw", getattr(message, field)) for field in message.fieldnames]


def _microseconds(call: Callable[[], object]) -> float:
    begun_ns = time.perf_counter_ns()
    for _ in range(CALLS):
        call()
    return (time.perf_counter_ns() - begun_ns) / CALLS / 1e3
