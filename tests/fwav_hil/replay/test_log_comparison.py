"""Two logs compared: what is paired with what, tolerances, what the exit code says."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import fastcrc
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import matrixpilot

from fwav_hil.replay.log_comparison import LogDifference, Tolerances, compare_logs, parse_tolerances
from protocol.errors import UsageError
from protocol.logs.scan import Scan, scan_tlog
from protocol.logs.tlog import TlogWriter, read_tlog
from protocol.wire.codec import FrameWriter, layout
from tests.fwav_hil.replay.conftest import Command
from tests.protocol.logs.log_records import FOREIGN, Pen

EXACT = Tolerances()


class Log:
    """A log, message by message."""

    def __init__(self) -> None:
        self._data = bytearray()

    def add(self, name: str, system: int = 1, stamp_us: int = 0, sequence: int = 0, **values: Any) -> Log:
        writer = FrameWriter(system, 1)
        writer.sequence = sequence
        frame = writer.seal(layout(name), layout(name).pack_fields(**values))
        self._data += struct.pack(">Q", stamp_us) + frame
        return self

    @property
    def scan(self) -> Scan:
        return scan_tlog(bytes(self._data))


def attitudes(rolls: dict[int, float], **changes: Any) -> Log:
    log = Log()
    for time_ms, roll in rolls.items():
        log.add("ATTITUDE", time_boot_ms=time_ms, roll=roll, **changes)
    return log


def field(difference: LogDifference, name: str) -> Any:
    (found,) = (one for one in difference.fields if one.field == name)
    return found


class TestPairs:
    def test_a_log_is_the_same_as_itself(self) -> None:
        scan = attitudes({0: 0.5, 4: float("nan"), 8: float("inf")}).scan
        difference = compare_logs(scan, scan, EXACT)
        assert difference.is_same
        assert field(difference, "roll").pairs == 3

    def test_rows_are_paired_by_their_time_not_by_their_place(self) -> None:
        difference = compare_logs(
            attitudes({0: 0.0, 4: 0.25, 8: 0.5}).scan, attitudes({4: 0.25, 8: 1.5, 12: 7.0}).scan, EXACT
        )
        roll = field(difference, "roll")
        assert (roll.pairs, roll.beyond, roll.largest, roll.first_s) == (2, 1, 1.0, 0.008)
        assert roll.rms == pytest.approx(np.sqrt(0.5))
        assert difference.only_first == difference.only_second == {"ATTITUDE 1/1": 1}
        assert not difference.is_same

    def test_stamps_and_sequence_numbers_do_not_count(self) -> None:
        one, two = attitudes({0: 0.5, 4: 0.25}), attitudes({0: 0.5, 4: 0.25}, stamp_us=99, sequence=7)
        assert compare_logs(one.scan, two.scan, EXACT).is_same

    def test_of_two_at_one_time_the_first_goes_with_the_first(self) -> None:
        one = attitudes({0: 1.0}).add("ATTITUDE", time_boot_ms=0, roll=2.0)
        two = attitudes({0: 1.0}).add("ATTITUDE", time_boot_ms=0, roll=3.0)
        assert field(compare_logs(one.scan, two.scan, EXACT), "roll").largest == 1.0

    def test_systems_are_told_apart(self) -> None:
        one = Log().add("ATTITUDE", system=1, roll=1.0).add("ATTITUDE", system=2, roll=2.0)
        two = Log().add("ATTITUDE", system=2, roll=2.0).add("ATTITUDE", system=1, roll=1.0)
        assert compare_logs(one.scan, two.scan, EXACT).is_same

    def test_times_since_1970_count_from_the_first(self) -> None:
        one, two = Log(), Log()
        for log, begin_us in ((one, 1_700_000_000_000_000), (two, 1_795_000_000_000_000)):
            for k in range(3):
                log.add("GPS_RAW_INT", time_usec=begin_us + k, lat=k)
        assert compare_logs(one.scan, two.scan, EXACT).is_same

    def test_a_message_without_a_time_is_paired_by_its_place(self) -> None:
        one = Log().add("HEARTBEAT", custom_mode=1, stamp_us=5_000_000).add("HEARTBEAT", custom_mode=2)
        two = Log().add("HEARTBEAT", custom_mode=1).add("HEARTBEAT", custom_mode=5)
        mode = field(compare_logs(one.scan, two.scan, EXACT), "custom_mode")
        assert (mode.pairs, mode.beyond, mode.largest) == (2, 1, 3.0)

    def test_unsigned_numbers_and_texts(self) -> None:
        one = Log().add("GPS_RAW_INT", time_usec=1, eph=1).add("STATUSTEXT", text=b"up")
        two = Log().add("GPS_RAW_INT", time_usec=1, eph=65535).add("STATUSTEXT", text=b"down")
        difference = compare_logs(one.scan, two.scan, Tolerances(100_000.0))
        assert field(difference, "eph").largest == 65534.0
        assert not field(difference, "eph").beyond
        assert field(difference, "text").beyond == 1

    @pytest.mark.parametrize(
        ("message", "name", "one", "two", "apart"),
        [
            ("HIL_GPS", "vn", -20_000, 20_000, 40_000.0),  # more than an int16 holds
            ("GLOBAL_POSITION_INT", "lat", 2**31 - 1, -(2**31), 2.0**32 - 1),
            ("SCALED_IMU", "xacc", -32_768, 32_767, 65_535.0),
            ("TIMESYNC", "tc1", -(2**63), 2**63 - 1, 2.0**64),
            ("TIMESYNC", "tc1", -5, -3, 2.0),
        ],
    )
    def test_signed_numbers_at_the_two_ends_of_their_kind(
        self, message: str, name: str, one: int, two: int, apart: float
    ) -> None:
        for pair in ((one, two), (two, one)):
            logs = [Log().add(message, **{name: value}).scan for value in pair]
            found = field(compare_logs(logs[0], logs[1], Tolerances(1.0)), name)
            assert (found.largest, found.beyond) == (apart, 1)

    def test_messages_that_the_dialect_lacks_are_compared_by_their_bytes(self) -> None:
        def log(change: int, count: int) -> Scan:
            pen = Pen(matrixpilot)
            data = bytearray(b"".join(pen.record(FOREIGN[0]).data for _ in range(count)))
            scan = scan_tlog(bytes(data))
            assert scan.counters["unknown_frames"] == count
            if change:  # a payload, and the checksum made to fit with the seed that is right for it
                at = int(scan.frames["offset"][3])
                end = at + 10 + data[at + 1]
                data[at + 12] ^= change
                seed = bytes([matrixpilot.mavlink_map[FOREIGN[0]].crc_extra])
                data[end : end + 2] = fastcrc.crc16.mcrf4xx(bytes(data[at + 1 : end]) + seed).to_bytes(2, "little")
            return scan_tlog(bytes(data))

        same = compare_logs(log(0, 9), log(0, 9), EXACT)
        assert same.is_same
        assert field(same, "payload").pairs == 9
        changed = compare_logs(log(0, 9), log(1, 8), Tolerances(1e9))
        assert (field(changed, "payload").pairs, field(changed, "payload").beyond) == (8, 1)
        assert changed.only_first == {f"UNKNOWN_{FOREIGN[0]} {field(changed, 'payload').sender}": 1}
        assert not changed.is_same
        assert not compare_logs(log(0, 9), log(1, 9), EXACT, ["ATTITUDE"]).fields

    def test_nothing_compared_is_not_the_same(self) -> None:
        assert not compare_logs(attitudes({0: 1.0}).scan, attitudes({4: 1.0}).scan, EXACT).is_same

    @given(st.lists(st.integers(0, 20), max_size=40), st.lists(st.integers(0, 20), max_size=40))
    def test_as_many_pairs_as_both_have_at_each_time(self, first: list[int], second: list[int]) -> None:
        logs = []
        for times in (first, second):
            log = Log()
            for time_ms in times:
                log.add("ATTITUDE", time_boot_ms=time_ms, roll=float(time_ms))
            logs.append(log.scan)
        difference = compare_logs(logs[0], logs[1], EXACT)
        expected = sum(min(first.count(t), second.count(t)) for t in set(first))
        assert sum(one.pairs for one in difference.fields if one.field == "roll") == expected
        assert not any(one.changed for one in difference.fields), "paired by time: the values follow from it"
        assert difference.only_first.get("ATTITUDE 1/1", 0) == len(first) - expected
        assert difference.only_second.get("ATTITUDE 1/1", 0) == len(second) - expected


class TestTolerance:
    ONE, TWO = attitudes({0: 0.5}).scan, attitudes({0: 0.625}).scan

    @pytest.mark.parametrize(
        ("texts", "same"),
        [
            ([], False),
            (["0.125"], True),
            (["0.12"], False),
            (["roll=0.125"], True),
            (["ATTITUDE.roll=0.125"], True),
            (["ATTITUDE.roll=0.1", "roll=1", "1"], False),
            (["pitch=1"], False),
        ],
    )
    def test_of_a_field_of_a_message_or_of_all(self, texts: list[str], same: bool) -> None:
        assert compare_logs(self.ONE, self.TWO, parse_tolerances(texts)).is_same is same

    @pytest.mark.parametrize(
        "texts", [["roll=wide"], ["-1"], ["roll=-1"], ["roll=nan"], ["rol=1"], ["ATITUDE.roll=1"], [""]]
    )
    def test_what_is_none_is_refused(self, texts: list[str]) -> None:
        with pytest.raises(UsageError, match="--tolerance"):
            parse_tolerances(texts)

    def test_nan_on_one_side_only_is_beyond_any_tolerance(self) -> None:
        difference = compare_logs(self.ONE, attitudes({0: float("nan")}).scan, Tolerances(1e9))
        assert field(difference, "roll").beyond == 1
        assert not difference.is_same


class TestCommand:
    def test_a_run_against_itself(
        self, fwav_hil: Command, run_folder: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert fwav_hil("diff", run_folder, run_folder / "run.tlog", "--json", "-") == 0
        said = capsys.readouterr()
        result = json.loads(said.out)
        assert result["same"]
        assert {one["message"] for one in result["fields"]} >= {"ATT_POS_MOCAP", "HIL_SENSOR", "HIL_ACTUATOR_CONTROLS"}
        assert "identical" in said.err

    def test_one_value_changed(
        self, fwav_hil: Command, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        pose = layout("ATT_POS_MOCAP")
        with TlogWriter(tmp_path / "b.tlog") as log:
            for k, (t_us, frame) in enumerate(read_tlog(run_folder / "run.tlog")):
                raw = frame.raw
                if frame.message_id == pose.message_id and t_us == 200_000:
                    values = pose.unpack_fields(frame.payload)
                    raw = FrameWriter(frame.system, frame.component).seal(
                        pose, pose.pack_fields(**values | {"y": values["y"] + 0.5})
                    )
                log.write(t_us + k, raw)
        assert fwav_hil("diff", run_folder, "b.tlog") == 1
        said = capsys.readouterr().out
        assert "ATT_POS_MOCAP.y" in said
        assert "0.200" in said
        assert "different: 1 of" in said
        assert fwav_hil("diff", run_folder, "b.tlog", "--tolerance", "ATT_POS_MOCAP.y=0.51") == 0
        assert fwav_hil("diff", run_folder, "b.tlog", "--types", "hil_sensor") == 0

    @pytest.mark.parametrize(
        ("second", "arguments", "code", "words"),
        [
            ("nowhere.tlog", (), 2, "nowhere.tlog"),
            ("text.tlog", (), 6, "holds no message"),
            ("run", ("--types", "GPS_RAW_INT"), 2, "holds no such message"),
            ("run", ("--tolerance", "what=ever"), 2, "--tolerance what=ever"),
        ],
    )
    def test_trouble_has_other_exit_codes(
        self, second: str, arguments: tuple[str, ...], code: int, words: str, fwav_hil: Command, run_folder: Path,
        tmp_path: Path, capsys: pytest.CaptureFixture[str],
    ) -> None:  # fmt: skip
        (tmp_path / "text.tlog").write_text("no log")
        assert fwav_hil("diff", run_folder, run_folder if second == "run" else second, *arguments) == code
        said = capsys.readouterr().err.strip()
        assert words in said
        assert len(said.splitlines()) == 1
