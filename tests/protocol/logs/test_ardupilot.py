"""ArduPilot's .BIN and .log: damage costs what it hits, odd formats their own records, and nothing is invented."""

from __future__ import annotations

import contextlib
import io
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.DFReader import DFReader_binary, DFReader_text

from protocol.errors import LogError
from protocol.logs.files import ARDUPILOT_TEXT, Log, open_log
from protocol.logs.record_table import Unit
from tests.cases import FOLDER, case
from tests.protocol.logs.own_logs import ardupilot_log, ardupilot_text_log, format_record

FMT_OF_FMT = format_record(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 86)


def record(number: int, layout: str, *values: object) -> bytes:
    return b"\xa3\x95" + bytes([number]) + struct.pack(layout, *values)


def opened(tmp_path: Path, data: bytes, name: str = "1.BIN") -> Log:
    (tmp_path / name).write_bytes(data)
    return open_log(tmp_path / name)


def log_with_units() -> bytes:
    data = FMT_OF_FMT
    data += format_record(1, "UNIT", "QbZ", "TimeUS,Id,Label", 73) + format_record(
        2, "MULT", "Qbd", "TimeUS,Id,Mult", 17
    )
    data += format_record(3, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds", 41)
    data += format_record(9, "BAR", "QfcB", "TimeUS,Alt,Rate,I", 15)
    for number, label in ((ord("s"), b"s"), (ord("m"), b"m"), (ord("n"), b"m/s")):
        data += record(1, "<Qb64s", 0, number, label)
    for number, by in ((ord("F"), 1e-6), (ord("B"), 1e-2), (ord("0"), 1.0), (ord("-"), 0.0), (ord("!"), 3.6)):
        data += record(2, "<Qbd", 0, number, by)
    data += record(3, "<QB16s16s", 0, 9, b"smn#", b"F!B-") + record(9, "<QfhB", 10, 1.5, 250, 1)
    return data


class TestFormats:
    def test_an_unknown_type_costs_its_own_record(self) -> None:
        log = open_log(case("bin-unknown-type/in.bin"))
        times = log.tables()["ATT"]["TimeUS"]
        np.testing.assert_array_equal(times, 1_000_000 + 10_000 * np.arange(300))
        assert log.counters["damaged_bytes"] == 15

    def test_a_redefined_format_keeps_the_records_of_the_old_one(self) -> None:
        log = open_log(case("bin-fmt-redefined/in.bin"))
        table = log.tables()["ATT"]
        assert len(table) == 350
        assert np.isnan(table["Yaw"][:300]).all()
        assert not np.isnan(table["Yaw"][300:]).any()
        assert not np.isnan(table["Roll"]).any()
        assert not any(log.counters.values())

    def test_two_types_of_one_name_are_one_table(self) -> None:
        log = open_log(case("bin-same-name/in.bin"))
        table = log.tables()["ATT"]
        assert len(table) == 350
        assert (np.diff(table["t_us"]) >= 0).all()
        assert np.count_nonzero(np.isnan(table["Pitch"])) == 50
        assert not any(log.counters.values())

    def test_whole_numbers_and_text_that_some_records_lack(self, tmp_path: Path) -> None:
        data = FMT_OF_FMT + format_record(9, "A", "QBN", "TimeUS,I,Name", 25) + format_record(8, "A", "Q", "TimeUS", 8)
        data += record(9, "<QB16s", 1, 7, b"x") + record(8, "<Q", 2)
        table = opened(tmp_path, data).tables()["A"]
        assert table["TimeUS"].tolist() == [1, 2]
        assert table["I"][0] == 7
        assert np.isnan(table["I"][1])
        assert table["Name"].tolist() == [b"x", b""]

    def test_kinds_that_do_not_go_together_are_kept_apart(self, tmp_path: Path) -> None:
        data = FMT_OF_FMT + format_record(9, "A", "QN", "TimeUS,X", 24) + format_record(8, "A", "Qf", "TimeUS,X", 12)
        data += record(9, "<Q16s", 1, b"x") + record(8, "<Qf", 2, 1.5)
        made = opened(tmp_path, data).tables()
        assert (made["A"]["X"].tolist(), made["A_2"]["X"].tolist()) == ([b"x"], [1.5])

    def test_a_damaged_definition_of_a_type_does_not_cost_the_records_of_the_good_one(self, tmp_path: Path) -> None:
        good = format_record(9, "ATT", "Qf", "TimeUS,Roll", 12)
        rows = [record(9, "<Qf", 1000 * row, row) for row in range(50)]
        bad = format_record(9, "XYZ", "Qffff", "TimeUS,A,B,C,D", 24)
        log = opened(tmp_path, FMT_OF_FMT + good + b"".join(rows[:20]) + bad + b"".join(rows[20:]))
        assert log.tables()["ATT"]["Roll"].tolist() == list(range(50))

    def test_columns_of_one_name_without_one_or_with_one_of_ours(self) -> None:
        made = open_log(case("bin-odd-formats/dupcol.bin")).tables()["DUP"]
        assert made.dtype.names == ("t_us", "TimeUS", "A", "A_2")
        made = open_log(case("bin-odd-formats/t_us_column.bin")).tables()["TCO"]
        assert made.dtype.names == ("t_us", "TimeUS", "t_us_2", "time_s_2")
        assert len(open_log(case("bin-odd-formats/emptycols.bin")).tables()["EMP"]) == 1

    @pytest.mark.parametrize(
        ("letters", "labels", "size", "names"),
        [
            ("Qff", "TimeUS,Roll", 16, ("t_us", "TimeUS", "Roll", "field_3")),
            ("Qf", "TimeUS,Roll,More", 12, ("t_us", "TimeUS", "Roll")),
            ("Qf", "TimeUS, Roll ", 12, ("t_us", "TimeUS", "Roll")),
            ("Qf", ",", 12, ("t_us", "field_1", "field_2")),
            ("Qf", "TimeUS,a\x1b[31m", 12, ("t_us", "TimeUS", "a_[31m")),
        ],
    )
    def test_labels_that_do_not_agree(
        self, tmp_path: Path, letters: str, labels: str, size: int, names: tuple[str, ...]
    ) -> None:
        data = FMT_OF_FMT + format_record(9, "A", letters, labels, size) + record(9, f"<Q{size - 8}x", 5)
        assert opened(tmp_path, data).tables()["A"].dtype.names == names

    @pytest.mark.parametrize(("letters", "size"), [("Qw", 12), ("Qf", 20), ("Qff", 12)])
    def test_a_format_that_means_nothing_costs_its_own_records(self, tmp_path: Path, letters: str, size: int) -> None:
        data = FMT_OF_FMT + format_record(9, "A", letters, "TimeUS,X,Y", size) + format_record(8, "B", "Q", "TimeUS", 8)
        data += (record(9, f"<Q{size - 8}x", 5) + record(8, "<Q", 6)) * 10
        log = opened(tmp_path, data)
        assert log.counts() == {"B": 10, "FMT": 3}
        assert log.counters["unreadable_records"] == 10
        assert log.counters["damaged_bytes"] == 0


class TestValues:
    def test_binary_fields_keep_their_bytes(self) -> None:
        table = open_log(case("bin-file-bytes/in.bin")).tables()["FILE"]
        first, second = (bytes(value.tobytes()) for value in table["Data"])
        assert first == bytes.fromhex("504106000002") + bytes(range(0xC8, 0x100)) + b"\x01\x02"
        assert second == b"0123456789" + bytes(54)
        assert table["FileName"].tolist() == [b"@SYS/storage.bin", b"@SYS/tasks.txt"]

    def test_any_text_field_with_bytes_behind_its_end_keeps_them(self, tmp_path: Path) -> None:
        data = FMT_OF_FMT + format_record(9, "BLOB", "QN", "TimeUS,X", 24)
        data += record(9, "<Q16s", 1, b"\x01\0\x02") + record(9, "<Q16s", 2, b"text")
        values = opened(tmp_path, data).tables()["BLOB"]["X"]
        assert [value.tobytes()[:4] for value in values] == [b"\x01\0\x02\0", b"text"]

    def test_units_are_those_of_dfreader(self, tmp_path: Path) -> None:
        log = opened(tmp_path, log_with_units())
        assert log.unit("BAR", "TimeUS") == Unit("s", 1e-6)
        assert log.unit("BAR", "Rate") == Unit("m/s")  # its values have the scale of their letter
        reader = DFReader_binary(str(log.path))
        while reader.recv_msg() is not None:
            pass
        for field in ("TimeUS", "Alt", "Rate", "I"):
            assert str(log.unit("BAR", field)) == reader.formats[9].get_unit(field)
        reader.close()


class TestClock:
    def test_before_copter_3_3_gps_records_have_the_time_of_week_in_timems(self) -> None:
        log = open_log(case("bin-old-gps-time/in.bin"))
        first, last = log.span_us()
        assert last - first == 980_000
        made = log.tables()
        since_start = made["GPS"]["t_us"] - first + 60_000_000
        assert since_start.tolist() == [60_001_000 + 200_000 * row for row in range(5)]
        np.testing.assert_array_equal(made["GPS"]["T"], since_start // 1000)
        np.testing.assert_array_equal(made["DU32"]["t_us"], made["GPS"]["t_us"])

    @pytest.mark.parametrize("stamp", [0, 1 << 40, (1 << 63) + 5, (1 << 64) - 1])
    @pytest.mark.parametrize("row", [0, 10, 49])
    def test_a_stamp_that_cannot_be_does_not_move_the_log(self, tmp_path: Path, stamp: int, row: int) -> None:
        stamps = [100_000_000 + 10_000 * number for number in range(50)]
        stamps[row] = stamp
        data = FMT_OF_FMT + format_record(9, "A", "Q", "TimeUS", 8) + b"".join(record(9, "<Q", s) for s in stamps)
        log = opened(tmp_path, data)
        first, last = log.span_us()
        assert 99_990_000 <= first <= 100_010_000
        assert 480_000 <= last - first <= 490_000
        assert log.tables()["A"]["TimeUS"][row] == stamp


class TestDamage:
    @pytest.mark.parametrize(
        "path", sorted((FOLDER / "bin_tracebacks").glob("*")) + [case("bin_hang/09_TO_line906.BIN")]
    )
    def test_whatever_is_damaged_gives_tables_or_a_sentence_at_once(self, path: Path) -> None:
        open_log(case("bin-same-name/in.bin"))  # compiles
        begun = time.monotonic()
        with contextlib.suppress(LogError):
            log = open_log(path)
            assert {name: len(table) for name, table in log.tables().items()} == log.counts()
            assert all(count >= 0 for count in log.counters.values())
        assert time.monotonic() - begun < 1.0

    @settings(deadline=None)
    @given(st.data())
    def test_bytes_lost_or_put_in_cost_the_records_that_they_hit(self, data: st.DataObject) -> None:
        rows = [record(9, "<Qf", 1000 * row, row) for row in range(60)]
        at, gone = data.draw(st.integers(1, 40)), data.draw(st.integers(0, 100))
        noise = data.draw(st.binary(max_size=40).filter(lambda noise: b"\xa3" not in noise))
        body = b"".join(rows)
        cut = at * len(rows[0]) + data.draw(st.integers(0, len(rows[0]) - 1))
        content = (
            FMT_OF_FMT + format_record(9, "ATT", "Qf", "TimeUS,Roll", 12) + body[:cut] + noise + body[cut + gone :]
        )
        with contextlib.ExitStack() as stack:
            path = Path(stack.enter_context(_folder())) / "1.BIN"
            path.write_bytes(content)
            log = open_log(path)
        found = log.tables()["ATT"]["Roll"].tolist()
        whole_before, behind = cut // len(rows[0]), -(-(cut + gone) // len(rows[0]))
        if not noise and not gone:
            behind = whole_before
        assert found[:whole_before] == list(range(whole_before))
        assert found[len(found) - (60 - behind) :] == list(range(behind, 60))
        assert len(found) <= whole_before + 60 - behind + 1  # the record that was hit may still look whole


def _folder() -> contextlib.AbstractContextManager[str]:
    import tempfile

    return tempfile.TemporaryDirectory()


class TestText:
    def test_every_value_is_dfreaders(self, tmp_path: Path) -> None:
        log = opened(tmp_path, ardupilot_text_log(), "1.log")
        assert log.kind == ARDUPILOT_TEXT
        made = log.tables()
        rows = dict.fromkeys(made, 0)
        with contextlib.redirect_stdout(io.StringIO()):
            reader = DFReader_text(str(log.path))
        reader.filehandle.close()  # it reads from a map of it, and does not close it
        while (message := reader.recv_msg()) is not None:
            name = message.get_type()
            if name == "FMT":
                continue
            row = made[name][rows[name]]
            rows[name] += 1
            for field in message.get_fieldnames():
                value = getattr(message, field)
                if field == "Message":
                    value = "ArduCopter V3.2, and more"  # DFReader ends at the comma
                assert row[field] == value or (row[field] != row[field] and value != value), (name, field)  # noqa: PLR0124
            if "TimeUS" in message.get_fieldnames():
                assert row["t_us"] == round(1e6 * message._timestamp)
        assert {name: count for name, count in rows.items() if name != "FMT"} == {
            "IMU": 20, "GPS": 4, "MSG": 1, "OLD": 4, "MODE": 1,
        }  # fmt: skip

    def test_lines_that_do_not_agree_are_counted(self, tmp_path: Path) -> None:
        lines = ardupilot_text_log().splitlines()
        lines[20:20] = [
            b"IMU, 1, 2",
            b"WHAT, 1",
            b"\xff\xfe\x00",
            b"IMU, x, 0, 1, 2, 3",
            b"IMU, 99999999999999999999999, 0, 1, 2, 3",
        ]
        log = opened(tmp_path, b"\n".join(lines), "1.log")
        assert log.counters == {"unreadable_lines": 5}
        assert log.counts()["IMU"] == 20

    def test_without_spaces(self, tmp_path: Path) -> None:
        log = opened(tmp_path, ardupilot_text_log().replace(b", ", b","), "1.log")
        assert log.counts()["IMU"] == 20


def test_a_log_of_a_megabyte_takes_no_more_memory_than_three_times_its_size(tmp_path: Path) -> None:
    import tracemalloc

    (tmp_path / "1.BIN").write_bytes(ardupilot_log() * 600)
    size = (tmp_path / "1.BIN").stat().st_size
    open_log(tmp_path / "1.BIN")  # compiles
    tracemalloc.start()
    try:
        log = open_log(tmp_path / "1.BIN")
        pieces = sum(len(piece) for name in log.names() for piece in log.pieces(name, 4096))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert pieces == 600 * 39
    assert peak < 3 * size + (1 << 20)
