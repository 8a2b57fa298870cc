"""Motor protocols against bare python-can on the same interface: frames a second, added delay, processor time a frame.

An exchange is one tick's commands for six drives, there, and one frame back, between two processes on `udp_multicast`
(hop limit 0). Bare: ready-made python-can messages, received and looked at no further. Ours: torques into frames, sent by
`CanBus`, taken apart into orders at the other end. Both ways alternate within one run.
"""

from __future__ import annotations

import multiprocessing
import socket
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import can
import numpy as np

from benchmarks.row import row
from bridge.motor_bus.can_bus import CanBus
from protocol.can_frame import CanFrame
from protocol.motors.motor_protocol import Cause, make_drive, make_host
from protocol.motors.registry import PROTOCOLS
from protocol.scenario import Motor

GROUP = "239.74.163.2"
EXCHANGES = 300
ROUNDS = 5
BAR_US = 20.0
FIXED_LAYOUT = ("odrive", "mit")
_TORQUE = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6])
_BACK = CanFrame(0x7F1, b"\0" * 8)


class Figures(NamedTuple):
    """Of one protocol; times in us."""

    frames: int
    encode_us: float
    decode_us: float
    bare_us: float
    ours_us: float


def figures(protocol: str) -> Figures:
    """Measure one protocol; the figures a frame are those of the best round."""
    motor = Motor()
    host, drive = make_host(protocol, motor), make_drive(protocol, motor)
    frames = host.command(_TORQUE)
    encode = _processor_us(lambda: host.command(_TORQUE)) / len(frames)
    decode = _processor_us(lambda: [drive.decode(frame) for frame in frames]) / len(frames)
    bare, ours = [], []
    for _ in range(ROUNDS):
        bare.append(_exchange_us(protocol, bare=True))
        ours.append(_exchange_us(protocol, bare=False))
    return Figures(len(frames), encode, decode, min(bare) / len(frames), min(ours) / len(frames))


def can_protocols() -> dict[str, dict[str, Any]]:
    """Three rows of each protocol."""
    found = {}
    for protocol in PROTOCOLS:
        one = figures(protocol)
        codec = max(one.encode_us, one.decode_us)
        bar, ok = (f"<= {BAR_US:g} us", codec <= BAR_US) if protocol in FIXED_LAYOUT else ("-", True)
        bare = "bare python-can, udp_multicast"
        found[f"can_{protocol}_codec"] = row(codec, "us a frame", bare, one.bare_us, bar, ok=ok)
        found[f"can_{protocol}_added_delay"] = row(
            one.ours_us - one.bare_us, "us a frame", bare, one.bare_us, "-", ok=True
        )
        found[f"can_{protocol}_rate"] = row(1e6 / one.ours_us, "frames/s", bare, 1e6 / one.bare_us, "-", ok=True)
    return found


def _processor_us(work: Callable[[], object], count: int = 2000) -> float:
    best = float("inf")
    for _ in range(ROUNDS):
        begun = time.process_time()
        for _ in range(count):
            work()
        best = min(best, (time.process_time() - begun) / count)
    return 1e6 * best


def _exchange_us(protocol: str, *, bare: bool) -> float:
    """Median time of an exchange, us."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    other = context.Process(target=_answer_bare if bare else _answer_ours, args=(protocol, port, ready))
    other.start()
    try:
        ready.wait(20.0)
        return (_ask_bare if bare else _ask_ours)(protocol, port)
    finally:
        other.join(20.0)


def _ask_bare(protocol: str, port: int) -> float:
    frames = make_host(protocol, Motor()).command(_TORQUE)
    messages = [can.Message(arbitration_id=f.can_id, data=f.data, is_extended_id=f.extended) for f in frames]
    times = []
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port, hop_limit=0) as bus:
        for _ in range(EXCHANGES):
            begun = time.perf_counter()
            for message in messages:
                bus.send(message)
            while (heard := bus.recv(1.0)) is not None and heard.arbitration_id != _BACK.can_id:
                pass  # it hears itself
            times.append(time.perf_counter() - begun)
    return 1e6 * statistics.median(times)


def _answer_bare(protocol: str, port: int, ready: Any) -> None:
    back = can.Message(arbitration_id=_BACK.can_id, data=_BACK.data, is_extended_id=False)
    count = len(make_host(protocol, Motor()).command(_TORQUE))
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port, hop_limit=0) as bus:
        ready.set()
        for _ in range(EXCHANGES):
            taken = 0
            while taken < count:
                heard = bus.recv(1.0)
                if heard is None:
                    return
                taken += heard.arbitration_id != _BACK.can_id
            bus.send(back)


def _ask_ours(protocol: str, port: int) -> float:
    host = make_host(protocol, Motor())
    times = []
    with CanBus(f"udp_multicast:{GROUP}:{port}", 1_000_000) as bus:
        for _ in range(EXCHANGES):
            begun = time.perf_counter()
            for frame in host.command(_TORQUE):
                bus.send(frame)
            bus.recv(1.0)
            times.append(time.perf_counter() - begun)
    return 1e6 * statistics.median(times)


def _answer_ours(protocol: str, port: int, ready: Any) -> None:
    drive = make_drive(protocol, Motor())
    count = len(make_host(protocol, Motor()).command(_TORQUE))
    with CanBus(f"udp_multicast:{GROUP}:{port}", 1_000_000) as bus:
        ready.set()
        for _ in range(EXCHANGES):
            for _ in range(count):
                frame = bus.recv(1.0)
                if frame is None or isinstance(drive.decode(frame), Cause):
                    return
            bus.send(_BACK)
