"""Logs to read, and the command line to read them with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as widest

from bridge.command_line import run_command
from fwav_hil.cli import cli
from tests.protocol.logs.log_records import DAY_US, Record, mixed_records

COUNT = 50


class Ended(NamedTuple):
    """What a command left behind."""

    code: int
    out: str
    err: str


Shell = Callable[..., Ended]


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shell:
    """`fwav-hil log ...` in this process and in tmp_path, without a terminal; nothing about compiling is said."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr("fwav_hil.logs.choice.kernels_are_warm", lambda *_packages: True)

    def call(*arguments: str | Path) -> Ended:
        code = run_command(cli, "fwav-hil", ["log", *map(str, arguments)])
        return Ended(code, *capsys.readouterr())

    return call


def flight() -> list[Record]:
    """50 x two messages at 10 Hz and one with text, an array with NaN and a gap, from two components of a system."""
    emulator, controller = (widest.MAVLink(None, srcSystem=1, srcComponent=component) for component in (191, 1))
    records = []
    for row in range(COUNT):
        t_us = DAY_US + 100_000 * row + (1_000_000 if row >= 30 else 0)
        pose = widest.MAVLink_att_pos_mocap_message(t_us, [1, 0, 0.5, row], row * 0.1, 2, 3, [np.nan] + [0] * 20)
        controls = widest.MAVLink_hil_actuator_controls_message(t_us, [row / 64] * 16, 129, 1)
        for mav, message in ((emulator, pose), (controller, controls)):
            records.append(Record(t_us, bytes(message.pack(mav))))
            mav.seq = (mav.seq + 1) % 256
    text = widest.MAVLink_statustext_message(6, 'grüße, "du"'.encode())
    records.append(Record(records[-1].t_us + 1, bytes(text.pack(controller))))
    return records


@pytest.fixture
def flight_log(tmp_path: Path) -> Path:
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"".join(record.data for record in flight()))
    return path


@pytest.fixture
def mixed_log(tmp_path: Path) -> Path:
    """MAVLink 1 and 2, signed and not, three systems, 30 frames of an unknown message; 2 frames damaged, a tail cut."""
    records = mixed_records()
    data = [bytearray(record.data) for record in records]
    data[7][-1] ^= 1
    data[50][30] ^= 1
    path = tmp_path / "mixed.tlog"
    path.write_bytes(b"".join(data)[:-3])
    return path
