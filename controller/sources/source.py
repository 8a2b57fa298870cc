"""Where pose samples come from: the interface of every source.

A source reads what its link delivers, frame by frame in the order on the wire, and stops at each new sample, so that frames
received before it are handled before it is answered. It reads positions and attitude angles, and no velocity.
"""

from __future__ import annotations

import abc
import enum

from protocol.messages import FloatArray
from protocol.wire.codec import Frame


class Found(enum.IntEnum):
    """Why a source stopped reading."""

    NOTHING = 0
    """all that was given has been read"""
    SAMPLE = 1
    """a new sample has arrived"""
    AGAIN = 2
    """the newest sample arrived again: its answer was lost"""
    OTHERS = 3
    """other frames have to be handled before it reads on"""


class PoseSource(abc.ABC):
    """Turns what a link delivers into pose samples.

    t_ns      time of the newest sample; -1 before the first
    q         (6,) its position (m, north east down) and attitude (rad); the next sample overwrites it
    is_read   whether all that was fed has been read
    others    frames of other messages since they were last collected: the caller handles them
    """

    t_ns: int = -1
    q: FloatArray

    def __init__(self) -> None:
        self.is_read = True
        self.others: list[Frame] = []

    @abc.abstractmethod
    def feed(self, data: bytes) -> None:
        """Accept the next bytes of the link: a datagram, or a chunk of a stream."""

    @abc.abstractmethod
    def read(self) -> Found:
        """Read on in what was fed, up to the next sample."""

    @abc.abstractmethod
    def counters(self) -> dict[str, int]:
        """The rejected frames, by cause."""
