"""Whether the messages of the loop fit a link at a rate, and the delay that each hop adds.

Sizes are those of real frames, with trailing zeros cut off as on the wire. A serial line (8N1) carries baud / 10 bytes per
second each way, a hard bound. A network is counted with its headers against an assumed speed that any usual rate fits.
"""

from __future__ import annotations

import contextlib
import functools
from bisect import bisect_right
from pathlib import Path

import msgspec
import numpy as np

from bridge.links.link import BITS_PER_BYTE, LINKS, LinkUri, parse_link_uri
from protocol.messages import VEHICLE, ActuatorCommand
from protocol.wire import mapping
from protocol.wire.codec import FrameWriter, layout
from protocol.wire.framing import CRC_SIZE, HEADER_V2
from protocol.wire.streams import STREAMS, End, Stream

USUAL_BAUDS = (57_600, 115_200, 230_400, 460_800, 921_600, 1_500_000, 2_000_000, 3_000_000, 4_000_000)
ADAPTER_HOLD_S = 0.001
"""Longest time that a USB adapter holds bytes back in the low-latency mode that the link requests when it is opened."""

_FASTEST_HZ = 10_000_000
_WAYS = (("emulator to controller", End.EMULATOR), ("controller to emulator", End.CONTROLLER))


class Share(msgspec.Struct, frozen=True):
    """One message in one direction: bytes per frame, frames and bytes per second."""

    message: str
    frame_bytes: int
    rate_hz: float
    bytes_per_s: float


class Way(msgspec.Struct, frozen=True):
    """One direction. share: used fraction of its capacity; tick_bytes: bytes sent per period; highest_rate_hz: the highest
    whole rate that fits, or less than 1 where none does.
    """

    name: str
    messages: tuple[Share, ...]
    overhead_bytes_per_s: float
    bytes_per_s: float
    capacity_bytes_per_s: float
    share: float
    tick_bytes: int
    highest_rate_hz: int


class Hop(msgspec.Struct, frozen=True):
    """Delay that one hop adds between a sample and the command that answers it, and where the figure comes from."""

    name: str
    delay_s: float
    note: str = ""


class Budget(msgspec.Struct, frozen=True):
    """A link at a rate. fits: the verdict; sentence: the verdict in words; delay_s, delay_periods: sum of all hops."""

    link: str
    rate_hz: float
    ways: tuple[Way, ...]
    hops: tuple[Hop, ...]
    delay_s: float
    delay_periods: float
    highest_rate_hz: int
    fits: bool
    sentence: str


@functools.cache
def frame_bytes(message: str) -> int:
    """Size of a frame of `message` as it is sent in the loop; without an example of it, the size with a full payload.

    Raises KeyError where the dialect has no such message.
    """
    payload = _examples().get(message)
    if payload is None:
        return HEADER_V2 + layout(message).size + CRC_SIZE
    return len(FrameWriter(*VEHICLE).seal(layout(message), payload))


def _examples() -> dict[str, bytes]:
    """Example payloads in which every field used by the loop is non-zero."""
    t_ns, q, rates = 1_234_567_891_000, np.linspace(0.1, 0.6, 6), np.linspace(1.1, 1.6, 6)
    return {
        "HEARTBEAT": mapping.encode_controller_heartbeat(armed=True),
        "ATT_POS_MOCAP": mapping.encode_pose(t_ns, q),
        "HIL_SENSOR": mapping.encode_tick(t_ns, np.linspace(0.1, 1.3, 13)),
        "HIL_GPS": mapping.encode_gps(t_ns, 47.1, 8.1, 400.1, rates[:3]),
        "HIL_ACTUATOR_CONTROLS": mapping.encode_command(
            ActuatorCommand(t_ns, q, armed=True), np.ones(6), lockstep=False
        ),
        "POSITION_TARGET_LOCAL_NED": mapping.encode_position_target(t_ns, q, rates, rates),
        "ATTITUDE_TARGET": mapping.encode_attitude_target(t_ns, q),
    }


def link_budget(uri: str, rate_hz: float) -> Budget:
    """The budget of a link at a rate. Raises LinkUriError where the URI is not valid."""
    link = parse_link_uri(uri)
    ways = tuple(_way(name, end, link, rate_hz) for name, end in _WAYS)
    hops = _hops(link, ways)
    delay_s = sum(hop.delay_s for hop in hops)
    highest_hz = min(way.highest_rate_hz for way in ways)
    fits = all(way.share <= 1.0 for way in ways)
    return Budget(
        link=uri,
        rate_hz=rate_hz,
        ways=ways,
        hops=hops,
        delay_s=delay_s,
        delay_periods=delay_s * rate_hz,
        highest_rate_hz=highest_hz,
        fits=fits,
        sentence=_fits_sentence(uri, rate_hz, ways) if fits else _refusal(link, rate_hz, ways, highest_hz),
    )


def _way(name: str, end: End, link: LinkUri, rate_hz: float) -> Way:
    sent = [row for row in STREAMS if row.sender in (end, End.BOTH) and (row.each_tick or row.rate_hz)]
    header = LINKS[link.scheme].header_bytes
    capacity = LINKS[link.scheme].capacity(link)

    def shares_at(hz: float) -> tuple[Share, ...]:
        return tuple(_share(row, hz) for row in sent)

    def total_at(hz: float) -> float:
        # Messages that are not sent every tick travel in the datagram of a tick.
        return sum(share.bytes_per_s for share in shares_at(hz)) + header * hz

    total = total_at(rate_hz)
    return Way(
        name=name,
        messages=shares_at(rate_hz),
        overhead_bytes_per_s=header * rate_hz,
        bytes_per_s=total,
        capacity_bytes_per_s=capacity,
        share=total / capacity,
        tick_bytes=sum(frame_bytes(row.message) for row in sent if row.each_tick) + header,
        highest_rate_hz=bisect_right(range(_FASTEST_HZ), capacity, key=total_at) - 1,
    )


def _share(row: Stream, rate_hz: float) -> Share:
    size = frame_bytes(row.message)
    often_hz = rate_hz if row.each_tick else min(rate_hz, row.rate_hz or 0.0)
    return Share(row.message, size, often_hz, size * often_hz)


def _hops(link: LinkUri, ways: tuple[Way, ...]) -> tuple[Hop, ...]:
    """The hops between a sample and the action of its command, without the computing time of the two processes."""
    capacity = LINKS[link.scheme].capacity(link)
    speed = f"{link.baud} baud" if link.baud else f"{8e-6 * capacity:g} Mbit/s, assumed"
    tick, command = (
        Hop(what, way.tick_bytes / capacity, f"{way.tick_bytes} bytes at {speed}")
        for what, way in zip(("pose and tick on the wire", "command on the wire"), ways, strict=True)
    )
    adapter = _adapter(link)
    return (tick, *adapter, command, *adapter)


def _adapter(link: LinkUri) -> tuple[Hop, ...]:
    """The time that the receiving USB adapter waits for more bytes, where the device's name shows that it is one."""
    device = Path(link.path).resolve().name if link.path else ""
    if not device.startswith("ttyUSB"):
        return ()
    note = "at most, in low-latency mode; up to 16 ms where the driver refuses that mode"
    with contextlib.suppress(OSError):
        timer = Path(f"/sys/bus/usb-serial/devices/{device}/latency_timer").read_text(encoding="ascii").strip()
        note += f" (latency_timer is {timer} ms now)"
    return (Hop("USB adapter", ADAPTER_HOLD_S, note),)


def _fits_sentence(uri: str, rate_hz: float, ways: tuple[Way, ...]) -> str:
    worst = max(ways, key=lambda way: way.share)
    share = f"{100 * worst.share:.0f}" if worst.share >= 0.01 else "less than 1"
    return f"{rate_hz:g} Hz fits {uri}: it takes {share} % of the capacity from {worst.name}"


def _refusal(link: LinkUri, rate_hz: float, ways: tuple[Way, ...], highest_hz: int) -> str:
    worst = max(ways, key=lambda way: way.share)
    needed = BITS_PER_BYTE * worst.bytes_per_s
    enough = next((baud for baud in USUAL_BAUDS if baud >= needed), None) if link.baud else None
    other = f", or {enough} baud or more" if enough else ""
    if highest_hz >= 1:
        remedy = f"up to {highest_hz} Hz fit, so choose --rate {_usual_rate(highest_hz)}{other}"
    else:
        remedy = f"no rate fits, so choose a faster link{other}"
    return (
        f"{rate_hz:g} Hz does not fit {link.text}: from {worst.name} it needs {worst.bytes_per_s / 1e3:.1f} kB/s of "
        f"{worst.capacity_bytes_per_s / 1e3:.1f} kB/s available: {remedy}"
    )


def _usual_rate(highest_hz: int) -> int:
    """The highest whole rate up to this one whose period is a whole number of microseconds."""
    return next(rate for rate in range(highest_hz, 0, -1) if 1_000_000 % rate == 0)
