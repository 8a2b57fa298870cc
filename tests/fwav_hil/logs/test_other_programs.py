"""A run's log in the hands of other programs: pymavlink's tools, and MAVProxy where it is installed."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from bridge.command_line import run_command
from bridge.timing.clock import MonotonicClock
from fwav_hil.cli import cli
from protocol.logs.dialect import layouts
from protocol.logs.scan import Scan, scan_tlog
from tests.bridge.recording.test_thread_recorder import wait_until
from tests.fwav_hil.replay.conftest import run_folder
from tests.fwav_hil.test_record import free_port

__all__ = ["run_folder"]


def frames_of(scan: Scan, system: int = 1) -> list[bytes]:
    return [scan.raw(row) for row in range(len(scan)) if scan.frames["system"][row] == system]


def tool(name: str, *arguments: str | Path) -> str:
    command = [sys.executable, "-m", f"pymavlink.tools.{name}", *map(str, arguments)]
    environment = {**os.environ, "MAVLINK20": "1"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout


def test_mavloss_finds_every_packet_of_both_ends_and_none_lost(run_folder: Path) -> None:
    frames = scan_tlog(run_folder / "run.tlog").frames
    counts = Counter(frames["component"].tolist())
    said = tool("mavloss", run_folder / "run.tlog")
    rows = {
        int(c): (int(n), int(lost)) for c, n, lost in re.findall(r"^\s+1\s+(\d+)\s+(\d+)\s+(\d+)\s", said, re.MULTILINE)
    }
    assert rows == {component: (count, 0) for component, count in counts.items()}
    assert f"Total: {len(frames)} packets, 0 lost" in said


def test_mavlogdump_writes_the_same_frames_again(run_folder: Path, tmp_path: Path) -> None:
    tool("mavlogdump", "-q", "-o", tmp_path / "again.tlog", run_folder / "run.tlog")
    ours, again = scan_tlog(run_folder / "run.tlog"), scan_tlog(tmp_path / "again.tlog")
    assert frames_of(again) == frames_of(ours)
    # It keeps times as floating point seconds and cuts them off: a microsecond may be missing.
    assert abs(again.frames["stamp_us"] - ours.frames["stamp_us"]).max() <= 1


def test_mavproxy_records_what_is_replayed_to_it(run_folder: Path, tmp_path: Path) -> None:
    program = shutil.which("mavproxy.py")
    if program is None:
        pytest.skip(
            "MAVProxy is not installed here: `pip install mavproxy` in an environment on PATH, and this is tested"
        )
    port = free_port()
    command = [program, f"--master=udpin:127.0.0.1:{port}", "--non-interactive", "--daemon", "--default-modules=log"]
    command += [f"--state-basedir={tmp_path}", f"--logfile={tmp_path / 'mav.tlog'}"]
    environment = {**os.environ, "MAVLINK20": "1", "HOME": str(tmp_path), "PYTHONUNBUFFERED": "1"}
    ours = scan_tlog(run_folder / "run.tlog")
    with (
        (tmp_path / "said").open("w") as said,
        subprocess.Popen(command, env=environment, cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=said) as process,
    ):
        try:
            wait_until(lambda: "Waiting for heartbeat" in (tmp_path / "said").read_text())
            handler = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
            assert run_command(cli, "fwav-hil", ["replay", str(run_folder), "--to", f"udpout://127.0.0.1:{port}"]) == 0
            signal.signal(signal.SIGINT, handler[0])
            signal.signal(signal.SIGTERM, handler[1])
            clock = MonotonicClock()
            clock.sleep_until_ns(clock.now_ns() + 2_000_000_000)  # it tells nobody what it has taken
            process.send_signal(signal.SIGINT)  # upon which it writes what it has kept back
            clock.sleep_until_ns(clock.now_ns() + 2_000_000_000)
        finally:
            process.kill()
    (log,) = tmp_path.rglob("mav.tlog")
    theirs = scan_tlog(log)
    assert frames_of(theirs) == frames_of(ours)
    assert {layouts()[n].name for n in theirs.frames["message_id"].tolist()} >= {"HIL_SENSOR", "HIL_ACTUATOR_CONTROLS"}
