"""Logs of other kinds give the same tables: ArduPilot's .BIN beside DFReader's own reading, PX4's .ulg beside pyulog's."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.DFReader import DFReader_binary
from pyulog import ULog

from protocol.errors import LogError
from protocol.logs.files import ARDUPILOT, ARDUPILOT_TEXT, PX4, RAW, TELEMETRY, Log, messages, open_log
from tests.protocol.logs.log_records import mixed_records
from tests.protocol.logs.own_logs import ardupilot_log, ardupilot_text_log, px4_log


class TestArduPilot:
    @pytest.fixture
    def log(self, tmp_path: Path) -> Log:
        (tmp_path / "1.BIN").write_bytes(ardupilot_log())
        return open_log(tmp_path / "1.BIN")

    def test_every_value_and_time_is_dfreaders(self, log: Log) -> None:
        assert log.kind == ARDUPILOT
        reader = DFReader_binary(str(log.path))
        made = log.tables()
        rows = dict.fromkeys(made, 0)
        while (message := reader.recv_msg()) is not None:
            name = message.get_type()
            row = made[name][rows[name]]
            rows[name] += 1
            if "TimeUS" in message.get_fieldnames():
                assert row["t_us"] == round(1e6 * message._timestamp)
            for field in message.get_fieldnames():
                value, ours = getattr(message, field), row[field]
                if isinstance(value, str):
                    assert bytes(ours).decode() == value
                elif name == "ISBD" and field == "x":
                    assert ours.tolist() == list(range(32))
                else:
                    assert ours == pytest.approx(value, rel=1e-15), (name, field)
        reader.close()
        assert rows == {name: len(table) for name, table in made.items()}
        assert rows == {"FMT": 6, "IMU": 20, "GPS": 4, "MSG": 1, "OLD": 4, "ISBD": 4}
        assert not any(log.counters.values())

    def test_scaled_fields_are_what_they_stand_for(self, log: Log) -> None:
        made = log.tables(["GPS", "OLD"])
        assert made["GPS"]["Lat"][0] == 47.3977411
        assert made["OLD"]["Centi"].tolist() == [-1.5] * 4

    def test_a_message_without_a_time_has_that_of_the_one_before(self, log: Log) -> None:
        made = log.tables()
        assert made["OLD"]["t_us"].tolist() == made["GPS"]["t_us"].tolist()

    def test_damage_is_counted_and_passed_over(self, tmp_path: Path) -> None:
        data = ardupilot_log()
        at = data.rindex(b"\xa3\x95\x0a")
        (tmp_path / "1.BIN").write_bytes(data[:at] + b"noise" + data[at:-2])
        log = open_log(tmp_path / "1.BIN")
        assert len(log.tables()["IMU"]) == 19
        assert log.counters["damaged_bytes"] == 5
        assert log.counters["truncated_tail"] == 3 + struct.calcsize("<QBfff") - 2

    def test_what_only_begins_like_one_is_an_error(self, tmp_path: Path) -> None:
        (tmp_path / "1.BIN").write_bytes(b"\xa3\x95" + bytes(100))
        with pytest.raises(LogError, match=r"1\.BIN"):
            open_log(tmp_path / "1.BIN")


class TestPx4:
    @pytest.fixture
    def log(self, tmp_path: Path) -> Log:
        (tmp_path / "1.ulg").write_bytes(px4_log())
        return open_log(tmp_path / "1.ulg")

    def test_every_value_is_pyulogs(self, log: Log) -> None:
        assert log.kind == PX4
        made = log.tables()
        for topic in ULog(io.BytesIO(px4_log())).data_list:
            table = made[topic.name if not topic.multi_id else f"{topic.name}_{topic.multi_id}"]
            assert len(table) == len(topic.data["timestamp"])
            for field, values in topic.data.items():
                if "name" in field:  # characters, which pyulog gives one by one
                    name, at = field[: field.rindex("[")], int(field[field.rindex("[") + 1 : -1])
                    ours: Any = [bytes(value).ljust(4, b"\0")[at] for value in table[name]]
                else:
                    ours = table["q"][:, int(field[2])] if field.startswith("q[") else table[field]
                np.testing.assert_array_equal(ours, values)
            np.testing.assert_array_equal(table["t_us"], topic.data["timestamp"])
        assert made["pose"]["q"].shape == (10, 4)
        assert made["pose"]["q"][:, 3].tolist() == list(range(10))

    def test_dropouts_are_counted(self, log: Log) -> None:
        assert {name: count for name, count in log.counters.items() if count} == {"dropouts": 1}
        assert log.tables()["dropouts"]["duration_ms"].tolist() == [20]

    def test_what_only_begins_like_one_is_an_error(self, tmp_path: Path) -> None:
        (tmp_path / "1.ulg").write_bytes(px4_log()[:10])
        with pytest.raises(LogError, match=r"1\.ulg"):
            open_log(tmp_path / "1.ulg")


class TestAnyKind:
    @pytest.fixture(params=["tlog", "BIN", "log", "ulg"])
    def log(self, request: pytest.FixtureRequest, tmp_path: Path) -> Log:
        data = {
            "tlog": b"".join(record.data for record in mixed_records()),
            "BIN": ardupilot_log(),
            "log": ardupilot_text_log(),
            "ulg": px4_log(),
        }[request.param]
        (tmp_path / f"1.{request.param}").write_bytes(data)
        return open_log(tmp_path / f"1.{request.param}")

    def test_messages_come_in_order_of_time_with_the_values_of_the_tables(self, log: Log) -> None:
        made = log.tables()
        rows = dict.fromkeys(made, 0)
        last = 0
        for message in messages(log, unknown=False):
            row = made[message.name][rows[message.name]]
            rows[message.name] += 1
            assert message.t_us == row["t_us"] >= last
            last = message.t_us
            for name, value in message.fields.items():
                if isinstance(value, str):
                    text = row[name] if isinstance(row[name], str) else bytes(row[name]).split(b"\0")[0]
                    assert value == (text if isinstance(text, str) else text.decode("utf-8", "replace"))
                else:
                    assert np.array_equal(value, row[name], equal_nan=row[name].dtype.kind == "f")
        assert rows == {name: len(table) for name, table in made.items()}
        assert set(rows) == set(log.names())

    def test_a_stretch_of_time(self, log: Log) -> None:
        first, last = log.span_us()
        part = log.tables(between_us=(first, (first + last) // 2))
        assert 0 < sum(map(len, part.values())) < sum(map(len, log.tables().values()))
        assert all(table["t_us"].max() <= (first + last) // 2 for table in part.values())
        assert len(list(messages(log, between_us=(first, (first + last) // 2), unknown=False))) == sum(
            map(len, part.values())
        )


def test_the_kind_is_told_from_the_content_not_the_name(tmp_path: Path) -> None:
    for data, kind in (
        (b"".join(record.data for record in mixed_records()), TELEMETRY),
        (b"".join(record.frame for record in mixed_records()), RAW),
        (ardupilot_log(), ARDUPILOT),
        (px4_log(), PX4),
        (ardupilot_text_log(), ARDUPILOT_TEXT),
    ):
        (tmp_path / "log").write_bytes(data)
        assert open_log(tmp_path / "log").kind == kind
