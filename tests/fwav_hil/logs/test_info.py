"""`fwav-hil log info`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bridge.recording.sidecar import LinkOfLog
from bridge.recording.thread_recorder import Recorder
from tests.fwav_hil.logs.conftest import COUNT, Shell, flight
from tests.protocol.logs.log_records import DAY_US, FOREIGN, Pen


def test_what_a_flight_holds(shell: Shell, flight_log: Path) -> None:
    ended = shell("info", flight_log, "--json", "-")
    assert ended.code == 0
    info = json.loads(ended.out)
    assert info["kind"] == "MAVLink telemetry log"
    assert info["messages"] == 2 * COUNT + 1
    assert info["start_s"] == DAY_US / 1e6
    assert info["duration_s"] == pytest.approx(5.9, abs=1e-5)
    assert info["bytes"] == flight_log.stat().st_size
    assert [(row["system"], row["component"], row["messages"]) for row in info["systems"]] == [(1, 1, 51), (1, 191, 50)]
    pose = next(row for row in info["types"] if row["name"] == "ATT_POS_MOCAP")
    assert (pose["count"], pose["gaps"], pose["longest_gap_s"], pose["interval_s"]) == (COUNT, 1, 1.1, 0.1)
    assert pose["rate_hz"] == pytest.approx(49 / 5.9)
    assert [row["name"] for row in info["types"]] == ["ATT_POS_MOCAP", "HIL_ACTUATOR_CONTROLS", "STATUSTEXT"]
    assert not any(value for value in info["damage"].values())
    assert "2023-11-14 22:13:20.000 UTC" in ended.err


def test_the_table_on_a_terminal_says_the_same(shell: Shell, flight_log: Path) -> None:
    ended = shell("info", flight_log)
    assert (ended.code, ended.err) == (0, "")
    assert "101 messages in 5.900 s" in ended.out
    assert "damage: none" in ended.out
    (row,) = (line for line in ended.out.splitlines() if "ATT_POS_MOCAP" in line)
    assert [cell.strip() for cell in row.split("│")[2:-1]] == ["1.191", "50", "8.305 Hz", "1", "1.1 s"]


def test_losses_are_counted_by_sender(shell: Shell, tmp_path: Path) -> None:
    records = flight()
    del records[20:26]  # three of each
    records[60], records[62] = records[62], records[60]  # a pair of the emulator's, the wrong way round
    (tmp_path / "lossy.tlog").write_bytes(b"".join(record.data for record in records))
    rows = json.loads(shell("info", "lossy.tlog", "--json", "-").out)["systems"]
    # What is late was counted as lost when the one after it came.
    assert [(row["component"], row["lost"], row["out_of_order"]) for row in rows] == [(1, 3, 0), (191, 4, 1)]


def test_damage_unknown_messages_versions_and_signatures(shell: Shell, mixed_log: Path) -> None:
    info = json.loads(shell("info", mixed_log, "--json", "-").out)
    assert info["messages"] == 117
    assert info["damage"]["crc_failures"] == 2
    assert info["damage"]["unknown_frames"] == 30
    assert info["damage"]["truncated_tail"] > 0
    assert len(info["damage"]["places"]) == 3
    by_system = {row["system"]: row for row in info["systems"]}
    assert by_system[1]["versions"] == [1, 2]
    assert by_system[2]["signed"] == by_system[2]["messages"]
    assert by_system[1]["signed"] == 0
    assert f"UNKNOWN_{FOREIGN[0]}" in {row["name"] for row in info["types"]}
    assert "crc_failures 2" in shell("info", mixed_log).out


def test_of_a_recording_the_links_the_directions_and_whether_it_is_whole(shell: Shell, tmp_path: Path) -> None:
    links = (LinkOfLog("udpin://a", "127.0.0.1:1", ((1, 191),)), LinkOfLog("serial://b"))
    with Recorder(tmp_path / "a.tlog", links, stamps="Unix time", source={"scenario": "flapper", "seed": 3}) as log:
        for row, record in enumerate(flight()):  # in turn of 1/191 and of 1/1
            log.write(record.t_us, record.frame, int(row >= 60))
        log.close()
        said = shell("info", "a.tlog", "--json", "-")
        recording = json.loads(said.out)["recording"]
        assert recording["links"] == [
            {"uri": "udpin://a", "peer": "127.0.0.1:1", "sent": 30, "received": 30},
            {"uri": "serial://b", "peer": "", "sent": 0, "received": 41},
        ]
        assert (recording["complete"], recording["lost"], recording["scenario"], recording["seed"]) == (
            True,
            0,
            "flapper",
            3,
        )
        assert "link udpin://a (127.0.0.1:1): 30 frames sent, 30 received" in said.err
        assert "of flapper, complete; stamps are Unix time" in said.err


def test_a_recording_that_was_killed_is_not_called_whole(shell: Shell, tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.tlog", (LinkOfLog("mem://a"),), stamps="Unix time", source={}) as log:
        log.write(DAY_US, flight()[0].frame)
        log.close()
    content = json.loads((tmp_path / "a.tlog.json").read_text()) | {"complete": False, "lost": None}
    (tmp_path / "a.tlog.json").write_text(json.dumps(content))
    assert "not complete: it was cut short, or is still being written" in shell("info", "a.tlog").out
    (tmp_path / "a.tlog.json").write_text(json.dumps(content | {"lost": 7, "error": "disk full"}))
    assert "not complete: 7 frames are missing (disk full)" in shell("info", "a.tlog").out
    for nonsense in ("{", '{"format": "other"}'):
        (tmp_path / "a.tlog.json").write_text(nonsense)
        ended = shell("info", "a.tlog", "--json", "-")
        assert (ended.code, json.loads(ended.out)["recording"]) == (0, None)


def test_long_names_are_whole_where_there_is_no_terminal(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS")
    pen = Pen()
    (tmp_path / "a.tlog").write_bytes(b"".join(pen.record(85).data for _ in range(3)))
    assert "POSITION_TARGET_LOCAL_NED " in shell("info", "a.tlog").out


def test_a_run_folder_stands_for_its_log(shell: Shell, flight_log: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    flight_log.rename(tmp_path / "run" / "run.tlog")
    assert shell("info", "run").code == 0


@pytest.mark.parametrize("content", [b"", b"this is prose\n" * 100, bytes(1000)])
def test_what_is_no_log_ends_with_one_sentence(shell: Shell, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.tlog").write_bytes(content)
    for command in (("info",), ("dump",), ("export", "--to", "csv")):
        ended = shell(command[0], "x.tlog", *command[1:])
        assert (ended.code, ended.out) == (6, "")
        assert ended.err.startswith("fwav-hil: x.tlog holds no message: ")
        assert len(ended.err.splitlines()) == 1


def test_what_is_not_there_is_named(shell: Shell) -> None:
    assert shell("info", "no.tlog") == (6, "", "fwav-hil: cannot read the log no.tlog: No such file or directory\n")


def test_a_raw_stream(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "flight.raw").write_bytes(b"".join(record.frame for record in flight()))
    info = json.loads(shell("info", "flight.raw", "--json", "-").out)
    assert info["kind"] == "raw MAVLink stream (no time stamps)"
    assert (info["messages"], info["duration_s"], info["rate_hz"]) == (101, 0.0, None)
