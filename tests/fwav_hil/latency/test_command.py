"""`fwav-hil latency`, as a user has it: a short study, the report of a run's folder, a link that is asked, wrong arguments."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from bridge.command_line import run_command
from bridge.endpoint import Endpoint
from bridge.latency.responder import respond
from bridge.latency.segments import CONTROLLER_FILE, EMULATOR_FILE, load_legs
from bridge.links.faults import DelayedLink
from bridge.links.link import counterpart, open_link
from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from bridge.timing.clock import MonotonicClock
from fwav_hil.cli import cli
from fwav_hil.latency import study
from fwav_hil.latency.analysis import LEGS, join_legs
from tests.fwav_hil.latency.rows import AGE_NS, save, stamps
from tests.fwav_hil.latency.test_histogram import read_hgrm
from tests.fwav_hil.test_run import assert_one_line, call, flying, processes_of, started, wait_until
from tests.loop import fly_both, scenario_of

SHOWN = {"count", "p50", "p90", "p99", "p999", "p9999", "max"}
PATIENCE_S = 45.0
LONG_PATIENCE_S = (
    120.0  # flight, probes, two simulations, ten histogram files and a plot, on a machine that others use too
)


def latency(*arguments: str | Path) -> int:
    return run_command(cli, "fwav-hil", ["latency", *map(str, arguments)])


@pytest.fixture(scope="module", autouse=True)
def compiled_kernels() -> None:
    """Have the kernels in the cache, so that no process of a test has to compile."""
    from fwav_hil.compile import compile_kernels

    compile_kernels(scenario_of("flapper"))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short flight of both ends in real time on memory links, with time stamps."""
    folder = tmp_path_factory.mktemp("flown")
    near, far = memory_pair()
    with near, far:
        ends = fly_both(scenario_of("flapper", duration_s=0.4), near, far, folder, clock="realtime", legs=True)
    assert isinstance(ends.emulator, dict), ends
    assert isinstance(ends.controller, dict), ends
    return folder


@pytest.fixture
def folder(flown: Path, tmp_path: Path) -> Path:
    """A copy of the flight, to be changed."""
    copy = tmp_path / "run"
    copy.mkdir()
    for file in flown.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    return copy


@pytest.mark.processes
@pytest.mark.timeout(150)
def test_a_study_gives_a_table_json_histograms_and_a_plot(tmp_path: Path) -> None:
    arguments = ("latency", "flapper", "--duration", "0.6", "--delay", "3ms", "--out", "run", "--json", "-")
    with started(*arguments, cwd=tmp_path) as running:
        said, shown = running.communicate(timeout=LONG_PATIENCE_S)
    assert running.returncode == 0, shown
    result = json.loads(said)
    assert "age: stamped -> applied" in shown
    assert "Traceback" not in shown
    assert result["mode"] == "closed_loop"
    assert list(result["legs_us"]) == list(LEGS)
    for name, figures in result["legs_us"].items():
        assert set(figures) == SHOWN
        assert 0 < figures["count"] <= 150, name
        assert figures["p50"] <= figures["p90"] <= figures["p99"] <= figures["max"]
    assert result["legs_us"]["age"]["p50"] >= 3000.0, "the delay is in it"
    assert result["legs_us"]["to_emulator"]["p50"] >= 3000.0, "and this is where"
    assert result["time_sync"]["held"] is True
    assert result["time_sync"]["answers"] >= 1
    assert result["losses"]["lost"] == result["losses"]["duplicate"] == result["losses"]["out_of_order"] == 0
    assert result["prediction"]["delay_s"] >= 0.003
    for which in ("rmse_run", "rmse_constant", "rmse_recorded"):
        assert all(error > 0.0 for error in result["prediction"][which].values())
    assert set(result["beside"]) == {"open_loop"}
    for path in result["files"].values():
        assert (tmp_path / path).exists(), path
    for name in LEGS:
        rows = read_hgrm(tmp_path / result["files"][f"{name}_hgrm"])
        assert rows[-1][2] == result["legs_us"][name]["count"]
    assert (tmp_path / result["files"]["plot"]).read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "run" / "latency.json").read_text()) == result
    assert not processes_of(tmp_path)

    again = call("latency", "flapper", "--duration", "0.6", "--out", "run", cwd=tmp_path)
    assert again.returncode == 6
    assert_one_line(again.stderr, "holds a run already")


@pytest.mark.processes
@pytest.mark.timeout(150)
def test_a_study_that_is_interrupted_keeps_what_it_has(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with started("latency", "flapper", "--duration", "60", "--out", folder, cwd=tmp_path) as study:
        wait_until(lambda: len(processes_of(tmp_path)) == 2 and flying(folder))
        os.killpg(study.pid, signal.SIGINT)  # as a terminal does on Ctrl-C
        said, errors = study.communicate(timeout=LONG_PATIENCE_S)
        assert study.returncode == 130
    assert_one_line(errors, "interrupted", str(folder))
    assert "age: stamped -> applied" in said, "what there is of it is reported"
    assert (folder / EMULATOR_FILE).exists()
    assert (folder / CONTROLLER_FILE).exists()
    assert not processes_of(tmp_path)


class TestInterruptedProbes:
    def test_the_run_before_them_can_be_reported_later(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        def stopped(_rate: float, _seconds: float, stop: StopFlag, _told: Any, *, against: bool) -> dict[str, Any]:
            stop.requested = True
            stop.check()
            return {}

        monkeypatch.setattr(StopFlag, "install", lambda _self: None)
        monkeypatch.setattr("fwav_hil.latency.study.closed_loop", lambda *_, **__: {})
        monkeypatch.setattr("fwav_hil.latency.study.beside", stopped)
        assert latency("flapper", "--out", tmp_path / "run") == 130
        assert_one_line(capsys.readouterr().err, f"fwav-hil latency --from {tmp_path / 'run'}")


class TestFromAFolder:
    @pytest.fixture(autouse=True)
    def histograms_of_the_age_alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Ten histogram files take the library seconds; all ten are looked at in the test of a study."""
        write = study.write_files
        monkeypatch.setattr(study, "write_files", lambda folder, found: write(folder, {"age": found["age"]}))

    def test_a_run_is_reported_again(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert latency("--from", folder, "--json", "-") == 0
        captured = capsys.readouterr()
        result = json.loads(captured.out)
        assert result["legs_us"]["age"]["count"] > 50
        assert result["legs_us"]["to_kernel"]["count"] == 0, "memory has no kernel to stamp"
        assert result["beside"] == {}
        assert "RMSE" in captured.err
        assert (folder / "latency.png").exists()

    def test_it_keeps_what_was_measured_beside_the_run(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        figures = {"count": 1, **dict.fromkeys(("p50", "p90", "p99", "p999", "p9999", "max"), 12.5)}
        beside = {"open_loop": {"from_due": figures, "from_sent": figures, "lost": 0}}
        (folder / "latency.json").write_text(json.dumps({"beside": beside}))
        assert latency("--from", folder) == 0
        assert json.loads((folder / "latency.json").read_text())["beside"] == beside
        assert "round trip, open loop" in capsys.readouterr().out

    def test_two_halves_of_two_machines(self, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        other = tmp_path / "other"
        other.mkdir()
        for name in ("controller.json", CONTROLLER_FILE):
            (folder / name).rename(other / name)
        assert latency("--from", folder, "--controller-from", other, "--json", tmp_path / "result.json") == 0
        result = json.loads((tmp_path / "result.json").read_text())
        assert result["legs_us"]["compute"]["count"] > 50
        assert set(result["time_sync"]) == {"offset_us", "offset_at_end_us", "bound_us", "answers"}
        assert "the controller's clock is ahead by" in capsys.readouterr().out

    def test_the_report_may_go_elsewhere_and_leaves_the_run_as_it_was(
        self, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """What the sentence about a folder that cannot be written to proposes."""
        assert latency("--from", folder) == 0
        before = {file.name: file.read_bytes() for file in folder.iterdir()}
        out = tmp_path / "report"
        assert latency("--from", folder, "--out", out) == 0
        assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
        assert {file.name for file in out.iterdir()} == {"latency.json", "latency.png", "latency_age.hgrm"}
        capsys.readouterr()
        assert latency("--from", folder, "--out", out) == 6
        assert_one_line(capsys.readouterr().err, "already holds a latency report")

    def test_known_stamps_come_out_as_they_are(self, folder: Path, tmp_path: Path) -> None:
        save(stamps(100), folder)
        assert latency("--from", folder, "--json", tmp_path / "result.json") == 0
        result = json.loads((tmp_path / "result.json").read_text())
        assert result["legs_us"]["age"]["max"] == (AGE_NS + 7 * 99) / 1e3
        assert result["prediction"]["delay_s"] == 0.00025
        assert read_hgrm(folder / "latency_age.hgrm")[-1][2] == 100

    @pytest.mark.parametrize("file", [EMULATOR_FILE, CONTROLLER_FILE])
    def test_a_run_without_stamps_says_how_to_get_them(
        self, file: str, folder: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (folder / file).unlink()
        assert latency("--from", folder) == 6
        assert_one_line(capsys.readouterr().err, file, "--legs")

    def test_damaged_stamps_are_one_sentence(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        path = folder / EMULATOR_FILE
        path.write_bytes(path.read_bytes()[:2000])
        assert latency("--from", folder) == 6
        error = capsys.readouterr().err
        assert_one_line(error, "damaged", str(path))
        assert error.count("\n") == 1

    def test_an_empty_folder_is_one_sentence(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert latency("--from", tmp_path) == 6
        assert_one_line(capsys.readouterr().err, "--legs")


class TestWrongArguments:
    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["--controller-from", "."], ["--controller-from", "--from"]),
            (["--from", ".", "--against"], ["--against has no effect"]),
            (["--from", ".", "flapper"], ["SCENARIO has no effect"]),
            (["--from", ".", "--delay", "5ms"], ["--delay has no effect"]),
            (["--link", "udpout://127.0.0.1:9", "--law", "pd"], ["--law has no effect"]),
            (["--link", "udpout://127.0.0.1:9", "--delay", "1ms"], ["--delay has no effect"]),
            (["--link", "udpout://127.0.0.1:9", "--rate", "0"], ["0 TIMESYNC requests a second", "--rate"]),
            (["--link", "udpout://127.0.0.1:9", "--rate", "-5"], ["--rate"]),
            (["--link", "udpout://127.0.0.1:9", "--rate", "nan"], ["--rate"]),
            (["--link", "udpout://127.0.0.1:9", "--rate", "inf"], ["--rate"]),
            (["--link", "udpout://127.0.0.1:9", "--duration", "0"], ["--duration"]),
            (["--link", "udpout://127.0.0.1:9", "--duration", "inf"], ["--duration"]),
            (["--link", "nonsense"], ["nonsense", "is not a link URI"]),
            (["--link", "udpin://"], ["the port is missing"]),
            (["--delay", "5"], ["5ms"]),
            (["--delay", "2s"], ["longer than a second"]),
            (["--law", "ude_state"], ["velocit"]),
            (["--rate", "0"], ["rate_hz"]),
            (["--duration", "-1"], ["duration_s"]),
            (["nobody"], ["no scenario nobody"]),
            (["--from", "nowhere"], ["nowhere"]),
        ],
        ids=lambda value: " ".join(value) if value[0].startswith("-") else None,
    )
    def test_each_is_one_sentence_and_leaves_nothing_behind(
        self,
        arguments: list[str],
        words: list[str],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.chdir(tmp_path)
        assert latency(*arguments) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert_one_line(captured.err, *words)
        assert captured.err.count("\n") == 1
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.processes
    def test_a_taken_port_is_named(self, tmp_path: Path) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("127.0.0.1", 0))
            link = f"udpin://127.0.0.1:{taken.getsockname()[1]}"
            done = call("latency", "--link", link, "--duration", "1", "--out", "run", cwd=tmp_path)
        assert done.returncode == 3
        assert_one_line(done.stderr, "is taken")

    @pytest.mark.parametrize(
        "arguments",
        [
            ["run", "--delay", "5ms"],
            ["run", "--legs"],
            ["emulator", "--delay", "5ms"],
            ["emulator", "--legs", "--out", "run"],
            ["controller", "--legs", "--out", "run"],
            ["emulator", "--clock", "realtime", "--legs"],
            ["controller", "--clock", "realtime", "--legs"],
        ],
        ids=" ".join,
    )
    def test_time_stamps_and_delays_are_of_real_time_and_of_a_folder(
        self,
        arguments: list[str],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.setattr(StopFlag, "install", lambda _self: None)
        monkeypatch.chdir(tmp_path)
        assert run_command(cli, "fwav-hil", arguments) == 2
        remedy = "--out DIR" if "realtime" in arguments else "--clock realtime"
        assert_one_line(capsys.readouterr().err, remedy)
        assert list(tmp_path.iterdir()) == []


class TestARealLink:
    @pytest.fixture(autouse=True)
    def signals_stay_the_tests(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(StopFlag, "install", lambda _self: None)

    @pytest.fixture
    def autopilot(self) -> Iterator[str]:
        """Somebody who answers TIMESYNC; gives the link to them."""
        stop = StopFlag()
        with open_link("udpin://127.0.0.1:0") as link:
            thread = threading.Thread(target=respond, args=(Endpoint(link, 1, 1), stop))
            thread.start()
            yield counterpart(link.uri)
            stop.requested = True
            thread.join(PATIENCE_S)

    def test_an_autopilot_is_asked(self, autopilot: str, capsys: pytest.CaptureFixture[str]) -> None:
        assert latency("--link", autopilot, "--rate", "200", "--duration", "0.2", "--json", "-") == 0
        captured = capsys.readouterr()
        result = json.loads(captured.out)
        assert result["mode"] == "time_sync"
        assert set(result["round_trip_us"]) == set(result["from_sent_us"]) == SHOWN
        assert result["round_trip_us"]["count"] == 40
        assert [result[name] for name in ("lost", "duplicate", "out_of_order", "unknown")] == [0] * 4
        assert abs(result["clock_offset_us"]) <= result["clock_offset_bound_us"], "there is one clock on this machine"
        assert "TIMESYNC on" in captured.err

    def test_nobody_there_is_said(self, capsys: pytest.CaptureFixture[str]) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
            silent.bind(("127.0.0.1", 0))
            link = f"udpout://127.0.0.1:{silent.getsockname()[1]}"
            assert latency("--link", link, "--rate", "100", "--duration", "0.1") == 4
        assert_one_line(capsys.readouterr().err, "no answer", link, "10 TIMESYNC requests")

    def test_a_line_that_gives_back_what_is_sent_is_nobody(self, capsys: pytest.CaptureFixture[str]) -> None:
        master, slave = pty.openpty()
        tty.setraw(slave)
        stop = threading.Event()

        def give_back() -> None:
            while not stop.is_set():
                os.write(master, os.read(master, 4096))

        thread = threading.Thread(target=give_back, daemon=True)
        thread.start()
        try:
            assert latency("--link", f"serial://{os.ttyname(slave)}:115200", "--rate", "100", "--duration", "0.1") == 4
        finally:
            stop.set()
            os.write(slave, b"end")
            thread.join(PATIENCE_S)
            os.close(slave)
            os.close(master)
        assert_one_line(capsys.readouterr().err, "no answer")

    def test_no_such_device_is_said(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert latency("--link", "serial:///dev/no-such-line:57600") == 3
        assert_one_line(capsys.readouterr().err, "/dev/no-such-line")


class TestTimeSyncInRealTime:
    def test_both_ends_ask_and_answer(self, flown: Path) -> None:
        for file, tables in ((EMULATOR_FILE, ("ticks", "answers")), (CONTROLLER_FILE, ("samples",))):
            _, clock = load_legs(flown / file, *tables)
            assert clock is not None, file
            assert clock.answers >= 1
            assert abs(clock.offset_ns) <= clock.error_ns, "both ends have the one clock of this machine"

    def test_the_joined_legs_add_up(self, flown: Path) -> None:
        legs = join_legs(flown)
        assert len(legs.t_ns) > 50
        whole = legs.durations_ns["age"]
        parts = sum(legs.durations_ns[name] for name in ("compute", "hand_over", "apply"))
        assert (whole >= parts).all()
        assert legs.negative == 0

    def test_a_delay_is_seen_where_it_is(self, tmp_path: Path) -> None:
        near, far = memory_pair()
        with near, far:
            delayed = DelayedLink(near, 2_000_000, MonotonicClock())
            scenario = scenario_of("flapper", duration_s=0.2)
            ends = fly_both(scenario, delayed, far, tmp_path, clock="realtime", legs=True)
        assert isinstance(ends.emulator, dict), ends
        legs = join_legs(tmp_path)
        assert len(legs.t_ns) > 10
        assert legs.known("age").min() >= 2_000_000
        assert legs.delay_ns.min() >= 1_900_000, "the plant gets it as late"
        assert legs.clock is not None
        assert abs(legs.clock.offset_ns) <= legs.clock.error_ns
