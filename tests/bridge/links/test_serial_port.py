"""Serial lines: the contract over two pseudo-terminals joined by a thread, and what is a line's own."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from bridge.links.link import open_link, parse_link_uri
from bridge.links.serial_port import SerialLink
from bridge.timing.clock import MonotonicClock
from protocol.errors import LinkClosedError, LinkError, LinkInUseError, LinkUriError
from tests.contracts.link_contract import PATIENCE_S, LinkContract, Pair, receive, receive_all


class Terminal:
    """A pseudo-terminal: `device` is what the link opens, `file` is the far end of the wire."""

    def __init__(self) -> None:
        self.file, self._near = os.openpty()
        tty.setraw(self._near)
        self.device = os.ttyname(self._near)

    def unplug(self) -> None:
        for name in ("file", "_near"):
            if getattr(self, name) >= 0:
                os.close(getattr(self, name))
            setattr(self, name, -1)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    made = Terminal()
    yield made
    made.unplug()


@pytest.fixture
def line(terminal: Terminal) -> Iterator[SerialLink]:
    with open_line(terminal) as link:
        yield link


def open_line(terminal: Terminal) -> SerialLink:
    link = open_link(f"serial://{terminal.device}:921600")
    assert isinstance(link, SerialLink)
    return link


@contextlib.contextmanager
def null_modem(first: Terminal, second: Terminal) -> Iterator[None]:
    """Carry bytes between the two until the block ends."""
    stop_reading, stop_writing = os.pipe()
    across = {first.file: second.file, second.file: first.file}

    def carry() -> None:
        while True:
            ready, _, _ = select.select([*across, stop_reading], [], [])
            if stop_reading in ready:
                return
            for file in ready:
                data = os.read(file, 1024)
                while data:
                    data = data[os.write(across[file], data) :]

    thread = threading.Thread(target=carry)
    thread.start()
    try:
        yield
    finally:
        os.write(stop_writing, b"x")
        thread.join(PATIENCE_S)
        os.close(stop_reading)
        os.close(stop_writing)
    assert not thread.is_alive()


class TestSerialContract(LinkContract):
    @pytest.fixture
    def pair(self, terminal: Terminal) -> Iterator[Pair]:
        other = Terminal()
        try:
            with null_modem(terminal, other), open_line(terminal) as first, open_line(other) as second:
                yield first, second
        finally:
            other.unplug()


def test_the_line_is_raw(terminal: Terminal, line: SerialLink) -> None:
    every_byte = bytes(range(256))
    line.send(every_byte)
    came = b""
    while len(came) < len(every_byte):
        came += os.read(terminal.file, 1024)
    assert came == every_byte
    os.write(terminal.file, every_byte)
    receive_all(line, [every_byte])


def test_all_that_is_there_is_returned(terminal: Terminal, line: SerialLink) -> None:
    os.write(terminal.file, b"first ")
    os.write(terminal.file, b"second")
    clock = MonotonicClock()
    give_up_ns = clock.now_ns() + 10_000_000_000  # the line discipline hands on in its own time
    while line._port.in_waiting < len(b"first second") and clock.now_ns() < give_up_ns:
        clock.sleep_until_ns(clock.now_ns() + 1_000_000)
    assert receive(line) == b"first second"


def test_the_device_names_the_peer(terminal: Terminal, line: SerialLink) -> None:
    assert line.peer == terminal.device


@pytest.mark.parametrize("agrees", [True, False])
def test_low_latency_is_asked_for(terminal: Terminal, monkeypatch: pytest.MonkeyPatch, agrees: bool) -> None:
    def answer(_: serial.Serial, wanted: bool) -> None:
        assert wanted
        if not agrees:
            raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")

    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", answer)
    with open_line(terminal) as link:
        assert link.low_latency is agrees


def test_a_taken_device_is_found_out(terminal: Terminal, line: SerialLink) -> None:
    with pytest.raises(LinkInUseError, match=f"{terminal.device} is taken: stop the other process.*--link"):
        open_line(terminal)


def test_a_closed_device_is_free_again(terminal: Terminal) -> None:
    open_line(terminal).close()
    open_line(terminal).close()


def test_no_such_device() -> None:
    with pytest.raises(LinkError, match="there is no device /dev/no-such-device: plug it in"):
        open_link("serial:///dev/no-such-device:921600")


def test_a_file_is_no_serial_line(tmp_path: Path) -> None:
    file = tmp_path / "plain"
    file.touch()
    with pytest.raises(LinkError, match=f"cannot open {file} as a serial line"):
        open_link(f"serial://{file}:921600")


def test_no_permission_is_named(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial, "Serial", refuse)  # for real only where the tests do not run as root
    with pytest.raises(LinkError, match=f"no permission for {terminal.device}: add the user to the group"):
        open_line(terminal)


def test_an_unknown_baud_rate_is_a_bad_uri(terminal: Terminal) -> None:
    uri = f"serial://{terminal.device}:{2**31}"
    with pytest.raises(LinkUriError, match=f"'{uri}' is not a link URI: .* does not support {2**31} baud"):
        open_link(uri)


def test_an_unplugged_device_ends_recv_and_send(terminal: Terminal, line: SerialLink) -> None:
    terminal.unplug()
    for timeout_s in (PATIENCE_S, 0):
        with pytest.raises(LinkClosedError, match=f"{terminal.device}.* closed the link"):
            line.recv(timeout_s)
    with pytest.raises(LinkClosedError, match="closed the link"):
        line.send(b"hello?")
    assert line.stats.send_failed == 1


def test_a_device_unplugged_within_the_wait_ends_it(terminal: Terminal, line: SerialLink) -> None:
    timer = threading.Timer(0.03, terminal.unplug)
    timer.start()
    try:
        with pytest.raises(LinkClosedError):
            line.recv(PATIENCE_S)
    finally:
        timer.join()


def test_a_line_that_takes_nothing_is_an_error_in_bounded_time(terminal: Terminal) -> None:
    uri = parse_link_uri(f"serial://{terminal.device}:921600")
    with SerialLink(uri, send_timeout_s=0.05) as line:
        with pytest.raises(LinkError, match=r"took \d+ of 1000000 bytes in 0.05 s"):
            line.send(bytes(1_000_000))
        assert (line.stats.sent, line.stats.send_failed) == (0, 1)
