"""Open-loop probes of one link: our own responder, a bare echo, a mavutil script, or an autopilot."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bridge.endpoint import Endpoint
from bridge.latency.probes import ProbeResult, probe
from bridge.links.link import Link, counterpart, open_link
from bridge.process import StopFlag
from bridge.timing.clock import MonotonicClock
from bridge.timing.timesync import Estimate, TimeSync
from fwav_hil.latency.echo import TICK_BYTES
from protocol.errors import PeerMissingError
from protocol.wire import mapping
from protocol.wire.codec import FrameReader, FrameWriter

GROUND_STATION = (255, 190)
EMULATOR = (1, 191)
_HISTOGRAM_US = 100_000
_LOOK_S = 0.1
Told = Callable[[int], None]


def probe_time_sync(
    link: Link, stop: StopFlag, *, rate_hz: float, count: int, told: Told
) -> tuple[ProbeResult, Estimate | None]:
    """TIMESYNC requests as a ground station sends them; with the other clock's offset from the fastest answer."""
    clock = MonotonicClock()
    endpoint = Endpoint(link, *GROUND_STATION)
    numbers: dict[int, int] = {}
    best: dict[int, tuple[int, int]] = {}
    others = TimeSync(endpoint.seal, clock)

    def question(number: int) -> bytes:
        asked_ns = clock.now_ns()
        numbers[asked_ns] = number
        return endpoint.seal(mapping.TIMESYNC, mapping.encode_timesync(0, asked_ns))

    def answered(data: bytes) -> list[int]:
        arrived_ns = link.received_ns or clock.now_ns()
        found = []
        for frame in endpoint.reader.read(data):
            if frame.message_id != mapping.TIMESYNC.message_id or (frame.system, frame.component) == GROUND_STATION:
                continue  # our own request, echoed by the line
            answer_ns, asked_ns = mapping.decode_timesync(frame.payload)
            if answer_ns == 0:  # a request of the other end
                reply = others.handle(frame, arrived_ns)
                if reply:
                    link.send(reply)
                continue
            number = numbers.get(asked_ns, -1)
            found.append(number)
            if number >= 0 and arrived_ns >= asked_ns:
                best.setdefault(number, (arrived_ns - asked_ns, answer_ns - (asked_ns + arrived_ns) // 2))
        return found

    result = probe(
        link,
        clock,
        stop,
        period_ns=round(1e9 / rate_hz),
        count=count,
        question=question,
        answered=answered,
        progress=told,
    )
    if not best:
        return result, None
    round_trip_ns, offset_ns = min(best.values())
    return result, Estimate(offset_ns, round_trip_ns, len(best))


def probe_responder(stop: StopFlag, *, rate_hz: float, count: int, told: Told) -> ProbeResult:
    """TIMESYNC between two of our processes over UDP."""
    with (
        _child("bridge.latency.responder", "udpin://127.0.0.1:0") as said,
        open_link(counterpart(said)) as link,
    ):
        link.stamp_receives()
        return probe_time_sync(link, stop, rate_hz=rate_hz, count=count, told=told)[0]


def probe_echo(stop: StopFlag, *, rate_hz: float, count: int, told: Told) -> ProbeResult:
    """A bare UDP echo: the bytes of a tick out, those of a command back."""

    def question(number: int) -> bytes:
        return number.to_bytes(8, "little").ljust(TICK_BYTES, b"x")

    def answered(data: bytes) -> list[int]:
        return [int.from_bytes(data[:8], "little")]

    return _probe_port("fwav_hil.latency.echo", stop, rate_hz, count, question, answered, told)


def probe_mavutil(stop: StopFlag, *, rate_hz: float, count: int, told: Told) -> ProbeResult:
    """Pose and tick out, HIL_ACTUATOR_CONTROLS back, by a mavutil script at the other end."""
    period_ns = round(1e9 / rate_hz)
    writer, reader = FrameWriter(*EMULATOR), FrameReader(is_datagram=True)
    q, readings = np.zeros(6), np.zeros(13)

    def question(number: int) -> bytes:
        t_ns = (number + 1) * period_ns
        pose = writer.seal(mapping.POSE, mapping.encode_pose(t_ns, q))
        return pose + writer.seal(mapping.TICK, mapping.encode_tick(t_ns, readings))

    def answered(data: bytes) -> list[int]:
        found = []
        for frame in reader.read(data):
            if frame.message_id == mapping.COMMAND.message_id:
                t_us = int.from_bytes(frame.payload[:8].ljust(8, b"\0"), "little")
                found.append(round(t_us * 1000 / period_ns) - 1)
        return found

    return _probe_port("protocol.wire.mavutil_peer", stop, rate_hz, count, question, answered, told)


def _probe_port(
    module: str,
    stop: StopFlag,
    rate_hz: float,
    count: int,
    question: Callable[[int], bytes],
    answered: Callable[[bytes], list[int]],
    told: Told,
) -> ProbeResult:
    with _child(module) as port, open_link(f"udpout://127.0.0.1:{port}") as link:
        link.stamp_receives()
        return probe(
            link, MonotonicClock(), stop, period_ns=round(1e9 / rate_hz), count=count, question=question,
            answered=answered, progress=told,
        )  # fmt: skip


@contextmanager
def _child(module: str, *arguments: str) -> Iterator[str]:
    """One of our modules as a process; yields the first line it writes, and ends it.

    It has a session of its own: a Ctrl-C reaches this process only, which then ends it.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", module, *arguments], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        line = process.stdout.readline().strip() if process.stdout else ""
        if not line:
            raise PeerMissingError(f"the process `python -m {module}` did not start: run it alone to see why")
        yield line
    finally:
        process.kill()
        process.communicate()


def cyclictest(stop: StopFlag, *, rate_hz: float, seconds: float, told: Told) -> npt.NDArray[np.int64] | None:
    """Wake-up lateness of cyclictest (Debian rt-tests), ns, whole microseconds; None where it is not installed or fails.

    It runs at the period of rate_hz, without real-time priority and without limiting idle states: an ordinary process, like
    ours. `told` is called with the number of loops expected so far. Raises Interrupted.
    """
    program = shutil.which("cyclictest") or ("/usr/sbin/cyclictest" if Path("/usr/sbin/cyclictest").exists() else None)
    if program is None:
        return None
    period_us, loops = round(1e6 / rate_hz), round(rate_hz * seconds)
    command = [
        program,
        "-q",
        "--policy=other",
        "--default-system",
        "-t1",
        f"-i{period_us}",
        f"-l{loops}",
        f"-h{_HISTOGRAM_US}",
    ]
    clock = MonotonicClock()
    begun_ns = clock.now_ns()
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, start_new_session=True
    ) as process:
        try:
            while True:
                stop.check()
                try:
                    said, _ = process.communicate(timeout=_LOOK_S)
                    break
                except subprocess.TimeoutExpired:
                    told(min(loops, round((clock.now_ns() - begun_ns) * 1e-9 * rate_hz)))
        finally:
            process.kill()
    return None if process.returncode else lateness_of(said)


def lateness_of(said: str) -> npt.NDArray[np.int64] | None:
    """Lateness (n,) ns from the histogram that cyclictest printed; values beyond it count as its maximum."""
    values, counts = [], []
    for line in said.splitlines():
        if found := re.fullmatch(r"(\d+)\s+(\d+)", line.strip()):
            values.append(int(found[1]))
            counts.append(int(found[2]))
    most, beyond = (re.search(rf"# {name}:\s*(\d+)", said) for name in ("Max Latencies", "Histogram Overflows"))
    if most and beyond:
        values.append(int(most[1]))
        counts.append(int(beyond[1]))
    lateness = np.repeat(np.array(values, dtype=np.int64) * 1000, np.array(counts, dtype=np.int64))
    return lateness if len(lateness) else None
