"""Runs of two real processes, as a user starts them, with all that may go wrong."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import socket
import subprocess
import sys
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

import fwav_hil.run
from bridge.timing.clock import MonotonicClock
from fwav_hil.options import RunOptions
from fwav_hil.simulate import simulate
from fwav_hil.studies.margin import budget_line
from plant_emulator.plant.truth import load_truth
from protocol.errors import FwavHilError
from tests.loop import scenario_of

pytestmark = [pytest.mark.processes, pytest.mark.timeout(150)]

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 45.0  # a bound against hanging, not a measure
FREE = "udpin://127.0.0.1:0"


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "fwav_hil", *map(str, arguments)]


def call(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*arguments), cwd=cwd, env=environment(), capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT)}


@contextmanager
def started(*arguments: str | Path, cwd: Path) -> Iterator[subprocess.Popen[str]]:
    """A command in a process group of its own, ended at the latest with the test."""
    process = subprocess.Popen(
        command(*arguments),
        cwd=cwd,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def processes_of(cwd: Path) -> dict[str, int]:
    """The processes of a run that was started in a folder: name -> process id."""
    listed = subprocess.run(["ps", "-ww", "-eo", "pid,args"], capture_output=True, text=True, check=True).stdout
    found = re.findall(r"^\s*(\d+) .* -m fwav_hil.jobs (\w+)$", listed, re.MULTILINE)
    return {name: int(pid) for pid, name in found if working_folder(pid) == cwd.resolve()}


def working_folder(pid: str) -> Path | None:
    """Of a process; None where it has ended."""
    try:
        return Path(f"/proc/{pid}/cwd").readlink()
    except (FileNotFoundError, ProcessLookupError, PermissionError):
        return None


def wait_until(condition: Any) -> None:
    """Look again and again, for as long as a slow machine may need."""
    clock = MonotonicClock()
    give_up_ns = clock.now_ns() + round(PATIENCE_S * 1e9)
    while not condition():
        assert clock.now_ns() < give_up_ns, "waited in vain"
        clock.sleep_until_ns(clock.now_ns() + 20_000_000)


def assert_one_line(text: str, *parts: str) -> None:
    """Standard error ends with one sentence that holds `parts`, and no traceback is anywhere in it."""
    assert "Traceback" not in text
    last = text.strip().splitlines()[-1]
    assert all(part in last for part in parts), text


@pytest.fixture(scope="module", autouse=True)
def compiled_kernels() -> None:
    """Have the kernels in the cache, so that no process of a test has to compile."""
    from fwav_hil.compile import compile_kernels

    compile_kernels(scenario_of("flapper"))


def test_two_runs_and_the_simulation_agree_to_the_byte(tmp_path: Path) -> None:
    for name in ("first", "second"):
        done = call("run", "flapper", "--duration", "2", "--link", FREE, "--out", name, "--no-plots", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    for file in ("run.tlog", "ground_truth.npy"):
        assert (tmp_path / "first" / file).read_bytes() == (tmp_path / "second" / file).read_bytes(), file
    truth, simulated = (
        load_truth(tmp_path / "first" / "ground_truth.npy"),
        simulate(scenario_of("flapper", duration_s=2.0)),
    )
    for field in ("q", "q_dot", "command", "tau", "u"):
        assert np.array_equal(truth[field], getattr(simulated, field)), field


@pytest.mark.parametrize("rate", [250, 500])
def test_flapper_tracks_within_its_bounds(rate: int, tmp_path: Path) -> None:
    done = call(
        "run", "flapper", "--rate", str(rate), "--link", FREE, "--json", "result.json", "--out", "run", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "result.json").read_text())
    for key in ("scenario", "law", "clock", "rate_hz", "seed", "duration_s", "ticks", "ticks_per_s", "rmse", "mae",
                "latency_us", "counters", "files"):  # fmt: skip
        assert key in result
    assert result["ticks"] == 10 * rate
    assert set(result["latency_us"]) == {"p50", "p99", "p999", "max"}
    for axis, error in result["rmse"].items():
        angle = axis in ("alpha", "beta", "gamma")
        assert error < (np.radians(0.45) if angle else 5e-3), axis
        assert result["rmse_settled"][axis] < (np.radians(0.20) if angle else 1e-3), axis
    assert [result["counters"][name] for name in ("missed", "dropped", "refused")] == [0, 0, 0]
    for path in result["files"].values():
        assert (tmp_path / path).exists(), path
    budget = budget_line(scenario_of("flapper", rate_hz=float(rate)))
    assert done.stderr.count(budget.sentence) == 1
    assert "warning: delay budget" not in done.stderr
    assert result["budget"] == msgspec.to_builtins(budget)
    for plot in ("tracking", "error", "command", "hysteresis"):
        assert (tmp_path / "run" / f"{plot}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("quiet", [False, True])
def test_a_budget_that_is_all_but_used_up_is_a_warning_before_anything_flies(
    quiet: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class NoFlightError(FwavHilError):
        pass

    def refuse(*_: object) -> None:
        raise NoFlightError

    monkeypatch.setattr(fwav_hil.run, "Child", Mock())
    monkeypatch.setattr(fwav_hil.run, "_watch", refuse)
    monkeypatch.setattr("fwav_hil.run.StopFlag.install", lambda _: None)
    options = RunOptions(clock="realtime", show_progress=not quiet)
    with pytest.raises(NoFlightError):
        fwav_hil.run.run(scenario_of("paper", rate_hz=200.0), tmp_path, options)
    told = capsys.readouterr().err
    assert ("warning: delay budget (ude, 200 Hz): the gains are stable up to 3.38 ms" in told) != quiet
    assert ("unstable" in told) != quiet


def test_the_paper_s_run_is_stable_and_follows(tmp_path: Path) -> None:
    done = call("run", "paper", "--link", FREE, "--json", "result.json", "--no-plots", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["ticks"] == 10_000
    # The reference swings +-12.55 cm and +-.313 rad; it begins 10 cm away from the vehicle.
    for axis, error in result["rmse_settled"].items():
        assert error < 0.01, axis  # m, rad


def test_mavlogdump_reads_the_log(tmp_path: Path) -> None:
    done = call("run", "--duration", "0.4", "--link", FREE, "--out", "run", "--no-plots", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    tool = Path(sys.executable).with_name("mavlogdump.py")
    assert tool.exists(), "pymavlink brings this tool"
    dumped = subprocess.run(
        [sys.executable, tool, "--types", "HIL_SENSOR,HIL_ACTUATOR_CONTROLS", tmp_path / "run" / "run.tlog"],
        env=os.environ | {"MAVLINK20": "1"}, capture_output=True, text=True, timeout=PATIENCE_S, check=True,
    )  # fmt: skip
    assert dumped.stdout.count("HIL_SENSOR {") == 100
    assert dumped.stdout.count("HIL_ACTUATOR_CONTROLS {") == 100


def test_a_run_is_two_processes_and_a_tcp_link_serves_as_well(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    arguments = (
        "run",
        "--speed",
        "1",
        "--duration",
        "3",
        "--link",
        "tcpin://127.0.0.1:0",
        "--out",
        folder,
        "--no-plots",
    )
    with started(*arguments, cwd=tmp_path) as run:
        wait_until(lambda: len(processes_of(tmp_path)) == 2)
        pids = set(processes_of(tmp_path).values())
        assert len(pids | {run.pid}) == 3
        assert run.wait(PATIENCE_S) == 0
    assert not processes_of(tmp_path)


def test_real_time_follows_too(tmp_path: Path) -> None:
    done = call("run", "--clock", "realtime", "--rate", "100", "--duration", "1.5", "--link", FREE,
                    "--json", "result.json", "--no-plots", cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["clock"] == "realtime"
    assert result["ticks"] == 150
    assert result["latency_us"]["p50"] is not None


def test_a_taken_port_is_one_sentence(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        link = f"udpin://127.0.0.1:{taken.getsockname()[1]}"
        done = call("run", "--link", link, "--out", "run", cwd=tmp_path)
    assert done.returncode == 3
    assert_one_line(done.stderr, "taken", str(link.rpartition(":")[2]))
    assert not processes_of(tmp_path)
    assert (tmp_path / "run" / "scenario.toml").exists()


@pytest.mark.parametrize(
    ("end", "link", "part"),
    [
        ("emulator", "udpin://127.0.0.1:0", "no controller connected"),
        ("controller", "udpout://127.0.0.1:9", "no emulator"),
    ],
)
def test_a_missing_peer_is_one_sentence(end: str, link: str, part: str, tmp_path: Path) -> None:
    done = call(end, "flapper", "--link", link, "--wait", "0.5", cwd=tmp_path)
    assert done.returncode == 4
    assert_one_line(done.stderr, part, "--wait")


def test_a_divergence_is_one_sentence_and_the_log_goes_up_to_it(tmp_path: Path) -> None:
    late = (ROOT / "scenarios" / "flapper.toml").read_text().replace("samples = 1", "samples = 6")  # 29 ms: too much
    (tmp_path / "late.toml").write_text(late)
    done = call("run", "late.toml", "--link", FREE, "--out", "run", "--no-plots", cwd=tmp_path)
    assert done.returncode == 5
    assert_one_line(done.stderr, "diverged")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert 0 < summary["ticks"] < 2500
    assert "diverged" in summary["error"]
    assert len(load_truth(tmp_path / "run" / "ground_truth.npy")) == summary["ticks"]


@pytest.mark.parametrize("victim", ["plant_emulator", "controller"])
def test_a_killed_process_ends_the_run_and_leaves_no_orphan(victim: str, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    arguments = ("run", "--speed", "1", "--duration", "60", "--link", FREE, "--out", folder, "--no-plots")
    with started(*arguments, cwd=tmp_path) as run:
        wait_until(lambda: (folder / "run.tlog").exists() and len(processes_of(tmp_path)) == 2 and flying(folder))
        os.kill(processes_of(tmp_path)[victim], signal.SIGKILL)
        _, errors = run.communicate(timeout=PATIENCE_S)
        assert run.returncode not in (0, None)
    assert_one_line(errors, victim.replace("_", " "), "signal 9")
    assert not processes_of(tmp_path)
    assert (folder / "run.tlog").stat().st_size > 0
    assert (folder / "scenario.toml").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_keeps_what_it_recorded(number: signal.Signals, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    arguments = ("run", "--speed", "1", "--duration", "60", "--link", FREE, "--out", folder, "--no-plots")
    with started(*arguments, cwd=tmp_path) as run:
        wait_until(lambda: len(processes_of(tmp_path)) == 2 and flying(folder))
        if number == signal.SIGINT:
            os.killpg(run.pid, number)  # as a terminal does on Ctrl-C
        else:
            run.send_signal(number)
        _, errors = run.communicate(timeout=PATIENCE_S)
        assert run.returncode == 130
    assert_one_line(errors, "interrupted", str(folder))
    assert not processes_of(tmp_path)
    summary = json.loads((folder / "summary.json").read_text())
    assert len(load_truth(folder / "ground_truth.npy")) == summary["ticks"] > 0


def test_the_processes_end_with_a_run_that_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    arguments = ("run", "--speed", "1", "--duration", "60", "--link", FREE, "--out", folder, "--no-plots")
    with started(*arguments, cwd=tmp_path) as run:
        wait_until(lambda: len(processes_of(tmp_path)) == 2 and flying(folder))
        run.kill()
        run.wait(PATIENCE_S)
        wait_until(lambda: not processes_of(tmp_path))


def flying(folder: Path) -> bool:
    """Whether the run has come so far that its log has been written to."""
    log = folder / "run.tlog"
    return log.exists() and log.stat().st_size > 0


def test_both_ends_start_alone_as_the_readme_says(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    emulator_arguments = (
        "emulator",
        "flapper",
        "--duration",
        "1",
        "--link",
        f"udpin://127.0.0.1:{port}",
        "--out",
        "run",
    )
    with started(*emulator_arguments, cwd=tmp_path) as emulator:
        link = f"udpout://127.0.0.1:{port}"
        controller = call("controller", "flapper", "--link", link, "--law", "ude", "--rate", "500", cwd=tmp_path)
        _, errors = emulator.communicate(timeout=PATIENCE_S)
    assert (controller.returncode, emulator.returncode) == (0, 0), controller.stderr + errors
    assert len(load_truth(tmp_path / "run" / "ground_truth.npy")) == 250


def test_a_serial_line_carries_a_flight(tmp_path: Path) -> None:
    """Two pseudo-terminals and a pump between them stand for the cable."""
    masters, names = [], []
    for _ in range(2):
        master, slave = pty.openpty()
        tty.setraw(slave)
        masters.append(master)
        names.append(os.ttyname(slave))
    link = "serial://{}:921600"
    with started("emulator", "flapper", "--duration", "0.4", "--link", link.format(names[0]), "--out", "run",
                 cwd=tmp_path) as emulator, \
         started("controller", "flapper", "--link", link.format(names[1]), cwd=tmp_path) as controller:  # fmt: skip
        while emulator.poll() is None:
            for ready in select.select(masters, [], [], 0.1)[0]:
                os.write(masters[1 - masters.index(ready)], os.read(ready, 4096))
        assert emulator.returncode == 0, emulator.communicate()[1]
        controller.send_signal(signal.SIGTERM)  # its last goodbyes may be in the pump still
    assert np.array_equal(
        load_truth(tmp_path / "run" / "ground_truth.npy")["q"], simulate(scenario_of("flapper", duration_s=0.4)).q
    )


def test_a_real_time_run_with_everything_says_what_was_granted_and_refused(tmp_path: Path) -> None:
    options = ["--clock", "realtime", "--realtime", "--trigger", "clock", "--duration", "0.3", "--link", FREE]
    done = call("run", "flapper", *options, "--out", tmp_path / "run", "--json", "-", "--no-plots", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["trigger"] == "clock"
    for end in ("emulator", "controller"):
        settings = summary["realtime"][end]
        assert len(settings) == 6
        assert sum(summary["lateness_us"][end]["late_by"].values()) >= 50
        assert summary["processor_share"][end] > 0
        for setting in settings:
            assert setting["name"] in done.stderr, "the table tells it"
            assert setting["granted"] or setting["said"]
