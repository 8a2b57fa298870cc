"""Interface of the CAN motor protocols: torque commands for six axes to frames, and frames to orders and readings.

A protocol is one file with a `Host` (the commanding end), a `Drive` (the six drives) and a `traffic` list, and one line in
`registry.PROTOCOLS`. Neither end does I/O or reads the time. Torques are fractions of full scale here (1 is `actuators.scale`
of the axis), angles in rad at the shaft; each protocol's file describes its own units.

A rejected frame does not raise an exception: it gives a cause, one of CAUSES, which the caller counts.
"""

from __future__ import annotations

import abc
import enum
import importlib
from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

from protocol.can_frame import CanFrame, worst_bits
from protocol.errors import UsageError
from protocol.messages import AXES, FloatArray
from protocol.motors.registry import PROTOCOLS
from protocol.scenario import Motor

DRIVES: Final = len(AXES)
AXIS_NUMBERS: Final = tuple(range(DRIVES))


class Cause(enum.Enum):
    """Why a frame was rejected; the counters have these names."""

    FOREIGN = "foreign_frames"
    """from or to another node, or of another protocol"""
    UNKNOWN = "unknown_frames"
    """to or from one of our drives, but of an unknown message"""
    SHORT = "short_frames"
    """too few bytes for its message"""
    MALFORMED = "malformed_frames"
    """an invalid value: not a number, a wrong checksum, a wrong toggle bit"""


CAUSES: Final = tuple(cause.value for cause in Cause)


class Action(enum.Enum):
    """Request to a drive in a frame."""

    TORQUE = enum.auto()
    ENABLE = enum.auto()
    DISABLE = enum.auto()
    CLEAR = enum.auto()
    ESTOP = enum.auto()
    ASK = enum.auto()
    """request for a reading; `Order.detail` says which one, in the protocol's own terms"""
    NOTHING = enum.auto()
    """a known message without effect here"""


class Order(NamedTuple):
    """One order to one drive. torque: fraction of full scale, for TORQUE only. detail: defined by the protocol."""

    action: Action
    axis: int
    torque: float = 0.0
    detail: Any = None


class Fault(enum.IntFlag):
    """Why a drive is at its safe output; latched until cleared."""

    WATCHDOG = 1
    OVER_TEMPERATURE = 2
    ESTOP = 4


class Reading(NamedTuple):
    """Present state of a drive, as it reports it.

    position, velocity    output shaft, after the gear (rad, rad/s)      motor_position   motor shaft, before it (rad)
    target, torque        commanded and present motor torque, fractions of full scale
    temperature_celsius   of the motor                                   enabled          torque follows commands
    faults                latched
    """

    position: float = 0.0
    velocity: float = 0.0
    motor_position: float = 0.0
    target: float = 0.0
    torque: float = 0.0
    temperature_celsius: float = 0.0
    enabled: bool = False
    faults: Fault = Fault(0)


class Status(NamedTuple):
    """What one frame tells a host about one drive; None: not contained in the frame."""

    axis: int
    position: float | None = None
    velocity: float | None = None
    torque: float | None = None
    temperature_celsius: float | None = None
    enabled: bool | None = None
    faulty: bool | None = None


class Traffic(NamedTuple):
    """Frames of one kind on the bus: number, length in bytes, rate.

    can_id   of the first; each further one has an identifier higher by `step`. Lower identifiers have priority.
    command  whether these frames carry the torques
    """

    name: str
    can_id: int
    length: int
    rate_hz: float
    number: int = DRIVES
    extended: bool = False
    step: int = 1
    command: bool = False

    @property
    def bits(self) -> int:
        """Bits of one frame at worst stuffing."""
        return worst_bits(self.length, extended=self.extended)


class Host(abc.ABC):
    """The commanding end of a protocol, for six drives."""

    def __init__(self, motor: Motor) -> None:
        self.motor = motor

    @abc.abstractmethod
    def enable(self, axes: Sequence[int] = AXIS_NUMBERS) -> list[CanFrame]:
        """The frames that clear errors and enable the drives of these axes.

        Where a protocol cannot address single drives they go to all, and must not disturb a drive that is already enabled.
        """

    @abc.abstractmethod
    def disable(self) -> list[CanFrame]:
        """The frames that disable all drives."""

    @abc.abstractmethod
    def command(self, torque: FloatArray) -> list[CanFrame]:
        """The frames that carry torque (6,), fractions of full scale."""

    def cyclic(self, t_ns: int) -> list[CanFrame]:
        """Cyclic frames of the host due at t_ns, independent of commands; most protocols have none."""
        return []

    @abc.abstractmethod
    def decode(self, frame: CanFrame) -> Sequence[Status] | Cause:
        """The states of drives in a frame from the bus, or why it was rejected."""


class Drive(abc.ABC):
    """The drives' end of a protocol: all six."""

    def __init__(self, motor: Motor) -> None:
        self.motor = motor

    @abc.abstractmethod
    def decode(self, frame: CanFrame) -> Sequence[Order] | Cause:
        """The orders in a frame from the bus, or why it was rejected."""

    @abc.abstractmethod
    def reply(self, order: Order, reading: Reading) -> Sequence[CanFrame]:
        """The drive's reply to an order, in protocols that have replies."""

    @abc.abstractmethod
    def cyclic(self, t_ns: int, readings: Sequence[Reading]) -> list[CanFrame]:
        """The cyclic messages of all drives due at t_ns."""

    @abc.abstractmethod
    def restart(self) -> None:
        """Restart the schedule of the cyclic messages, after a jump of the time that is passed to `cyclic`."""


def make_host(name: str, motor: Motor) -> Host:
    """The commanding end of a protocol. Raises UsageError for an unknown name."""
    host: Host = _module(name).Host(motor)
    return host


def make_drive(name: str, motor: Motor) -> Drive:
    """The drives' end of a protocol. Raises UsageError for an unknown name."""
    drive: Drive = _module(name).Drive(motor)
    return drive


def traffic(name: str, motor: Motor, rate_hz: float) -> list[Traffic]:
    """All traffic on the bus while torques are commanded at rate_hz. Raises UsageError for an unknown name."""
    kinds: Iterable[Traffic] = _module(name).traffic(motor, rate_hz)
    return list(kinds)


def _module(name: str) -> Any:
    if name not in PROTOCOLS:
        raise UsageError(f"there is no motor protocol {name}: choose {', '.join(PROTOCOLS)}")
    return importlib.import_module(PROTOCOLS[name])
