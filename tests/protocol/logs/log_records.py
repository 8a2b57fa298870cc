"""Records of telemetry logs as other programs write them, made by pymavlink rather than by this project's codec."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as widest
from pymavlink.dialects.v20 import matrixpilot

DAY_US = 1_700_000_000_000_000
"""A stamp of a real day; simulation times begin at 0."""

KNOWN = sorted(widest.mavlink_map)
FOREIGN = (187, 188)
"""Messages of the matrixpilot dialect that no other has."""

CLASHING = 150
"""A number that matrixpilot uses for another message than ardupilotmega."""


class Record(NamedTuple):
    """A stamp and a frame."""

    t_us: int
    frame: bytes

    @property
    def data(self) -> bytes:
        return struct.pack(">Q", self.t_us) + self.frame


class Pen:
    """One sender's records, each `step_us` after the one before, with random content."""

    def __init__(self, dialect: Any = widest, *, system: int = 1, seed: int = 7, t_us: int = DAY_US) -> None:
        self._classes = dialect.mavlink_map
        self._mav = dialect.MAVLink(None, srcSystem=system, srcComponent=191)
        self._random = np.random.default_rng(seed)
        self.t_us = t_us

    def sign(self) -> None:
        """Sign from now on."""
        self._mav.signing.secret_key = bytes(range(32))
        self._mav.signing.link_id = 3
        self._mav.signing.sign_outgoing = True

    def record(self, number: int, *, step_us: int = 1000, version_1: bool = False) -> Record:
        """The next record, of message `number`; one byte in eleven of its payload is a first byte of frames."""
        kind = self._classes[number]
        payload = self._random.integers(0, 256, kind.unpacker.size)
        payload[self._random.random(len(payload)) < 1 / 11] = self._random.choice((0xFD, 0xFE))
        message = kind(*arguments(kind, payload.astype(np.uint8).tobytes()))
        frame = bytes(message.pack(self._mav, force_mavlink1=version_1))
        self._mav.seq = (self._mav.seq + 1) % 256
        self.t_us += step_us
        return Record(self.t_us, frame)


def arguments(kind: Any, payload: bytes) -> list[Any]:
    """Values for the constructor of a message of pymavlink, from a payload."""
    flat = list(kind.unpacker.unpack(payload))
    kinds = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    named: dict[str, Any] = {}
    for name, length in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True):
        take = length if length and kinds[name] != "char" else 1
        named[name] = flat[:take] if take > 1 or (length and kinds[name] != "char") else flat[0]
        del flat[:take]
    return [named[name] for name in kind.fieldnames]


def mixed_records(count: int = 120, seed: int = 7, t_us: int = DAY_US) -> list[Record]:
    """Records of MAVLink 1 and 2, signed and not, of known messages and of another dialect's, in turn."""
    plain, signed = Pen(seed=seed), Pen(system=2, seed=seed + 1)
    foreign = Pen(matrixpilot, system=3, seed=seed + 2)
    signed.sign()
    short = [number for number in KNOWN if number < 256]
    chance = np.random.default_rng(seed)
    records = []
    for row in range(count):
        if row % 4 == 0:
            made = foreign.record(FOREIGN[0])
        elif row % 4 == 1:
            made = plain.record(int(chance.choice(short)), version_1=True)
        elif row % 4 == 2:
            made = signed.record(int(chance.choice(KNOWN)))
        else:
            made = plain.record(int(chance.choice(KNOWN)))
        t_us += 1000
        records.append(Record(t_us, made.frame))
    return records
