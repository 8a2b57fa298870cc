"""`fwav-hil log dump`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import fwav_hil
from tests.fwav_hil.logs.conftest import COUNT, Shell, flight
from tests.protocol.logs.log_records import DAY_US, FOREIGN

ROOT = Path(str(fwav_hil.__file__)).resolve().parent.parent


def test_every_message_in_the_order_of_the_file(shell: Shell, flight_log: Path) -> None:
    ended = shell("dump", flight_log)
    assert (ended.code, ended.err) == (0, "")
    lines = ended.out.splitlines()
    assert len(lines) == 2 * COUNT + 1
    assert lines[2].startswith(
        f"0.100000 1.191 ATT_POS_MOCAP time_usec={DAY_US + 100_000}, q=[1, 0, 0.5, 1], x=0.1, y=2,"
    )
    assert lines[3].startswith("0.100000 1.1 HIL_ACTUATOR_CONTROLS ")
    assert 'text="grüße, \\"du\\""' in lines[-1]


def test_json_lines_hold_every_field(shell: Shell, flight_log: Path) -> None:
    first, *_, last = map(json.loads, shell("dump", flight_log, "--json").out.splitlines())
    assert (first["t_us"], first["type"], first["system"], first["component"]) == (DAY_US, "ATT_POS_MOCAP", 1, 191)
    assert first["fields"]["q"] == [1, 0, 0.5, 0]
    assert first["fields"]["covariance"] == [None] + [0] * 20  # JSON has no NaN
    assert last["fields"]["text"] == 'grüße, "du"'
    assert last["sequence"] == COUNT


@pytest.mark.parametrize(
    ("options", "count"),
    [
        (["--types", "ATT_POS_MOCAP"], COUNT),
        (["--types", "att_pos_mocap,STATUSTEXT"], COUNT + 1),
        (["--types", "ATT_POS_MOCAP", "--types", "STATUSTEXT"], COUNT + 1),
        (["--system", "1"], 2 * COUNT + 1),
        (["--system", "1/191"], COUNT),
        (["--system", "2"], 0),
        (["--from", "0.5", "--to", "0.9"], 10),
        (["--from", "22:13:20.5", "--to", "22:13:20.9"], 10),
        (["--to", "0"], 2),
        (["--from", "4.9", "--types", "ATT_POS_MOCAP"], 11),
    ],
)
def test_a_choice(shell: Shell, flight_log: Path, options: list[str], count: int) -> None:
    ended = shell("dump", flight_log, *options)
    assert (ended.code, len(ended.out.splitlines())) == (0, count)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--types", "ATT_POS"], "--types ATT_POS: {log} holds no such message; did you mean ATT_POS_MOCAP"),
        (["--from", "noon"], "--from noon is no time: write seconds since the log began, such as 12.5"),
        (["--from", "inf"], "--from inf is no time: "),
        (["--from", "3", "--to", "2"], "no time of {log} is left between --from and --to: it is 5.9"),
        (["--system", "1.1"], "--system 1.1 is no system: "),
        (["--system", "256"], "--system 256 is no system: "),
    ],
)
def test_a_choice_that_names_nothing(shell: Shell, flight_log: Path, options: list[str], sentence: str) -> None:
    ended = shell("dump", flight_log, *options)
    assert (ended.code, ended.out) == (2, "")
    assert ended.err.startswith("fwav-hil: " + sentence.format(log=flight_log))


def test_unknown_messages_are_shown_as_they_are(shell: Shell, mixed_log: Path) -> None:
    lines = shell("dump", mixed_log, "--types", f"UNKNOWN_{FOREIGN[0]}").out.splitlines()
    assert len(lines) == 30
    assert f' 3.191 UNKNOWN_{FOREIGN[0]} payload="' in lines[0]
    assert shell("dump", mixed_log).out.count("\n") == 117


def test_a_reader_that_leaves_ends_it_quietly(tmp_path: Path) -> None:
    # More than a pipe holds; in a process of its own, since it is the standard output that breaks.
    (tmp_path / "long.tlog").write_bytes(b"".join(record.data for record in flight()) * 40)
    command = [sys.executable, "-m", "fwav_hil", "log", "dump", str(tmp_path / "long.tlog"), "--types", "ATT_POS_MOCAP"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment) as process:
        assert process.stdout
        assert process.stderr
        assert b"ATT_POS_MOCAP" in process.stdout.readline()
        process.stdout.close()
        said = process.stderr.read()
        assert process.wait(timeout=60) == 0
    assert b"Traceback" not in said
    assert b"rror" not in said
