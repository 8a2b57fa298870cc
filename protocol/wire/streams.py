"""All messages of the link in one table: sender, rate, purpose. The README's table is printed from it.

`rate_hz` is the rate of a stream in simulation time; None means once per tick, or on an event (see `rule`).
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from typing import NamedTuple

from protocol.due import NANOSECONDS

HEARTBEAT_TIMEOUT_NS = 3 * NANOSECONDS


class End(enum.Enum):
    """The sender of a message."""

    EMULATOR = "emulator"
    CONTROLLER = "controller"
    BOTH = "both"
    STATION = "ground station"


class Stream(NamedTuple):
    """One row: a MAVLink message, its sender, its rate and its rule; each_tick: sent once per tick."""

    message: str
    sender: End
    rate_hz: float | None
    rule: str
    each_tick: bool = False


STREAMS = (
    Stream("HEARTBEAT", End.BOTH, 1.0, "presence of each end, and whether the controller is armed; timeout 3 s"),
    Stream(
        "AUTOPILOT_VERSION", End.BOTH, None, "at the start: 8 bytes of the scenario's digest; a mismatch is refused"
    ),
    Stream(
        "ATT_POS_MOCAP", End.EMULATOR, None, "every tick, before it: position and attitude, all that a law reads", True
    ),
    Stream("HIL_SENSOR", End.EMULATOR, None, "the tick: simulation time, and an IMU for real autopilots", True),
    Stream("HIL_GPS", End.EMULATOR, 10.0, "for real autopilots"),
    Stream(
        "HIL_ACTUATOR_CONTROLS", End.CONTROLLER, None, "one for each tick; time_usec echoes the sample it answers", True
    ),
    Stream(
        "PARAM_VALUE",
        End.CONTROLLER,
        None,
        "gains, scales, limits, gears: each once at the start, for the log, and when changed; to a ground station on request",
    ),
    Stream("POSITION_TARGET_LOCAL_NED", End.CONTROLLER, 50.0, "the reference at the sample's time, for the log"),
    Stream("ATTITUDE_TARGET", End.CONTROLLER, 50.0, "the reference at the sample's time, for the log"),
    Stream("PARAM_REQUEST_LIST", End.STATION, None, "to the controller, on its station's link: all parameters"),
    Stream("PARAM_REQUEST_READ", End.STATION, None, "one parameter"),
    Stream("PARAM_SET", End.STATION, None, "a gain, while disarmed"),
    Stream("PARAM_ERROR", End.CONTROLLER, None, "why a parameter was not sent or not set"),
    Stream("FILE_TRANSFER_PROTOCOL", End.CONTROLLER, None, "refusal of the files that stations request first"),
    Stream(
        "TIMESYNC", End.BOTH, 1.0, "real time only: how far the other end's clock is ahead; 20 Hz for the first ten"
    ),
    Stream(
        "CAN_FRAME",
        End.EMULATOR,
        None,
        "on the tap's own link (`--tap`): the motor bus, while the request 32000 is renewed within 5 s",
    ),
    Stream(
        "HIL_STATE_QUATERNION", End.EMULATOR, None, "the true state, on request (511, 512, `--truth`); no law reads it"
    ),
    Stream("ODOMETRY", End.EMULATOR, None, "the true state in floats: metres, body rates; on request"),
    Stream(
        "RAW_RPM",
        End.EMULATOR,
        None,
        "drives on a bus: the speed that each reports; 10 Hz to a ground station, or on request",
    ),
    Stream(
        "COMMAND_LONG",
        End.STATION,
        None,
        "400 (arm, disarm) to the controller; 511, 512 (a message at a rate, once) and 32000 (CAN) to the emulator",
    ),
    Stream("COMMAND_ACK", End.BOTH, None, "the answer to COMMAND_LONG"),
)


def stream(message: str) -> Stream:
    """The row of `message`. Raises KeyError for a message not in the table."""
    for row in STREAMS:
        if row.message == message:
            return row
    raise KeyError(f"no stream {message}")


def markdown_table() -> Iterator[str]:
    """The lines of the table in the README."""
    yield "| message | sent by | rate | rule |"
    yield "| --- | --- | --- | --- |"
    for row in STREAMS:
        rate = f"{row.rate_hz:g} Hz" if row.rate_hz else "-"
        yield f"| {row.message} | {row.sender.value} | {rate} | {row.rule} |"


if __name__ == "__main__":
    import sys

    sys.stdout.writelines(line + "\n" for line in markdown_table())
