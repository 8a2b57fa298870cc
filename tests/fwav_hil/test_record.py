"""Recording live links: what is kept, what is counted, that nothing is sent, how it ends."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import fastcrc
import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from bridge.process import StopFlag
from bridge.recording.sidecar import link_numbers, read_sidecar
from bridge.timing.clock import unix_time_us
from fwav_hil.record import record
from protocol.errors import LinkError, PeerMissingError, RunFolderError
from protocol.logs.scan import scan_tlog
from tests.bridge.recording.test_thread_recorder import numbered, wait_until
from tests.cases import case
from tests.disk import small_disk
from tests.fwav_hil.replay.conftest import Command, fwav_hil

__all__ = ["fwav_hil"]

_BODY = b"\x01\x00\x00\x09\x01\x01\xff\xff\x7f\x07"  # a message that no dialect has: 8388607
UNKNOWN = b"\xfd" + _BODY + fastcrc.crc16.mcrf4xx(_BODY + b"\x4d").to_bytes(2, "little")
OLD = bytes(
    common.MAVLink_attitude_message(7_000, 0.25, 0, 0, 0, 0, 0).pack(common.MAVLink(None, 1, 1), force_mavlink1=True)
)


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as chooser:
        chooser.bind(("127.0.0.1", 0))
        return int(chooser.getsockname()[1])


class Recording:
    """`record` in a thread, until it has the frames that a test waits for."""

    def __init__(self, *uris: str, log: Path, goes_on: bool = False) -> None:
        self.log = log
        self.stop = StopFlag()
        self.result: dict[str, object] = {}
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(uris, goes_on))
        self._thread.start()

    def _run(self, uris: tuple[str, ...], goes_on: bool) -> None:
        try:
            self.result = record(uris, self.log, self.stop, wait_s=10.0, goes_on=goes_on)
        except (LinkError, PeerMissingError, RunFolderError) as error:
            self.error = error

    def end(self) -> None:
        self.stop.requested = True
        self._thread.join()

    def has(self, count: int) -> bool:
        return self.log.exists() and len(scan_tlog(self.log)) >= count


@contextmanager
def recording(*uris: str, log: Path, goes_on: bool = False) -> Iterator[Recording]:
    running = Recording(*uris, log=log, goes_on=goes_on)
    try:
        yield running
    finally:
        running.end()


def is_listening(port: int) -> bool:
    """Whether somebody has the UDP port: one that has nobody refuses, and says so at the next datagram."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", port))
        try:
            sender.send(b"")
            sender.send(b"")
        except ConnectionRefusedError:
            return False
    return True


def send_until(done: Callable[[], bool], port: int, datagrams: list[bytes]) -> None:
    """Send the datagrams once somebody listens at the port, then wait."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", port))

        wait_until(lambda: is_listening(port))
        for datagram in datagrams:
            sender.send(datagram)
        wait_until(done)
        sender.setblocking(False)
        with pytest.raises(BlockingIOError):
            sender.recv(100)  # the recorder has said nothing


class TestFrames:
    def test_every_frame_of_every_sender_is_kept_with_the_time_of_its_arrival(self, tmp_path: Path) -> None:
        port, log = free_port(), tmp_path / "a.tlog"
        frames = numbered(50)
        before_us = unix_time_us()
        with recording(f"udpin://127.0.0.1:{port}", log=log) as running:
            send_until(lambda: running.has(25), port, frames[:25])
            send_until(lambda: running.has(50), port, [b"".join(frames[25:])])  # another sender, one datagram
        scan = scan_tlog(log)
        assert [scan.raw(k) for k in range(len(scan))] == frames
        stamps = scan.frames["stamp_us"]
        assert before_us <= stamps[0] <= stamps[-1] <= unix_time_us()
        assert (np.diff(stamps) >= 0).all()
        assert len(set(stamps[25:].tolist())) == 1
        content = read_sidecar(log)
        assert (content["complete"], content["frames"], content["stamps"]) == (True, 50, "Unix time")
        assert content["links"][0]["peer"].count("127.0.0.1:") >= 2
        assert content["links"][0]["sent_by"] == []
        assert running.result["messages"] == {"HEARTBEAT": 50}

    def test_one_who_sends_nothing_but_an_empty_datagram_keeps_nobody_out(self, tmp_path: Path) -> None:
        port, log = free_port(), tmp_path / "a.tlog"
        with recording(f"udpin://127.0.0.1:{port}", log=log) as running:
            wait_until(lambda: is_listening(port))  # by empty datagrams of a socket of its own
            send_until(lambda: running.has(9), port, numbered(9))
        assert read_sidecar(log)["frames"] == 9

    def test_unknown_messages_and_mavlink_1_are_kept_and_damage_is_counted(self, tmp_path: Path) -> None:
        port, log = free_port(), tmp_path / "a.tlog"
        frame = numbered(1)[0]
        damaged = frame[:-1] + bytes([frame[-1] ^ 1])
        with recording(f"udpin://127.0.0.1:{port}", log=log) as running:
            send_until(lambda: running.has(4), port, [frame, UNKNOWN, OLD, damaged, OLD + frame])
            wait_until(lambda: running.has(5))
        scan = scan_tlog(log)
        assert [scan.raw(k) for k in range(len(scan))] == [frame, UNKNOWN, OLD, OLD, frame]
        assert running.result["messages"] == {"HEARTBEAT": 2, "ATTITUDE": 2, "UNKNOWN_8388607": 1}
        counters = read_sidecar(log)["counters"]["0"]
        assert (counters["bad_crc"], counters["mavlink1"], counters["unknown_message"]) == (1, 2, 1)

    @pytest.mark.parametrize("name", ["in", "unknown"])
    @pytest.mark.parametrize("stream", [False, True])
    def test_every_intact_frame_is_kept_whatever_its_message(self, tmp_path: Path, name: str, stream: bool) -> None:
        scan = scan_tlog(case(f"record-mavlink1-ardupilot/{name}.tlog"))
        frames, log = [scan.raw(row) for row in range(len(scan))], tmp_path / "a.tlog"
        assert len(frames) == {"in": 40, "unknown": 110}[name]
        if stream:
            with (
                socket.create_server(("127.0.0.1", 0)) as server,
                recording(f"tcpout://127.0.0.1:{server.getsockname()[1]}", log=log) as running,
            ):
                client, _ = server.accept()
                with client:
                    client.sendall(b"".join(frames))
                    wait_until(lambda: running.has(len(frames)))
        else:
            port = free_port()
            with recording(f"udpin://127.0.0.1:{port}", log=log) as running:
                send_until(lambda: running.has(len(frames)), port, frames)
        kept = scan_tlog(log)
        assert [kept.raw(row) for row in range(len(kept))] == frames
        assert read_sidecar(log)["lost"] == 0

    def test_what_the_system_drops_is_said(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fwav_hil: Command, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr("bridge.links.udp._UdpLink.dropped_by_system", lambda _: 7)
        assert fwav_hil("record", "--link", "udpin://127.0.0.1:0", "--out", "a.tlog", "--duration", "0.1") == 4
        said = "the system dropped 7 datagrams, which came faster than they were read"
        assert f"a.tlog: 0 frames in 0.1 s, 7 lost ({said})" in capsys.readouterr().out
        content = read_sidecar(tmp_path / "a.tlog")
        assert (content["complete"], content["lost"], content["error"]) == (False, 7, said)

    def test_two_links_in_one_log_are_told_apart(self, tmp_path: Path) -> None:
        ports, log = (free_port(), free_port()), tmp_path / "a.tlog"
        frames = [numbered(10), numbered(10, system=2)]
        with recording(*(f"udpin://127.0.0.1:{port}" for port in ports), log=log) as running:
            for k, port in enumerate(ports):
                send_until(lambda k=k: running.has(10 * (k + 1)), port, frames[k])  # type: ignore[misc]
        scan = scan_tlog(log)
        links = link_numbers(log, scan.frames["offset"] - 8)
        assert links.tolist() == [system - 1 for system in scan.frames["system"].tolist()]

    def test_frames_cut_by_a_stream_are_put_together(self, tmp_path: Path) -> None:
        log, frames = tmp_path / "a.tlog", [*numbered(20), OLD, *numbered(3)]
        data = b"".join(frames)
        with (
            socket.create_server(("127.0.0.1", 0)) as server,
            recording(f"tcpout://127.0.0.1:{server.getsockname()[1]}", log=log) as running,
        ):
            client, _ = server.accept()
            with client:
                for at in range(0, len(data), 7):
                    client.sendall(data[at : at + 7])
                wait_until(lambda: running.has(len(frames)))
            wait_until(lambda: running.error is not None)  # the other end has closed the link
        scan = scan_tlog(log)
        assert [scan.raw(k) for k in range(len(scan))] == frames
        assert read_sidecar(log)["complete"] is True
        assert isinstance(running.error, LinkError)


class TestEnd:
    def test_ctrl_c_ends_it_well(self, fwav_hil: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        port, log = free_port(), tmp_path / "a.tlog"

        def interrupt() -> None:
            running = Recording.__new__(Recording)
            running.log = log
            send_until(lambda: Recording.has(running, 5), port, numbered(5))
            os.kill(os.getpid(), signal.SIGINT)

        thread = threading.Thread(target=interrupt)
        thread.start()
        assert fwav_hil("record", "--link", f"udpin://127.0.0.1:{port}", "--out", log, "--json", "-") == 0
        thread.join()
        result = json.loads(capsys.readouterr().out)
        assert (result["frames"], result["lost"]) == (5, 0)
        assert read_sidecar(log)["complete"] is True

    def test_it_stops_by_itself_and_says_where_nothing_came(
        self, fwav_hil: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        uri = f"udpin://127.0.0.1:{free_port()}"
        assert fwav_hil("record", "--link", uri, "--out", "a.tlog", "--duration", "0.2") == 4
        said = capsys.readouterr()
        assert f"no frame came over {uri}" in said.err
        assert "a.tlog: 0 frames" in said.out
        # And nothing that is there is overwritten.
        assert fwav_hil("record", "--link", uri, "--out", "a.tlog", "--duration", "0.2") == 6
        assert "a.tlog exists and is not overwritten" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("arguments", "code", "words"),
        [
            (("--link", "udpin://127.0.0.1:0", "--out", "no/such/a.tlog"), 6, "cannot write the log no/such/a.tlog"),
            (("--link", "carrier://pigeon"), 2, "is not a link URI"),
            (("--link", "serial:///dev/nothing:57600"), 3, "/dev/nothing"),
            ((), 2, "--link"),
            (("--link", "udpin://127.0.0.1:0", "--duration", "0"), 2, "--duration"),
        ],
    )
    def test_trouble_is_one_sentence(
        self, arguments: tuple[str, ...], code: int, words: str, fwav_hil: Command, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert fwav_hil("record", *arguments) == code
        said = capsys.readouterr().err.strip()
        assert words in said.splitlines()[-1]
        assert "Traceback" not in said

    @pytest.mark.parametrize("goes_on", [False, True])
    def test_a_full_disk_ends_it_or_not_as_chosen(
        self, goes_on: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        port, log = free_port(), tmp_path / "a.tlog"
        with recording(f"udpin://127.0.0.1:{port}", log=log, goes_on=goes_on) as running:
            wait_until(lambda: read_sidecar(log) != {})
            with small_disk(1500):
                said = "File too large"
                told = (lambda: said in capsys.readouterr().err) if goes_on else (lambda: running.error is not None)
                send_until(told, port, [b"".join(numbered(400))])
        kept = len(scan_tlog(log))
        content = read_sidecar(log)
        if goes_on:
            assert kept == 400, "once there was room again"
            assert content["complete"] is True
            assert said in content["error"]
        else:
            assert isinstance(running.error, RunFolderError)
            assert said in str(running.error)
        assert kept == content["frames"]
