"""What every CAN motor protocol does: torque commands for six axes into frames, frames into orders and readings.

A protocol is one file with a `Host` (the commanding end), a `Drive` (the six drives) and a `traffic` list, and one line in
PROTOCOLS. Neither end does any I/O or asks for the time. Torques are fractions of full scale here (1 is `actuators.scale`
of the axis), angles rad at the shaft; what a protocol makes of them stands in its file.

A frame that cannot be taken is no exception but a cause, one of CAUSES, for the caller to count.
"""

from __future__ import annotations

import abc
import enum
import importlib
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from protocol.can_frame import CanFrame, worst_bits
from protocol.errors import UsageError
from protocol.messages import AXES, FloatArray
from protocol.scenario import Motor

DRIVES: Final = len(AXES)
AXIS_NUMBERS: Final = tuple(range(DRIVES))


class Cause(enum.Enum):
    """Why a frame was not taken: `counters` are named after these."""

    FOREIGN = "foreign_frames"
    """of somebody else on the bus: another protocol, another node"""
    UNKNOWN = "unknown_frames"
    """to or from one of our drives, but of no message known here"""
    SHORT = "short_frames"
    """too few bytes for its message"""
    MALFORMED = "malformed_frames"
    """a value that cannot be: not a number, a wrong checksum, a toggle out of turn"""


CAUSES: Final = tuple(cause.value for cause in Cause)


class Action(enum.Enum):
    """What a frame asks of a drive."""

    TORQUE = enum.auto()
    ENABLE = enum.auto()
    DISABLE = enum.auto()
    CLEAR = enum.auto()
    ESTOP = enum.auto()
    ASK = enum.auto()
    """a reading; `Order.detail` says which, in the protocol's own terms"""
    NOTHING = enum.auto()
    """a message that was understood and changes nothing here"""


class Order(NamedTuple):
    """One order to one drive. torque: fraction of full scale, for TORQUE only. detail: the protocol's own."""

    action: Action
    axis: int
    torque: float = 0.0
    detail: Any = None


class Fault(enum.IntFlag):
    """Why a drive gives its safe output; latched until cleared."""

    WATCHDOG = 1
    OVER_TEMPERATURE = 2
    ESTOP = 4


class Reading(NamedTuple):
    """A drive as it shows itself.

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
    """What a host learns of one drive from one frame; None: the frame does not say."""

    axis: int
    position: float | None = None
    velocity: float | None = None
    torque: float | None = None
    temperature_celsius: float | None = None
    enabled: bool | None = None
    faulty: bool | None = None


class Traffic(NamedTuple):
    """Frames of one kind on the bus: how many, of how many bytes, how often.

    can_id   of the first; each further one has an identifier higher by `step`. Identifiers decide who waits for whom.
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
        """The frames that clear errors and make the drives of these axes follow torque commands.

        Where a protocol cannot tell them apart they go to all, which must then not disturb a drive that follows already.
        """

    @abc.abstractmethod
    def disable(self) -> list[CanFrame]:
        """The frames that make all drives let go."""

    @abc.abstractmethod
    def command(self, torque: FloatArray) -> list[CanFrame]:
        """The frames that carry torque (6,), fractions of full scale."""

    def cyclic(self, t_ns: int) -> list[CanFrame]:
        """What a host says at t_ns whatever it commands; most protocols have no such thing."""
        return []

    @abc.abstractmethod
    def decode(self, frame: CanFrame) -> Sequence[Status] | Cause:
        """What a frame from the bus says of the drives, or why it was not taken."""


class Drive(abc.ABC):
    """The drives' end of a protocol: all six."""

    def __init__(self, motor: Motor) -> None:
        self.motor = motor

    @abc.abstractmethod
    def decode(self, frame: CanFrame) -> Sequence[Order] | Cause:
        """The orders in a frame from the bus, or why it was not taken."""

    @abc.abstractmethod
    def reply(self, order: Order, reading: Reading) -> Sequence[CanFrame]:
        """What the drive of that order says to it, if the protocol has it answer."""

    @abc.abstractmethod
    def cyclic(self, t_ns: int, readings: Sequence[Reading]) -> list[CanFrame]:
        """The cyclic messages of all drives due at t_ns."""

    @abc.abstractmethod
    def restart(self) -> None:
        """Begin the schedule of the cyclic messages anew: the time that `cyclic` is asked with has changed."""


PROTOCOLS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "odrive": "protocol.motors.odrive",
        "mit": "protocol.motors.mit",
        "dronecan": "protocol.motors.dronecan_esc",
    }
)
"""Name -> module with `Host`, `Drive` and `traffic(motor, rate_hz)`. Imported when first asked for."""


def make_host(name: str, motor: Motor) -> Host:
    """The commanding end of a protocol. Raises UsageError for a name that is none."""
    host: Host = _module(name).Host(motor)
    return host


def make_drive(name: str, motor: Motor) -> Drive:
    """The drives' end of a protocol. Raises UsageError for a name that is none."""
    drive: Drive = _module(name).Drive(motor)
    return drive


def traffic(name: str, motor: Motor, rate_hz: float) -> list[Traffic]:
    """All that goes over the bus while torques are commanded at rate_hz. Raises UsageError for a name that is none."""
    kinds: Iterable[Traffic] = _module(name).traffic(motor, rate_hz)
    return list(kinds)


def _module(name: str) -> Any:
    if name not in PROTOCOLS:
        raise UsageError(f"there is no motor protocol {name}: choose {', '.join(PROTOCOLS)}")
    return importlib.import_module(PROTOCOLS[name])
