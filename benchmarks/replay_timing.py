"""How punctual a replay is, by the kernel's stamps of what arrives, beside cyclictest's wake-ups on the same core by turns."""

from __future__ import annotations

import json
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.row import ALTERNATIONS, row
from benchmarks.wake_up import cyclictest
from bridge.timing.realtime import own_core
from protocol.wire.codec import FrameWriter, layout

RATE_HZ, SECONDS = 250.0, 4.0
BAR_US, BAR_SPEED = 1000.0, 0.005
_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@ll")
_MESSAGES = ("ATT_POS_MOCAP", "HIL_SENSOR", "HIL_ACTUATOR_CONTROLS")


def replay_timing(seconds: float = SECONDS) -> dict[str, dict[str, Any]]:
    """p99 of how late frames are at true time, and the speed that `--speed 10` comes to; of a log as a run leaves it."""
    if not shutil.which("cyclictest"):
        print(
            "*** NOT MEASURED: a replay's timing has no anchor without cyclictest: sudo apt install rt-tests ***",
            file=sys.stderr,
        )
        return {}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.tlog"
        times_ns = write_ticks(log, seconds)
        turns, speeds = [], []
        for _ in range(ALTERNATIONS):
            theirs, _ = cyclictest(seconds, own_core(0) or 0, RATE_HZ)
            turns.append((theirs, *(lateness_us(log, times_ns, 1.0, *more)[0] for more in ((), ("--realtime",)))))
            speeds.append(lateness_us(log, times_ns, 10.0, "--realtime")[1])
    theirs, _, ours = min(turns, key=lambda turn: turn[2])
    seen = "; ".join(f"{theirs:.0f} / {plain:.0f} / {ours:.0f} us" for theirs, plain, ours in turns)
    note = (
        f"{seconds:g} s each, {len(_MESSAGES)} frames {RATE_HZ:g} times a second; p99 by turns of cyclictest / replay / "
        f"replay --realtime: {seen}"
    )
    speed = max(speeds, key=lambda one: abs(one - 10.0))
    return {
        "replay_timing": row(ours, "us", "cyclictest p99", theirs, f"p99 < {BAR_US:g} us", ok=ours < BAR_US, note=note),
        "replay_10x": row(
            speed, "x", "asked for", 10.0, f"within {100 * BAR_SPEED:g} %", ok=abs(speed / 10.0 - 1.0) <= BAR_SPEED,
            note="the worst of the turns",
        ),
    }  # fmt: skip


def write_ticks(path: Path, seconds: float) -> np.ndarray[Any, np.dtype[np.int64]]:
    """A log of ticks as a run leaves it; returns the log time (n,) of each frame, ns."""
    random, writer = np.random.default_rng(1), FrameWriter(1, 1)
    stamps_us = np.repeat(np.arange(round(seconds * RATE_HZ)) * round(1e6 / RATE_HZ), len(_MESSAGES))
    with path.open("wb") as file:
        for number, stamp_us in enumerate(stamps_us.tolist()):
            kind = layout(_MESSAGES[number % len(_MESSAGES)])
            frame = writer.seal(kind, random.integers(1, 256, kind.size, dtype=np.uint8).tobytes())
            file.write(struct.pack(">Q", stamp_us) + frame)
    return stamps_us * 1000


def lateness_us(
    log: Path, times_ns: np.ndarray[Any, np.dtype[np.int64]], speed: float, *more: str
) -> tuple[float, float]:
    """p99 of how late frames arrive, against the most punctual one, and the speed by the first and last arrival."""
    arrivals_ns: list[int] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
        listener.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(20.0)

        def listen() -> None:
            for _ in range(len(times_ns)):
                _, ancillary, _, _ = listener.recvmsg(2048, 64)
                seconds, nanoseconds = _TIMESPEC.unpack(ancillary[0][2])
                arrivals_ns.append(seconds * 1_000_000_000 + nanoseconds)

        thread = threading.Thread(target=listen)
        thread.start()
        uri = f"udpout://127.0.0.1:{listener.getsockname()[1]}"
        command = [sys.executable, "-m", "fwav_hil", "replay", str(log), "--to", uri, "--speed", f"{speed:g}", *more]
        said = subprocess.run(
            [*command, "--json", "-"], check=True, capture_output=True, stdin=subprocess.DEVNULL
        ).stdout
        thread.join()
    assert json.loads(said)["frames"] == len(arrivals_ns) == len(times_ns)
    ahead_ns = np.array(arrivals_ns) - times_ns / speed
    late_ns = ahead_ns - ahead_ns.min()
    return float(np.percentile(late_ns, 99)) / 1e3, float(times_ns[-1] / (arrivals_ns[-1] - arrivals_ns[0]))
