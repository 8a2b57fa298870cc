"""Logs of others, by the commands: shown, dumped, plotted, exported without loss."""

from __future__ import annotations

import csv
import json
import struct
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from tests.cases import FOLDER, case
from tests.fwav_hil.logs.conftest import Shell
from tests.protocol.logs.own_logs import px4_log

FILE_BYTES = "504106000002" + bytes(range(0xC8, 0x100)).hex() + "0102"


@pytest.mark.parametrize("name", ["bin-odd-formats/markup.bin", "bin-odd-formats/markup.ulg"])
def test_a_name_like_markup_is_shown_as_it_is(shell: Shell, name: str) -> None:
    ended = shell("info", case(name))
    assert ended.code == 0
    assert ("[/x]" if name.endswith("bin") else "a[/bold]") in ended.out
    assert shell("dump", case(name)).code == 0
    for kind in ("csv", "parquet", "mcap"):
        assert shell("export", case(name), "--to", kind).code == 0


def test_info_says_what_a_px4_log_holds(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "1.ulg").write_bytes(px4_log())
    ended = shell("info", "1.ulg", "--json", "info.json")
    assert "3 topics, 1 logged messages, 3 parameters, 1 dropouts\nsys_name PX4\n" in ended.out
    content = json.loads((tmp_path / "info.json").read_text())["content"]
    assert content["information"] == {"sys_name": "PX4"}
    ended = shell("info", case("ulog-only-text/in.ulg"))
    assert (ended.code, "0 topics, 1 logged messages, 1 parameters" in ended.out) == (0, True)
    assert '"[commander] crash"' in shell("dump", case("ulog-only-text/in.ulg")).out


def test_info_of_a_log_with_a_stamp_of_zero(shell: Shell) -> None:
    said = json.loads(shell("info", case("ulog-zero-stamp/in.ulg"), "--json", "-").out)
    assert (said["start_s"], said["duration_s"]) == (100.0, 2.99)
    assert {row["name"]: row["rate_hz"] for row in said["types"]}["imu"] == pytest.approx(100)
    assert (
        len(
            shell("dump", case("ulog-zero-stamp/in.ulg"), "--types", "imu", "--from", "0", "--to", "1").out.splitlines()
        )
        == 101
    )


def test_bytes_stay_bytes_in_every_export(shell: Shell, tmp_path: Path) -> None:
    log = case("bin-file-bytes/in.bin")
    for kind in ("csv", "parquet", "mcap"):
        assert shell("export", log, "--to", kind).code == 0
    dumped = [json.loads(line) for line in shell("dump", log, "--types", "FILE", "--json").out.splitlines()]
    assert [row["fields"]["Data"][:132] for row in dumped] == [FILE_BYTES, b"0123456789".hex() + "00" * 54]
    table = pq.read_table(tmp_path / "in_parquet" / "FILE.parquet")
    assert table["Data"][0].as_py().hex() == FILE_BYTES
    with (tmp_path / "in_csv" / "FILE.csv").open() as file:
        assert next(csv.DictReader(file))["Data"] == FILE_BYTES
    with (tmp_path / "in.mcap").open("rb") as file:
        found = [message for _, channel, message in make_reader(file).iter_messages() if channel.topic == "/FILE"]
    assert json.loads(found[0].data)["Data"] == FILE_BYTES


def test_values_of_extended_parameters_keep_their_bytes(shell: Shell, tmp_path: Path) -> None:
    log = case("param-ext-binary/in.tlog")
    for kind in ("csv", "parquet", "mcap"):
        assert shell("export", log, "--to", kind).code == 0
    wanted = [struct.pack("<I", 0x100), struct.pack("<f", 1.5), struct.pack("<Q", (1 << 63) + 1), b"text"]
    dumped = [json.loads(line)["fields"]["param_value"] for line in shell("dump", log, "--json").out.splitlines()]
    with (tmp_path / "in.mcap").open("rb") as file:
        in_mcap = [json.loads(message.data)["param_value"] for _, _, message in make_reader(file).iter_messages()]
    with (tmp_path / "in_csv" / "PARAM_EXT_VALUE.csv").open() as opened:
        in_csv = [row["param_value"] for row in csv.DictReader(opened)]
    in_parquet = pq.read_table(tmp_path / "in_parquet" / "PARAM_EXT_VALUE.parquet")["param_value"].to_pylist()
    for found in (dumped, in_mcap, in_csv, [value.hex() for value in in_parquet]):
        assert [bytes.fromhex(text) for text in found] == [value.ljust(128, b"\0") for value in wanted]


def test_infinity_is_told_from_nan_in_json(shell: Shell, tmp_path: Path) -> None:
    log = case("json-infinity/in.tlog")
    lines = shell("dump", log, "--json").out.splitlines()
    values = [value for line in lines for value in json.loads(line)["fields"].values()]
    assert "Infinity" in values
    assert "-Infinity" in values
    assert None in values
    assert shell("export", log, "--to", "mcap").code == 0
    with (tmp_path / "in.mcap").open("rb") as file:
        bodies = [
            json.loads(message.data, parse_constant=pytest.fail) for _, _, message in make_reader(file).iter_messages()
        ]
    assert bodies == [json.loads(line)["fields"] for line in lines]


@pytest.mark.parametrize("kind", ["csv", "parquet", "mcap"])
def test_frames_of_unknown_messages_are_counted_in_each_export(shell: Shell, mixed_log: Path, kind: str) -> None:
    ended = shell("export", mixed_log, "--to", kind, "--json", "-")
    assert json.loads(ended.out)["unknown_frames"] == 30
    assert ended.err.endswith("; left out: 30 frames of unknown messages\n")


def test_info_tells_of_a_clock_that_was_set(shell: Shell) -> None:
    ended = shell("info", case("replay-clock-jump/in.tlog"))
    assert "the log's clock jumps ahead by 53.9 years after 1.980 s" in ended.out


def test_what_a_record_lacks_is_empty_in_every_export(shell: Shell, tmp_path: Path) -> None:
    for kind in ("csv", "mcap"):
        assert shell("export", case("bin-fmt-redefined/in.bin"), "--to", kind, "--types", "ATT").code == 0
    with (tmp_path / "in_csv" / "ATT.csv").open() as file:
        assert sum(1 for row in csv.DictReader(file) if row["Yaw"]) == 50
    with (tmp_path / "in.mcap").open("rb") as file:
        bodies = [json.loads(message.data) for _, _, message in make_reader(file).iter_messages()]
    assert sum(1 for body in bodies if body["Yaw"] is not None) == 50


def test_units_are_in_every_export(shell: Shell, tmp_path: Path) -> None:
    from tests.protocol.logs.test_ardupilot import log_with_units

    (tmp_path / "u.BIN").write_bytes(log_with_units())
    for kind in ("csv", "parquet", "mcap"):
        assert shell("export", "u.BIN", "--to", kind).code == 0
    said = json.loads((tmp_path / "u_csv" / "units.json").read_text())
    assert said == {
        "BAR": {
            "TimeUS": {"name": "s", "multiplier": 1e-6},
            "Alt": {"name": "m", "multiplier": 3.6},
            "Rate": {"name": "m/s", "multiplier": 1.0},
        }
    }
    field = pq.read_schema(tmp_path / "u_parquet" / "BAR.parquet").field("TimeUS")
    assert field.metadata == {b"unit": b"s", b"multiplier": b"1e-06"}
    with (tmp_path / "u.mcap").open("rb") as file:
        schemas = {schema.name: schema for schema, _, _ in make_reader(file).iter_messages() if schema}
    assert json.loads(schemas["BAR"].data)["properties"]["TimeUS"]["description"] == "µs"


def test_nested_fields_are_plotted(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "1.ulg").write_bytes(px4_log())
    assert shell("plot", "1.ulg", "mode.rotors[0].rpm", "pose.q[3]", "pose.q", "--out", "a.png").code == 0
    ended = shell("plot", "1.ulg", "logged_messages.message", "--out", "b.png")
    assert (ended.code, "is text" in ended.err) == (2, True)


@pytest.mark.parametrize("path", sorted((FOLDER / "bin_tracebacks").glob("*")))
def test_a_damaged_log_ends_with_tables_or_one_line(shell: Shell, path: Path) -> None:
    ended = shell("info", path)
    assert ended.code in (0, 6)
    if ended.code:
        assert len(ended.err.splitlines()) == 1
    assert "Traceback" not in ended.err
    assert ended.out.replace("\n", "").isprintable()
