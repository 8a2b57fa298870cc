"""Logs of a CAN bus replayed to a bus."""

from __future__ import annotations

import threading
from pathlib import Path

import can
import pytest

from bridge.motor_bus.can_bus import CanBus
from protocol.can_frame import CanFrame
from tests.fwav_hil.replay.conftest import Command, fwav_hil
from tests.protocol.logs.test_can_log import FRAMES, written

__all__ = ["fwav_hil"]


def test_every_frame_goes_to_the_bus_in_time(
    fwav_hil: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = [can.Message(timestamp=101.0, is_error_frame=True, channel=0)]
    written(tmp_path / "a.log", FRAMES + more)
    bus, heard = CanBus("virtual:replayed", 1_000_000), list[CanFrame]()

    def listen() -> None:
        while len(heard) < 4 and (frame := bus.recv(20.0)) is not None:
            heard.append(frame)

    thread = threading.Thread(target=listen)
    thread.start()
    assert fwav_hil("replay", "a.log", "--to", "can:virtual:replayed", "--speed", "10") == 0
    thread.join()
    bus.close()
    assert heard == [
        CanFrame(0x123, b"\x01\x02"), CanFrame(0x123, bytes(8), extended=True), CanFrame(0x7FF, remote=True), CanFrame(0x123),
    ]  # fmt: skip
    assert "4 frames, 1.0 s of log in 0." in (said := capsys.readouterr().out)
    assert "left out: 1 that no classical bus carries" in said


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("a.log", "--to", "can:virtual:x", "--types", "HEARTBEAT"), 2, "--types: of no effect on a log of a CAN bus"),
        (("a.log", "--to", "can:nowhere"), 2, "is not a CAN bus URI"),
        (("b.tlog", "--to", "can:virtual:x"), 6, "b.tlog is no log of a CAN bus"),
    ],
)
def test_trouble_is_one_sentence(
    fwav_hil: Command,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    code: int,
    words: str,
) -> None:
    written(tmp_path / "a.log")
    (tmp_path / "b.tlog").write_bytes(bytes(100))
    assert fwav_hil("replay", *arguments) == code
    said = capsys.readouterr().err.strip()
    assert words in said.splitlines()[-1]
    assert "Traceback" not in said
