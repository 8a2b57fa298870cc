"""PX4's .ulg: damage costs what it hits, the clock holds whatever single stamps say, nothing is left out without a word."""

from __future__ import annotations

import contextlib
import io
import struct
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyulog import ULog

from protocol.errors import LogError
from protocol.logs.files import PX4, Log, open_log, plain
from tests.cases import FOLDER, case
from tests.protocol.logs.own_logs import px4_log, ulog_header, ulog_key, ulog_message, ulog_subscription

START_US = 100_000_000


def opened(tmp_path: Path, data: bytes) -> Log:
    (tmp_path / "1.ulg").write_bytes(data)
    return open_log(tmp_path / "1.ulg")


def topic(name: str, fields: str, number: int, instance: int = 0) -> bytes:
    return ulog_message("F", f"{name}:{fields}".encode()) + ulog_subscription(instance, number, name)


def imu_rows(count: int, number: int = 0, start_us: int = START_US) -> list[bytes]:
    return [ulog_message("D", struct.pack("<HQf", number, start_us + 10_000 * row, row)) for row in range(count)]


IMU = topic("imu", "uint64_t timestamp;float x;", 0)


class TestClock:
    def test_a_topic_without_a_time_does_not_set_the_beginning(self) -> None:
        log = open_log(case("ulog-zero-stamp/in.ulg"))
        assert log.span_us() == (START_US, START_US + 2_990_000)
        first = START_US
        assert len(log.tables(["imu"], between_us=(first, first + 1_000_000))["imu"]) == 101
        assert log.tables()["ekf"]["timestamp"].tolist() == [0]

    @pytest.mark.parametrize(
        "stamp", [0, 1, START_US - 1, 1 << 50, 1_700_000_000_000_000, (1 << 63) + 1, (1 << 64) - 1]
    )
    @pytest.mark.parametrize("places", [(0,), (1, 2, 3), (25,), (10, 20, 30, 40), (50,)])
    def test_no_stamp_of_a_single_topic_moves_the_log(
        self, tmp_path: Path, stamp: int, places: tuple[int, ...]
    ) -> None:
        odd = ulog_message("D", struct.pack("<HQB", 1, stamp, 7))
        rows = imu_rows(50)
        for place in reversed(places):
            rows.insert(place, odd)
        data = ulog_header(START_US) + IMU + topic("odd", "uint64_t timestamp;uint8_t y;", 1) + b"".join(rows)
        log = opened(tmp_path, data)
        assert log.span_us() == (START_US, START_US + 490_000)
        made = log.tables()
        assert made["odd"]["timestamp"].tolist() == [stamp] * len(places)
        np.testing.assert_array_equal(made["imu"]["t_us"], made["imu"]["timestamp"])

    def test_an_odd_topic_has_the_time_at_which_it_was_logged(self, tmp_path: Path) -> None:
        rows = imu_rows(50)
        rows.insert(25, ulog_message("D", struct.pack("<HQB", 1, 0, 7)))
        data = ulog_header(START_US) + IMU + topic("odd", "uint64_t timestamp;uint8_t y;", 1) + b"".join(rows)
        assert opened(tmp_path, data).tables()["odd"]["t_us"].tolist() == [START_US + 240_000]

    def test_a_gap_is_a_gap(self, tmp_path: Path) -> None:
        rows = imu_rows(50) + imu_rows(50, start_us=START_US + 3_600_000_000)
        log = opened(tmp_path, ulog_header(START_US) + IMU + b"".join(rows))
        np.testing.assert_array_equal(log.tables()["imu"]["t_us"], log.tables()["imu"]["timestamp"])

    def test_a_slow_log(self, tmp_path: Path) -> None:
        rows = [ulog_message("D", struct.pack("<HQf", 0, START_US + 100_000_000 * row, row)) for row in range(9)]
        log = opened(tmp_path, ulog_header(START_US) + IMU + b"".join(rows))
        assert log.span_us() == (START_US, START_US + 800_000_000)

    @pytest.mark.parametrize("start_us", [1 << 40, (1 << 64) - 1])
    def test_a_damaged_header(self, tmp_path: Path, start_us: int) -> None:
        log = opened(tmp_path, ulog_header(start_us) + IMU + b"".join(imu_rows(50)))
        assert log.span_us() == (START_US, START_US + 490_000)


class TestDamage:
    def test_what_follows_behind_damage_is_found(self) -> None:
        log = open_log(case("ulog-mid-damage/in.ulg"))
        values = log.tables()["imu"]["timestamp"].astype(np.int64)
        rows = (values - START_US) // 10_000
        assert rows.tolist() == [*range(100), *range(124, 300)]
        assert 400 <= log.counters["damaged_bytes"] < 400 + 17
        assert log.counters["resynchronisations"] == 1

    def test_a_truncated_tail_is_counted(self) -> None:
        log = open_log(case("ulog-truncated-unsaid/in.ulg"))
        assert log.counts()["imu"] == 299
        assert {name: count for name, count in log.counters.items() if count} == {"truncated_tail": 8}

    def test_a_wrong_size_that_leads_to_another_message_is_not_believed(self, tmp_path: Path) -> None:
        rows = imu_rows(60)
        rows[1] = bytes([11 * len(rows[1]) - 3]) + rows[1][1:]  # ends where row 12 begins
        log = opened(tmp_path, ulog_header(START_US) + IMU + b"".join(rows))
        assert log.tables()["imu"]["x"].tolist() == [0, *range(2, 60)]
        assert log.counters["damaged_bytes"] == len(rows[1])

    @settings(deadline=None)
    @given(st.data())
    def test_bytes_lost_or_put_in_cost_the_messages_that_they_hit(self, data: st.DataObject) -> None:
        rows = imu_rows(60)
        at, gone = data.draw(st.integers(1, 40)), data.draw(st.integers(0, 100))
        noise = data.draw(st.binary(max_size=40))
        body, size = b"".join(rows), len(rows[0])
        cut = at * size + data.draw(st.integers(0, size - 1))
        with tempfile.TemporaryDirectory() as folder:
            log = opened(Path(folder), ulog_header(START_US) + IMU + body[:cut] + noise + body[cut + gone :])
        found = log.tables()["imu"]["x"].tolist()
        whole_before, behind = cut // size, -(-(cut + gone) // size)
        if not noise and not gone:
            behind = whole_before
        assert found[:whole_before] == list(range(whole_before))
        assert found[len(found) - (60 - behind) :] == list(range(behind, 60))
        assert len(found) <= whole_before + 60 - behind + 1  # the message that was hit may still look whole

    def test_a_damaged_definition_costs_its_own_topic(self, tmp_path: Path) -> None:
        other = topic("odd", "uint64_t timestamp;uint8_t y;", 1).replace(b"uint8_t", b"uint8_\x00")
        odd = [ulog_message("D", struct.pack("<HQB", 1, START_US + row, 7)) for row in range(50)]
        mixed = b"".join(piece for pair in zip(imu_rows(50), odd, strict=True) for piece in (*pair, pair[1], pair[1]))
        log = opened(tmp_path, ulog_header(START_US) + IMU + other + mixed)
        assert log.counts() == {"imu": 50}
        assert log.tables()["imu"]["x"].tolist() == list(range(50))
        assert log.counters["damaged_bytes"] >= 150 * len(odd[0])

    def test_messages_of_unknown_types_are_passed_over(self, tmp_path: Path) -> None:
        rows = [row + ulog_message("Z", b"whatever") for row in imu_rows(50)]
        log = opened(tmp_path, ulog_header(START_US) + IMU + b"".join(rows))
        assert log.tables()["imu"]["x"].tolist() == list(range(50))

    @pytest.mark.parametrize("path", sorted((FOLDER / "ulg_hang").glob("*")))
    def test_what_made_another_reader_hang_is_refused_at_once(self, path: Path) -> None:
        open_log(case("ulog-char-array/in.ulg"))  # compiles
        begun = time.monotonic()
        with pytest.raises(LogError, match=path.name):
            open_log(path)
        assert time.monotonic() - begun < 1.0

    def test_formats_without_end_are_refused_at_once(self, tmp_path: Path) -> None:
        formats = [f"f{depth}:f{depth + 1}[65535] a;f{depth + 1}[65535] b;" for depth in range(7)]
        data = ulog_header() + b"".join(ulog_message("F", text.encode()) for text in [*formats, "f7:", "me:me me;"])
        data += ulog_subscription(0, 0, "f0") + ulog_subscription(0, 1, "me") + IMU + b"".join(imu_rows(5))
        begun = time.monotonic()
        assert opened(tmp_path, data).counts() == {"imu": 5}
        assert time.monotonic() - begun < 1.0


class TestContent:
    def test_names_that_collide_are_kept_apart(self) -> None:
        made = open_log(case("ulog-name-collision/in.ulg")).tables()
        assert {name: len(table) for name, table in made.items()} == {"imu": 100, "imu_1": 100, "imu_1_2": 100}
        assert set(made["imu"]["x"]) == {1.0}
        assert set(made["imu_1"]["z"]) == {3.0}  # the topic of that name
        assert set(made["imu_1_2"]["x"]) == {2.0}  # the second instance of imu

    def test_a_topic_may_be_called_like_a_table_of_ours(self, tmp_path: Path) -> None:
        data = ulog_header(START_US) + topic("parameters", "uint64_t timestamp;float x;", 0)
        data += ulog_message("P", ulog_key("float P1") + struct.pack("<f", 2)) + b"".join(imu_rows(3))
        made = opened(tmp_path, data).tables()
        assert made["parameters"]["x"].tolist() == [0, 1, 2]
        assert made["parameters_2"]["value"].tolist() == [2]

    def test_characters_are_text(self) -> None:
        column = open_log(case("ulog-char-array/in.ulg")).tables()["kv"]["key"]
        assert plain(column)[:3] == [
            "altitude",
            "Gr\N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}e12345",
            "abcdefghij",
        ]

    def test_a_log_of_texts_only(self) -> None:
        log = open_log(case("ulog-only-text/in.ulg"))
        assert log.kind == PX4
        assert log.said == {"topics": 0, "logged_messages": 1, "parameters": 1, "information": {}}
        made = log.tables()
        assert made["logged_messages"]["message"].tolist() == ["[commander] crash"]
        assert made["logged_messages"]["level"].tolist() == [6]
        assert made["logged_messages"]["t_us"].tolist() == [START_US + 1]
        assert (made["parameters"]["name"][0], made["parameters"]["value"][0]) == ("P1", 1.5)

    def test_an_encrypted_log_is_named_for_what_it_is(self) -> None:
        with pytest.raises(LogError, match=r"in\.ulge is an encrypted PX4 log: decrypt it first"):
            open_log(case("ulog-encrypted/in.ulge"))

    def test_parameters_their_changes_and_information_are_pyulogs(self, tmp_path: Path) -> None:
        data = ulog_header(START_US) + ulog_message("Q", b"\x01" + ulog_key("float P1") + struct.pack("<f", 3))
        data += ulog_message("P", ulog_key("float P1") + struct.pack("<f", 2))
        data += ulog_message("P", ulog_key("int32_t P2") + struct.pack("<i", -7))
        data += ulog_message("I", ulog_key("char[3] sys_name") + b"PX4")
        data += ulog_message("I", ulog_key("uint32_t ver_sw_release") + struct.pack("<I", 17))
        data += ulog_message("M", b"\0" + ulog_key("char[4] notes") + b"one,")
        data += ulog_message("M", b"\1" + ulog_key("char[4] notes") + b" two")
        rows = imu_rows(10)
        change = ulog_message("P", ulog_key("float P1") + struct.pack("<f", 2.5))
        data += IMU + b"".join(rows[:5]) + change + b"".join(rows[5:])
        data += ulog_message("C", b"3" + struct.pack("<HQ", 9, START_US + 90_000) + b"tagged")
        log = opened(tmp_path, data)
        theirs = ULog(io.BytesIO(data))
        made = log.tables()
        ours = list(zip(made["parameters"]["name"].tolist(), made["parameters"]["value"].tolist(), strict=True))
        assert ours == [
            *theirs.initial_parameters.items(),
            *((name, value) for _, name, value in theirs.changed_parameters),
        ]
        assert made["parameters"]["t_us"].tolist() == [START_US, START_US, theirs.changed_parameters[0][0]]
        assert made["parameter_defaults"]["value"].tolist() == [3]
        assert log.said["information"] == {"sys_name": "PX4", "ver_sw_release": "17", "notes": "one, two"}
        assert theirs.msg_info_dict == {"sys_name": "PX4", "ver_sw_release": 17}
        (said,) = made["logged_messages"]
        assert (said["t_us"], said["level"], said["tag"], said["message"]) == (START_US + 90_000, 3, 9, "tagged")

    def test_what_a_crash_appended_is_read(self, tmp_path: Path) -> None:
        rows = b"".join(imu_rows(10))
        log = ulog_header(START_US) + IMU + rows
        cut = log[:-5]
        said = ulog_message("I", ulog_key("char[4] hardfault") + b"here")
        flags = bytes(8) + b"\x01" + bytes(7) + struct.pack("<3Q", len(cut), 0, 0)
        data = cut[:16] + ulog_message("B", flags) + cut[16 + 43 :] + said
        found = opened(tmp_path, data)
        assert found.counts() == {"imu": 9, "information": 1}
        assert found.counters["truncated_tail"] == 0
        assert found.counters["damaged_bytes"] == 17 - 5

    def test_a_format_that_changes_on_the_way(self, tmp_path: Path) -> None:
        data = ulog_header(START_US) + IMU + b"".join(imu_rows(3))
        data += topic("imu", "uint64_t timestamp;float x;float y;", 0)
        data += b"".join(
            ulog_message("D", struct.pack("<HQff", 0, START_US + 50_000 + row, row, 9)) for row in range(2)
        )
        table = opened(tmp_path, data).tables()["imu"]
        assert table["x"].tolist() == [0, 1, 2, 0, 1]
        assert np.isnan(table["y"][:3]).all()
        assert table["y"][3:].tolist() == [9, 9]

    def test_nested_formats_are_laid_flat(self, tmp_path: Path) -> None:
        table = opened(tmp_path, px4_log()).tables()["mode"]
        assert (table.dtype.names or ())[3:] == ("rotors[0].rpm", "rotors[0].name", "rotors[1].rpm", "rotors[1].name")
        assert table["rotors[0].rpm"].tolist() == [100, 105]
        assert plain(table["rotors[1].name"]) == ["r", "r"]


def test_a_log_is_one_even_without_any_data(tmp_path: Path) -> None:
    with contextlib.suppress(LogError):
        pytest.fail(repr(opened(tmp_path, ulog_header()).counts()))
