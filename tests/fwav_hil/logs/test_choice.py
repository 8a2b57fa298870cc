"""What of a log a user means: times, messages, systems, alike in every command."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import matrixpilot

from fwav_hil.logs.choice import choose, choose_frames, log_file, names_in, open_telemetry, time_of_day
from protocol.errors import LogError, UsageError
from protocol.logs.files import TELEMETRY, Log
from protocol.logs.scan import Scan, scan_tlog
from protocol.wire.codec import FrameWriter, layout
from tests.protocol.logs.log_records import FOREIGN, Pen
from tests.protocol.logs.own_logs import ardupilot_log

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


def log_of(scan: Scan) -> Log:
    return Log(Path("a.tlog"), TELEMETRY, scan, scan.counters, {})


def chosen(
    scan: Scan = SCAN,
    types: Sequence[str] = (),
    systems: Sequence[str] = (),
    start: str | None = None,
    end: str | None = None,
) -> np.typing.NDArray[np.void]:
    """The frames that the options leave, which are those of the tables too."""
    log = log_of(scan)
    choice = choose(log, types, systems, start, end)
    rows: np.typing.NDArray[np.void] = scan.frames[choose_frames(log, scan, choice)]
    made = log.tables(choice.names, between_us=choice.between_us, senders=choice.senders)
    assert sum(map(len, made.values())) == np.count_nonzero(rows["known"])
    return rows


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
        stamps_us = chosen(start=begin, end=end)["stamp_us"]
        assert set(((stamps_us - BEGIN_US) / 1e6).tolist()) == set(expected)

    def test_of_simulation_time_the_time_of_day_is_the_time_since_the_beginning(self) -> None:
        assert set(chosen(scan_of(0), start="00:00:08")["stamp_us"].tolist()) == {8_000_000, 9_000_000, 9_500_000}

    @pytest.mark.parametrize("text", ["noon", "", "12:00", "1:2:3:4", "00:61:00", "nan", "inf"])
    def test_what_is_no_time_is_refused(self, text: str) -> None:
        with pytest.raises(UsageError, match="is no time: write seconds"):
            chosen(start=text)

    def test_a_stamp_is_shown_as_the_time_of_its_day(self) -> None:
        assert time_of_day(BEGIN_US) == "23:59:58.0"
        assert time_of_day(3_725_900_000) == "01:02:05.9"


class TestKinds:
    def test_messages_by_name_in_any_case(self) -> None:
        rows = chosen(types=("attitude",))
        assert set(rows["message_id"].tolist()) == {layout("ATTITUDE").message_id}
        assert len(rows) == 10

    @pytest.mark.parametrize(
        "types", [("ATTITUDE,HEARTBEAT",), ("ATTITUDE", " heartbeat ", ""), ("HEARTBEAT,ATTITUDE,",)]
    )
    def test_names_may_be_repeated_or_joined(self, types: tuple[str, ...]) -> None:
        assert len(chosen(types=types)) == len(SCAN)

    def test_messages_that_the_dialect_lacks_by_their_number(self) -> None:
        pens = Pen(), Pen(matrixpilot)
        scan = scan_tlog(b"".join(pen.record(n).data for pen, n in ((pens[0], 30), (pens[1], FOREIGN[0])) * 9))
        name = f"UNKNOWN_{FOREIGN[0]}"
        assert names_in(log_of(scan)) == ["ATTITUDE", name]
        assert chosen(scan, types=(name,))["message_id"].tolist() == [FOREIGN[0]] * 9
        assert len(chosen(scan, types=(name.lower(), "ATTITUDE"))) == 18
        with pytest.raises(UsageError, match="holds no such message"):
            chosen(types=(name,))

    @pytest.mark.parametrize(
        ("systems", "count"), [(("1",), 20), (("2",), 1), (("1/191",), 10), (("1/191", "2"), 11), (("1", "2"), 21)]
    )
    def test_systems_and_components(self, systems: tuple[str, ...], count: int) -> None:
        assert len(chosen(systems=systems)) == count

    def test_a_name_that_the_log_lacks_is_told_with_one_like_it(self) -> None:
        with pytest.raises(
            UsageError, match=r"--types atitude: a\.tlog holds no such message; did you mean ATTITUDE\?"
        ):
            chosen(types=("atitude",))

    @pytest.mark.parametrize("text", ["one", "1/", "1/2/3", "-1", "256", "1/256"])
    def test_what_is_no_system_is_refused(self, text: str) -> None:
        with pytest.raises(UsageError, match="is no system"):
            chosen(systems=(text,))

    @pytest.mark.parametrize("options", [{"start": "20", "end": "30"}, {"systems": ("7",)}])
    def test_an_empty_selection_says_what_there_is(self, options: dict[str, tuple[str, ...]]) -> None:
        words = r"9\.5 s long, begins at 23:59:58\.0, holds HEARTBEAT, ATTITUDE, from 1/1, 1/191, 2/1"
        with pytest.raises(UsageError, match=words):
            chosen(**options)  # type: ignore[arg-type]

    @pytest.mark.parametrize("options", [{"start": "3", "end": "2"}, {"start": "20"}, {"end": "-1"}])
    def test_times_that_leave_nothing(self, options: dict[str, str]) -> None:
        with pytest.raises(UsageError, match=r"no time of a\.tlog is left between --from and --to: it is 9\.5 s long"):
            chosen(**options)  # type: ignore[arg-type]


class TestLogs:
    def test_a_run_folder_stands_for_its_log(self, tmp_path: Path) -> None:
        assert log_file(tmp_path) == tmp_path / "run.tlog"
        (tmp_path / "run.tlog").write_bytes(SCAN.data.tobytes())
        assert len(open_telemetry(tmp_path)[1]) == len(open_telemetry(tmp_path / "run.tlog")[1]) == len(SCAN)

    def test_an_autopilots_own_log_has_no_frames_to_replay(self, tmp_path: Path) -> None:
        (tmp_path / "1.BIN").write_bytes(ardupilot_log())
        with pytest.raises(
            LogError, match=r"1\.BIN holds no MAVLink frames, it is of the kind ArduPilot dataflash log"
        ):
            open_telemetry(tmp_path / "1.BIN")

    @pytest.mark.parametrize("content", [b"", b"hello world, this is not a log\n" * 20])
    def test_what_is_no_log_is_told(self, content: bytes, tmp_path: Path) -> None:
        (tmp_path / "a.tlog").write_bytes(content)
        with pytest.raises(LogError, match=r"a\.tlog holds no message: it is neither MAVLink telemetry"):
            open_telemetry(tmp_path / "a.tlog")
