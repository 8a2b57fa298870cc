"""Logs replayed to a link: what arrives, with what times and signatures, and what goes wrong."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common, matrixpilot

from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from bridge.timing.clock import VirtualClock
from bridge.timing.realtime import Setting
from fwav_hil.logs.choice import Choice, choose_frames, open_telemetry
from fwav_hil.replay.keyboard import Keyboard
from fwav_hil.replay.options import ReplayOptions
from fwav_hil.replay.to_link import Replay
from protocol.logs.tlog import read_tlog
from protocol.wire import mapping
from protocol.wire.codec import FrameReader
from tests.cases import case
from tests.fwav_hil.replay.conftest import Command
from tests.protocol.logs.log_records import CLASHING, FOREIGN, Pen

KEY = bytes(range(32))


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(0.5)
        yield opened


def uri_of(listener: socket.socket) -> str:
    return f"udpout://127.0.0.1:{listener.getsockname()[1]}"


def received(listener: socket.socket) -> list[bytes]:
    datagrams = []
    try:
        while True:
            datagrams.append(listener.recv(2048))
    except TimeoutError:
        return datagrams


def frames_of(folder: Path) -> list[bytes]:
    return [frame.raw for _, frame in read_tlog(folder / "run.tlog")]


class TestOverALink:
    def test_every_frame_arrives_as_it_was(
        self, fwav_hil: Command, run_folder: Path, listener: socket.socket, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert fwav_hil("replay", run_folder, "--to", uri_of(listener), "--json", "-") == 0
        assert received(listener) == frames_of(run_folder)
        result = json.loads(capsys.readouterr().out)
        assert result["frames"] == len(frames_of(run_folder))
        assert result["log_s"] == pytest.approx(0.4)
        assert result["wall_s"] >= 0.4
        assert 0 < result["speed_measured"] <= 1.0
        assert result["lateness_us"]["p50"] is not None

    def test_in_real_time_what_the_system_refuses_is_said(
        self, fwav_hil: Command, run_folder: Path, listener: socket.socket, capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:  # fmt: skip
        def refuse(*_: object) -> None:
            raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr(os, "sched_setscheduler", refuse)
        unlocked = Setting("memory locked", granted=False, said="not of a whole test run")
        monkeypatch.setattr("bridge.timing.realtime._lock_memory", lambda _: unlocked)
        options = ("--from", "0.3", "--realtime", "--json", "-")
        assert fwav_hil("replay", run_folder, "--to", uri_of(listener), *options) == 0
        said = capsys.readouterr()
        result = json.loads(said.out)
        scheduler, collector = (
            next(setting for setting in result["realtime"] if name in setting["name"])
            for name in ("SCHED_FIFO", "garbage")
        )
        assert (scheduler["granted"], collector["granted"]) == (False, True)
        assert "SCHED_FIFO, priority 80 refused: Operation not permitted" in said.err
        assert result["lateness_us"]["max"] >= result["lateness_us"]["p99"] >= result["lateness_us"]["p50"]
        assert received(listener)

    def test_a_part_of_it_as_fast_as_it_goes(
        self, fwav_hil: Command, run_folder: Path, listener: socket.socket
    ) -> None:
        options = ("--from", "0.1", "--to", "0.2", "--types", "HIL_SENSOR,att_pos_mocap", "--system", "1/191")
        assert fwav_hil("replay", run_folder, "--to", uri_of(listener), "--speed", "max", *options) == 0
        frames = [frame for data in received(listener) for frame in FrameReader(is_datagram=True).read(data)]
        ticks = [frame for frame in frames if frame.message_id == mapping.TICK.message_id]
        assert len(frames) == 2 * len(ticks) == 52
        times_ns = [mapping.decode_tick_time_ns(frame.payload) for frame in ticks]
        assert (times_ns[0], times_ns[-1]) == (100_000_000, 200_000_000)

    def test_signed_anew_pymavlink_believes_it(
        self, fwav_hil: Command, run_folder: Path, listener: socket.socket, tmp_path: Path
    ) -> None:
        (tmp_path / "key").write_text(KEY.hex())
        options = ("--speed", "max", "--signing-key", tmp_path / "key", "--rewrite-time")
        assert fwav_hil("replay", run_folder, "--to", uri_of(listener), *options) == 0
        reader = common.MAVLink(None)
        reader.signing.secret_key = KEY
        messages = [reader.parse_char(data) for data in received(listener)]
        assert len(messages) == len(frames_of(run_folder))
        assert all(message.get_type() != "BAD_DATA" for message in messages)

    def test_one_who_comes_to_a_waiting_port_gets_it(self, fwav_hil: Command, run_folder: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as chooser:
            port = chooser.getsockname()[1]
        arrived = bytearray()

        def come() -> None:
            for _ in range(200):
                with socket.socket() as client:
                    if client.connect_ex(("127.0.0.1", port)) == 0:
                        while data := client.recv(65536):
                            arrived.extend(data)
                        return
                threading.Event().wait(0.02)

        thread = threading.Thread(target=come)
        thread.start()
        assert fwav_hil("replay", run_folder, "--to", f"tcpin://127.0.0.1:{port}", "--speed", "max") == 0
        thread.join()
        assert bytes(arrived) == b"".join(frames_of(run_folder))


class TestOtherDialects:
    def test_frames_of_unknown_or_clashing_messages_are_never_changed(self, tmp_path: Path) -> None:
        """Their checksum's seed, and where a time would be, is not what our dialect says of that number."""
        pen, foreign = Pen(), Pen(matrixpilot)
        records = [pen.record(30) if n % 3 else foreign.record((*FOREIGN, CLASHING)[n // 3 % 3]) for n in range(90)]
        (tmp_path / "a.tlog").write_bytes(b"".join(record.data for record in records))
        log, scan = open_telemetry(tmp_path / "a.tlog")
        near, far = memory_pair()
        how = ReplayOptions(speed=None, rewrite_time=True, key=KEY)
        with near, far:
            replay = Replay(scan, choose_frames(log, scan, Choice()), near, how, VirtualClock(), StopFlag())
            counters = replay.run()["counters"]
            sent = [far.recv(0.0) for _ in records]
        assert [sent[n] for n in range(0, 90, 3)] == [records[n].frame for n in range(0, 90, 3)]
        assert (counters["signed"], counters["not_signed"]) == (60, 30)


class TestTrouble:
    def test_nobody_listening_is_told(
        self, fwav_hil: Command, run_folder: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("127.0.0.1", 0))
            port = taken.getsockname()[1]
        assert fwav_hil("replay", run_folder, "--to", f"udpout://127.0.0.1:{port}", "--speed", "100") == 4
        assert "nobody listens at udpout://" in capsys.readouterr().err

    @pytest.mark.parametrize("target", ["udpin://127.0.0.1:0", "tcpin://127.0.0.1:0"])
    def test_nobody_coming_is_told(
        self, fwav_hil: Command, run_folder: Path, target: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert fwav_hil("replay", run_folder, "--to", target, "--wait", "0.1") == 4
        assert "nobody came to" in capsys.readouterr().err

    def test_a_taken_port_is_told(
        self, fwav_hil: Command, run_folder: Path, listener: socket.socket, capsys: pytest.CaptureFixture[str]
    ) -> None:
        port = listener.getsockname()[1]
        assert fwav_hil("replay", run_folder, "--to", f"udpin://127.0.0.1:{port}") == 3
        assert f"port {port} on 127.0.0.1 is taken" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            ((), "give one target"),
            (("--to", "udpout://127.0.0.1:9", "--into", "controller"), "give one target"),
            (("--to", "udpout://127.0.0.1:9", "--to", "udpout://127.0.0.1:8"), "give one target"),
            (("--to", "udpout://127.0.0.1:9", "--speed", "0.05"), "0.05 is not a speed"),
            (("--to", "udpout://127.0.0.1:9", "--speed", "fast"), "fast is not a speed"),
            (("--to", "udpout://127.0.0.1:9", "--from", "noon"), "--from noon is no time"),
            (("--to", "udpout://127.0.0.1:9", "--from", "99"), "no time of"),
            (("--to", "udpout://127.0.0.1:9", "--system", "9"), "no frame of"),
            (("--to", "carrier://pigeon"), "is not a link URI"),
            (("--into", "controller", "--from", "2", "--loop"), "--from has no effect without --to"),
            (("--to", "udpout://127.0.0.1:9", "--fast", "--law", "pd"), "--law has no effect without --into"),
            (("--to", "udpout://127.0.0.1:9", "--from", "0.4", "--types", "HEARTBEAT", "--loop"), "--loop: all frames"),
            (("--into", "controller", "--realtime"), "--realtime applies only to a timed replay"),
            (
                ("--to", "udpout://127.0.0.1:9", "--realtime", "--speed", "max"),
                "--realtime applies only to a timed replay",
            ),
            (("--to", "udpout://127.0.0.1:9", "--signing-key", "nowhere"), "cannot read the signing key nowhere"),
        ],
    )
    def test_a_wrong_argument_is_one_sentence(
        self,
        fwav_hil: Command,
        run_folder: Path,
        arguments: tuple[str, ...],
        words: str,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        assert fwav_hil("replay", run_folder, *arguments) == 2
        said = capsys.readouterr().err.strip()
        assert words in said
        assert len(said.splitlines()) == 1

    def test_a_stop_ends_it_between_two_frames(
        self, fwav_hil: Command, run_folder: Path, listener: socket.socket, capsys: pytest.CaptureFixture[str]
    ) -> None:
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        assert fwav_hil("replay", run_folder, "--to", uri_of(listener), "--loop", "--json", "-") == 130
        said = capsys.readouterr()
        assert "interrupted after" in said.err
        result = json.loads(said.out)  # what was measured is told all the same
        assert result["interrupted"] is True
        assert result["lateness_us"]["p99"] is not None
        whole = set(frames_of(run_folder))
        assert all(frame in whole for frame in received(listener))


class TestLoop:
    def test_with_times_rewritten_they_never_run_back(self, run_folder: Path) -> None:
        log, scan = open_telemetry(run_folder)
        near, far = memory_pair()
        stop, clock, times = StopFlag(), VirtualClock(), list[int]()
        with near, far:
            chosen = choose_frames(log, scan, Choice(names=["HIL_SENSOR"]))
            how = ReplayOptions(speed=10.0, loop=True, rewrite_time=True)
            replay = Replay(scan, chosen, near, how, clock, stop)
            play = replay.player.play

            def stop_after_three(*, loop: bool) -> None:
                replay.player._look = lambda player: player.stop() if player.passes >= 3 else None
                play(loop=loop)

            replay.player.play = stop_after_three  # type: ignore[assignment, method-assign]
            result = replay.run()
            while data := far.recv(0.0):
                times.append(mapping.decode_tick_time_ns(data[10:-2]))
        assert result["passes"] >= 3
        assert len(times) >= 300
        assert (np.diff(times) > 0).all()
        assert result["log_s"] >= 3 * 0.396
        assert clock.now_ns() == pytest.approx(result["log_s"] * 1e9 / 10, rel=0.02)


class TestKeyboard:
    @pytest.fixture
    def terminal(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, Keyboard]]:
        ours, theirs = pty.openpty()
        with os.fdopen(theirs, "r") as file:
            monkeypatch.setattr("sys.stdin", file)
            monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
            with Keyboard() as keyboard:
                assert keyboard.active
                yield ours, keyboard
        os.close(ours)

    def test_keys_do_what_the_help_says(self, terminal: tuple[int, Keyboard]) -> None:
        ours, keyboard = terminal
        player = _Player()
        for keys, expected in (
            (b" ", ["hold"]),
            (b"nn", ["step", "step"]),
            (b"\x1b[C\x1b[D", ["seek 5.0", "seek -5.0"]),
            (b"\x1b[A", ["seek 60.0"]),
            (b"x\x1b[Z ", ["hold"]),
            (b"\x1b[", []),
            (b"Bq", ["seek -60.0", "stop"]),
            (b"\x1bOC\x1bOA", ["seek 5.0", "seek 60.0"]),
            (b"\x1b", []),  # escape alone means nothing, and takes nothing with it
            (b"q\x1bn", ["stop", "step"]),
        ):
            os.write(ours, keys)
            for _ in range(200):
                keyboard.attend(player)  # type: ignore[arg-type]
                if len(player.calls) >= len(expected):
                    break
                threading.Event().wait(0.005)
            assert player.calls == expected
            player.calls.clear()

    def test_without_a_terminal_there_is_none(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        (tmp_path / "in").write_text("q")
        with (tmp_path / "in").open() as file:
            monkeypatch.setattr("sys.stdin", file)
            with Keyboard() as keyboard:
                assert not keyboard.active
                player = _Player()
                keyboard.attend(player)  # type: ignore[arg-type]
                assert player.calls == []


class _Player:
    def __init__(self) -> None:
        self.calls: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *values: self.calls.append(" ".join([name, *map(str, values)]))


class TestWaits:
    """What is said of the log's clock before the first frame goes."""

    @staticmethod
    def said(log: Path, **options: Any) -> list[str]:
        opened, scan = open_telemetry(log)
        near, _ = memory_pair()
        how = ReplayOptions(**options)
        return Replay(scan, choose_frames(opened, scan, Choice()), near, how, VirtualClock(0), StopFlag()).waits()

    def test_a_clock_that_was_set_meanwhile(self) -> None:
        log = case("replay-clock-jump/in.tlog")
        (sentence,) = self.said(log)
        assert sentence == (
            "the log is silent for 53.9 years behind frame 100, through which the replay waits for 53.9 years: "
            "--max-gap 1 makes a second of each"
        )
        assert "waits for 196.8 days" in self.said(log, speed=100.0)[0]
        assert self.said(log, max_gap_s=1.0) == []
        assert self.said(log, speed=None) == []

    def test_a_clock_that_was_set_back(self, tmp_path: Path) -> None:
        pen = Pen()
        records = [pen.record(0) for _ in range(20)]
        moved = [record._replace(t_us=record.t_us - 10_800_000_000) for record in records[10:]]
        (tmp_path / "a.tlog").write_bytes(b"".join(record.data for record in [*records[:10], *moved]))
        (sentence,) = self.said(tmp_path / "a.tlog")
        assert sentence.startswith("the log's clock goes back by 3.0 hours behind frame 10: ")

    def test_nothing_is_said_of_a_log_without_jumps(self, tmp_path: Path) -> None:
        pen = Pen()
        (tmp_path / "a.tlog").write_bytes(b"".join(pen.record(0, step_us=9_000_000).data for _ in range(20)))
        assert self.said(tmp_path / "a.tlog") == []
