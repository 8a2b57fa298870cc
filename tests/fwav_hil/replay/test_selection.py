"""Which frames of a log a user means."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from fwav_hil.replay.selection import Choice, choose, log_file, open_log, split_names, time_of_day
from protocol.errors import LogError, UsageError
from protocol.log_scan import Scan, scan_tlog
from protocol.mavlink_codec import FrameWriter, layout

DAY_US = 86_400_000_000
BEGIN_US = 20_000 * DAY_US + (23 * 3600 + 59 * 60 + 58) * 1_000_000  # 23:59:58 UTC


def scan_of(begin_us: int) -> Scan:
    """Ten seconds: each second an ATTITUDE of 1/1 and a HEARTBEAT of 1/191, and one of 2/1 at the end."""
    writers = [FrameWriter(1, 1), FrameWriter(1, 191), FrameWriter(2, 1)]
    attitude, heartbeat = layout("ATTITUDE"), layout("HEARTBEAT")
    records = []
    for second in range(10):
        stamp = struct.pack(">Q", begin_us + second * 1_000_000)
        records.append(stamp + writers[0].seal(attitude, attitude.pack_fields(time_boot_ms=second)))
        records.append(stamp + writers[1].seal(heartbeat, heartbeat.pack_fields(type=second)))
    records.append(struct.pack(">Q", begin_us + 9_500_000) + writers[2].seal(heartbeat, heartbeat.pack_fields(type=1)))
    return scan_tlog(b"".join(records))


SCAN = scan_of(BEGIN_US)


def seconds_of(choice: Choice, scan: Scan = SCAN) -> list[float]:
    stamps = scan.frames["stamp_us"][choose(scan, choice)]
    return sorted(set(((stamps - scan.frames["stamp_us"][0]) / 1e6).tolist()))


class TestTimes:
    @pytest.mark.parametrize(
        ("begin", "end", "expected"),
        [
            (None, None, [*range(10), 9.5]),
            ("7", None, [7, 8, 9, 9.5]),
            (None, "1.5", [0, 1]),
            ("2", "4", [2, 3, 4]),
            ("23:59:59", "23:59:59.5", [1]),
            ("00:00:05", None, [7, 8, 9, 9.5]),  # after midnight
            ("0:00:00", "0:00:01", [2, 3]),
        ],
    )
    def test_seconds_since_the_beginning_or_time_of_day(
        self, begin: str | None, end: str | None, expected: list[float]
    ) -> None:
        assert seconds_of(Choice(begin=begin, end=end)) == expected

    def test_of_simulation_time_the_time_of_day_is_the_time_since_the_beginning(self) -> None:
        assert seconds_of(Choice(begin="00:00:08"), scan_of(0)) == [8, 9, 9.5]

    @pytest.mark.parametrize("text", ["noon", "", "12:00", "1:2:3:4", "00:61:00", "nan", "inf"])
    def test_what_is_no_time_is_refused(self, text: str) -> None:
        with pytest.raises(UsageError, match="is no time: write seconds"):
            choose(SCAN, Choice(begin=text))

    def test_a_stamp_is_shown_as_the_time_of_its_day(self) -> None:
        assert time_of_day(BEGIN_US) == "23:59:58.0"
        assert time_of_day(3_725_900_000) == "01:02:05.9"


class TestKinds:
    def test_messages_by_name_in_any_case(self) -> None:
        chosen = SCAN.frames[choose(SCAN, Choice(types=("attitude",)))]
        assert set(chosen["message_id"].tolist()) == {layout("ATTITUDE").message_id}
        assert len(chosen) == 10

    @pytest.mark.parametrize(
        ("systems", "count"), [(("1",), 20), (("2",), 1), (("1/191",), 10), (("1/191", "2"), 11), (("1", "2"), 21)]
    )
    def test_systems_and_components(self, systems: tuple[str, ...], count: int) -> None:
        assert np.count_nonzero(choose(SCAN, Choice(systems=systems))) == count

    def test_a_name_that_none_has_is_told_with_one_like_it(self) -> None:
        with pytest.raises(UsageError, match="no message atitude: did you mean ATTITUDE"):
            choose(SCAN, Choice(types=("atitude",)))

    @pytest.mark.parametrize("text", ["one", "1/", "1/2/3", "-1"])
    def test_what_is_no_system_is_refused(self, text: str) -> None:
        with pytest.raises(UsageError, match="is no system"):
            choose(SCAN, Choice(systems=(text,)))

    @pytest.mark.parametrize(
        "choice",
        [Choice(begin="20"), Choice(systems=("7",)), Choice(types=("GPS_RAW_INT",)), Choice(begin="3", end="2")],
    )
    def test_an_empty_selection_says_what_there_is(self, choice: Choice) -> None:
        with pytest.raises(UsageError, match=r"9\.5 s long, begins at 23:59:58\.0 and holds ATTITUDE, HEARTBEAT"):
            choose(SCAN, choice)

    def test_names_may_be_repeated_or_joined(self) -> None:
        assert split_names(("A,B", " C ", "")) == ("A", "B", "C")


class TestLogs:
    def test_a_run_folder_stands_for_its_log(self, run_folder: Path) -> None:
        assert log_file(run_folder) == run_folder / "run.tlog"
        assert len(open_log(run_folder)) == len(open_log(run_folder / "run.tlog")) > 300

    @pytest.mark.parametrize("content", [b"", b"hello world, this is not a log\n" * 20])
    def test_what_is_no_log_is_told(self, content: bytes, tmp_path: Path) -> None:
        (tmp_path / "a.tlog").write_bytes(content)
        with pytest.raises(LogError, match=r"a\.tlog is no telemetry log"):
            open_log(tmp_path / "a.tlog")
