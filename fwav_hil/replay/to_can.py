"""A log of a CAN bus replayed to a bus: true to time, or faster or slower."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bridge.motor_bus.can_bus import CanBus
from bridge.process import StopFlag
from bridge.recording.replay import Player, log_times_ns
from bridge.summary import percentiles_us
from bridge.timing.clock import PunctualClock
from fwav_hil.progress import StatusLine
from fwav_hil.replay.options import ReplayOptions
from protocol.errors import LogError, UsageError
from protocol.logs.can_log import classical_frames, format_of, read_can_log

PREFIX = "can:"
_BITRATE = 1_000_000


def replay_to_can(log: Path, uri: str, options: ReplayOptions, stop: StopFlag) -> dict[str, Any]:
    """Replay the frames of a CAN log to the bus `can:URI`; returns what was sent, and how punctually.

    Raises LogError for a file that is no CAN log, LinkError, UsageError where nothing in it is for a classical bus.
    """
    try:
        with log.open("rb") as file:
            suffix = format_of(file.read(8192))
        if suffix is None:
            raise LogError(f"{log} is no log of a CAN bus (.log of candump, .asc, .blf, .trc): only such go to {uri}")
        read = read_can_log(log, suffix)
    except OSError as error:
        raise LogError(f"cannot read the log {log}: {error.strerror}") from None
    stamps_us, frames = classical_frames(read)
    if not frames:
        raise UsageError(f"{log} holds no frame that a classical CAN bus carries")
    bus, line = CanBus(uri.removeprefix(PREFIX), _BITRATE), StatusLine()

    def look(player: Player) -> None:
        if stop.requested:
            player.stop()
        while bus.recv(0.0):  # what the others say is not for us
            pass
        line.show(f"{player.sent} frames sent")

    clock = PunctualClock(sleeps_half=False)
    player = Player(
        log_times_ns(stamps_us, options.max_gap_s),
        lambda number, _: frames[number],
        bus.send,
        clock,
        speed=options.speed,
        look=look,
    )
    try:
        begun_ns = clock.now_ns()
        player.play(loop=options.loop)
        wall_s = (clock.now_ns() - begun_ns) * 1e-9
    finally:
        line.end()
        bus.close()
    return {
        "log": str(log),
        "to": uri,
        "interrupted": stop.requested,
        "frames": player.sent,
        "left_out": len(read.frames) - len(frames),
        "passes": player.passes,
        "log_s": 1e-9 * (player.passes * int(player.times_ns[-1]) + (player.log_ns if player.at < len(frames) else 0)),
        "wall_s": wall_s,
        "speed": options.speed,
        "lateness_us": percentiles_us(player.lateness_ns),
        "counters": bus.counters | read.counters,
    }
