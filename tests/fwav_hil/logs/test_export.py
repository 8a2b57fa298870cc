"""`fwav-hil log export`, read back by the libraries of the formats."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from fwav_hil.logs import export
from protocol.logs.files import open_log
from tests.fwav_hil.logs.conftest import COUNT, Shell, flight
from tests.protocol.logs.log_records import FOREIGN

NAMES = ["ATT_POS_MOCAP", "HIL_ACTUATOR_CONTROLS", "STATUSTEXT"]


def test_parquet_holds_the_tables(shell: Shell, flight_log: Path, tmp_path: Path) -> None:
    ended = shell("export", flight_log, "--to", "parquet", "--json", "-")
    assert (ended.code, ended.err) == (0, "flight_parquet: 101 messages of 3 kinds\n")
    assert json.loads(ended.out)["messages"] == dict(zip(NAMES, (COUNT, COUNT, 1), strict=True))
    for name, table in open_log(flight_log).tables().items():
        read = pq.read_table(tmp_path / "flight_parquet" / f"{name}.parquet")
        assert read.column_names == list(table.dtype.names or ())
        for column in read.column_names:
            values = np.array(read[column].to_pylist(), dtype=table[column].dtype.base if column != "text" else None)
            if column == "text":
                assert values.tolist() == ['grüße, "du"']
            else:
                assert np.array_equal(values, table[column], equal_nan=values.dtype.kind == "f"), (name, column)
    assert str(read.schema.field("t_us").type) == "int64"
    pose = pq.read_schema(tmp_path / "flight_parquet" / "ATT_POS_MOCAP.parquet")
    assert str(pose.field("q").type) == "fixed_size_list<element: float>[4]"


def test_a_long_table_is_written_in_pieces(
    shell: Shell, flight_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "_ROWS_AT_ONCE", 7)
    for kind in ("parquet", "csv"):
        assert shell("export", flight_log, "--to", kind).code == 0
    read = pq.read_table(tmp_path / "flight_parquet" / "ATT_POS_MOCAP.parquet")
    assert read["t_us"].to_pylist() == [record.t_us for record in flight()[:-1:2]]
    assert len((tmp_path / "flight_csv" / "ATT_POS_MOCAP.csv").read_text().splitlines()) == COUNT + 1


def test_csv_has_a_time_in_seconds_first(shell: Shell, flight_log: Path, tmp_path: Path) -> None:
    assert shell("export", flight_log, "--to", "csv", "--out", "out").code == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [f"{name}.csv" for name in NAMES]
    with (tmp_path / "out" / "ATT_POS_MOCAP.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:6] == ["time_s", "system", "component", "frame_sequence", "time_usec", "q[0]"]
    assert [row["time_s"] for row in rows[:2]] == ["1700000000", "1700000000.1"]
    assert [float(row["q[3]"]) for row in rows] == list(range(COUNT))
    assert {row["covariance[0]"] for row in rows} == {""}  # NaN
    with (tmp_path / "out" / "STATUSTEXT.csv").open(newline="", encoding="utf-8") as file:
        assert [row["text"] for row in csv.DictReader(file)] == ['grüße, "du"']


def test_mcap_is_read_back_by_its_own_library(shell: Shell, flight_log: Path, tmp_path: Path) -> None:
    ended = shell("export", flight_log, "--to", "mcap")
    assert ended == (0, "flight.mcap: 101 messages of 3 kinds\n", "")
    found: list[tuple[str, int, dict[str, Any]]] = []
    with (tmp_path / "flight.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 101
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            # What Foxglove asks for: JSON with a JSON Schema of type object; PlotJuggler: a schema, and strict JSON.
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            shape = json.loads(schema.data)
            fields = json.loads(message.data, parse_constant=pytest.fail)
            assert (shape["title"], shape["type"]) == (schema.name, "object")
            assert list(shape["properties"]) == list(fields)
            assert message.log_time == message.publish_time
            found.append((channel.topic, message.log_time, fields))
    records = flight()
    assert [log_time for _, log_time, _ in found] == [1000 * record.t_us for record in records]
    assert found[2][0] == "/system1/component191/ATT_POS_MOCAP"
    assert found[2][2]["q"] == [1.0, 0.0, 0.5, 1.0]
    assert found[2][2]["covariance"][:2] == [None, 0.0]
    assert found[-1][2] == {"severity": 6, "text": 'grüße, "du"', "id": 0, "chunk_seq": 0}
    assert found[-1][0] == "/system1/component1/STATUSTEXT"


def test_the_schema_says_types_and_units(flight_log: Path) -> None:
    from fwav_hil.logs.mcap_file import schema

    log = open_log(flight_log)
    made = log.tables()
    assert schema(log, "ATT_POS_MOCAP", made["ATT_POS_MOCAP"])["properties"] == {
        "time_usec": {"type": "integer", "description": "us"},
        "q": {"type": "array", "items": {"type": "number"}},
        **{axis: {"type": "number", "description": "m"} for axis in "xyz"},
        "covariance": {"type": "array", "items": {"type": "number"}},
    }
    assert schema(log, "STATUSTEXT", made["STATUSTEXT"])["properties"]["text"] == {"type": "string"}


@pytest.mark.parametrize("kind", ["parquet", "csv", "mcap"])
class TestChoice:
    @pytest.mark.parametrize(
        ("options", "counts"),
        [
            (("--types", "att_pos_mocap"), {"ATT_POS_MOCAP": COUNT}),
            (("--system", "1/1"), {"HIL_ACTUATOR_CONTROLS": COUNT, "STATUSTEXT": 1}),
            (("--from", "0.5", "--to", "0.9"), {"ATT_POS_MOCAP": 5, "HIL_ACTUATOR_CONTROLS": 5}),
            (("--to", "22:13:20.2", "--system", "1/191"), {"ATT_POS_MOCAP": 3}),
        ],
    )
    def test_a_part_of_a_log(
        self, shell: Shell, flight_log: Path, kind: str, options: tuple[str, ...], counts: dict[str, int]
    ) -> None:
        ended = shell("export", flight_log, "--to", kind, *options, "--json", "-", "--out", "part")
        assert ended.code == 0
        assert json.loads(ended.out)["messages"] == counts

    def test_a_part_without_a_message_is_an_error(
        self, shell: Shell, flight_log: Path, tmp_path: Path, kind: str
    ) -> None:
        ended = shell("export", flight_log, "--to", kind, "--system", "9", "--out", "part")
        assert (ended.code, ended.out) == (2, "")
        assert "no frame of" in ended.err
        assert not (tmp_path / "part").exists()

    def test_what_nobody_knows_has_no_table(self, shell: Shell, mixed_log: Path, kind: str) -> None:
        ended = shell("export", mixed_log, "--to", kind, "--types", f"UNKNOWN_{FOREIGN[0]}")
        assert (ended.code, ended.out) == (2, "")
        assert "nothing says what is in UNKNOWN_" in ended.err

    @pytest.mark.parametrize("more", [("--to", "1", "--to", "2"), ("--to", "csv")])
    def test_said_twice_it_is_refused(self, shell: Shell, flight_log: Path, kind: str, more: tuple[str, ...]) -> None:
        ended = shell("export", flight_log, "--to", kind, *more)
        assert (ended.code, ended.out) == (2, "")
        assert "say what to write once: --to parquet, csv, mcap" in ended.err


@pytest.mark.parametrize("kind", ["parquet", "csv", "mcap"])
class TestOutputs:
    def test_what_is_there_stays(self, shell: Shell, flight_log: Path, tmp_path: Path, kind: str) -> None:
        (tmp_path / "out").write_bytes(b"mine")
        ended = shell("export", flight_log, "--to", kind, "--out", "out")
        assert (ended.code, ended.out) == (6, "")
        assert ended.err == "fwav-hil: out is there already and stays: choose another place with --out\n"
        assert (tmp_path / "out").read_bytes() == b"mine"

    def test_a_place_that_cannot_be_written(self, shell: Shell, flight_log: Path, kind: str) -> None:
        ended = shell("export", flight_log, "--to", kind, "--out", "no/such/out")
        assert (ended.code, ended.err) == (6, "fwav-hil: cannot write no/such/out: No such file or directory\n")

    def test_what_is_interrupted_leaves_nothing(
        self, shell: Shell, flight_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
    ) -> None:
        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("fwav_hil.logs.working.Working.__call__", interrupt)
        monkeypatch.setattr("fwav_hil.logs.choice.open_log", lambda path, progress: open_log(path))
        ended = shell("export", flight_log, "--to", kind, "--out", "out")
        assert (ended.code, ended.err.strip()) == (130, "fwav-hil: interrupted")
        assert {path.name for path in tmp_path.iterdir()} == {"flight.tlog"}
