"""Recording: kill-safe, honest about disks that refuse, never a word to the loop but when it must."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridge.links.memory import memory_pair
from bridge.recording.sidecar import LinkOfLog, index_path, link_numbers, read_sidecar, sidecar_path, was_sent
from bridge.recording.thread_recorder import Recorder, refuse_existing_log
from bridge.timing.clock import MonotonicClock
from fwav_hil.record import Listener
from protocol.errors import RunFolderError
from protocol.logs.tlog import read_tlog
from protocol.wire.codec import FrameWriter, layout
from tests.disk import small_disk

HEARTBEAT = layout("HEARTBEAT")
ONE_LINK = (LinkOfLog("mem://a", sent_by=((1, 191),)),)
TWO_LINKS = (LinkOfLog("mem://a"), LinkOfLog("mem://b"))
PATIENCE_S = 20.0


def numbered(count: int, system: int = 1, component: int = 1) -> list[bytes]:
    """Frames that carry their number."""
    writer = FrameWriter(system, component)
    return [writer.seal(HEARTBEAT, HEARTBEAT.pack_fields(custom_mode=n, mavlink_version=3)) for n in range(count)]


def numbers_in(path: Path) -> list[int]:
    return [int(HEARTBEAT.unpack_fields(frame.payload)["custom_mode"]) for _, frame in read_tlog(path)]


def recorder(
    path: Path, links: tuple[LinkOfLog, ...] = ONE_LINK, tell: Callable[[str], None] | None = None
) -> Recorder:
    return Recorder(path, links, stamps="Unix time", source={"scenario": "test", "seed": 7, "clock": None}, tell=tell)


def wait_until(condition: Callable[[], bool]) -> None:
    clock = MonotonicClock()
    give_up_ns = clock.now_ns() + round(PATIENCE_S * 1e9)
    while not condition():
        assert clock.now_ns() < give_up_ns, "waited in vain"
        clock.sleep_until_ns(clock.now_ns() + 2_000_000)


def is_told(log: Recorder, said: list[str]) -> bool:
    log.flush()
    return bool(said)


class TestLog:
    def test_every_frame_is_there_in_order_with_its_stamp(self, tmp_path: Path) -> None:
        frames = numbered(3000)
        with recorder(tmp_path / "a.tlog") as log:
            for n, frame in enumerate(frames):
                log.write(5 * n + 3, frame)
        assert [(t_us, frame.raw) for t_us, frame in read_tlog(tmp_path / "a.tlog")] == [
            (5 * n + 3, frame) for n, frame in enumerate(frames)
        ]

    def test_it_reaches_the_disk_without_a_flush(self, tmp_path: Path) -> None:
        with recorder(tmp_path / "a.tlog") as log:
            for frame in numbered(5):
                log.write(0, frame)
            wait_until(lambda: numbers_in(tmp_path / "a.tlog") == [0, 1, 2, 3, 4])

    def test_the_sidecar_says_whole_only_at_the_end(self, tmp_path: Path) -> None:
        path = tmp_path / "a.tlog"
        log = recorder(path)
        for frame in numbered(9):
            log.write(0, frame)
        assert read_sidecar(path)["complete"] is False
        log.sidecar["counters"]["late"] = 2
        log.close()
        log.close()
        expected = {"complete": True, "frames": 9, "bytes": path.stat().st_size, "lost": 0, "error": None, "seed": 7}
        content = read_sidecar(path)
        assert {key: content[key] for key in expected} == expected
        assert content["counters"] == {"late": 2}
        assert content["version"]
        assert not index_path(path).exists()

    def test_direction_is_told_by_who_sat_here(self, tmp_path: Path) -> None:
        with recorder(tmp_path / "a.tlog"):
            pass
        content = read_sidecar(tmp_path / "a.tlog")
        assert was_sent(content, 0, 1, 191)
        assert not was_sent(content, 0, 1, 1)
        assert not was_sent({}, 0, 1, 191)

    def test_another_program_s_file_of_that_name_is_no_sidecar(self, tmp_path: Path) -> None:
        sidecar_path(tmp_path / "a.tlog").write_text('{"format": "else"}')
        assert read_sidecar(tmp_path / "a.tlog") == {}
        assert read_sidecar(tmp_path / "none.tlog") == {}

    def test_the_link_of_each_frame_is_recovered(self, tmp_path: Path) -> None:
        path, choice = tmp_path / "a.tlog", random.Random(3)
        expected, places = [], []
        with recorder(path, TWO_LINKS) as log:
            place = 0
            for frame in numbered(500):
                link = choice.randrange(2)
                log.write(0, frame, link)
                expected.append(link)
                places.append(place)
                place += 8 + len(frame)
        assert link_numbers(path, np.array(places)).tolist() == expected
        assert len(numbers_in(path)) == 500

    def test_a_log_of_one_link_needs_no_index(self, tmp_path: Path) -> None:
        with recorder(tmp_path / "a.tlog") as log:
            log.write(0, numbered(1)[0])
        assert link_numbers(tmp_path / "a.tlog", np.array([0])).tolist() == [0]

    def test_many_threads_lose_nothing(self, tmp_path: Path) -> None:
        sets = [numbered(400, component=c) for c in range(1, 5)]
        with recorder(tmp_path / "a.tlog", TWO_LINKS) as log:

            def write(frames: list[bytes]) -> None:
                for frame in frames:
                    log.write(1, frame, 1)

            threads = [threading.Thread(target=write, args=(frames,)) for frames in sets]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        found = [frame.raw for _, frame in read_tlog(tmp_path / "a.tlog")]
        for frames in sets:
            assert [raw for raw in found if raw in set(frames)] == frames

    @pytest.mark.parametrize("name", ["a.tlog", "a.tlog.json", "a.tlog.links"])
    def test_nothing_that_is_there_is_overwritten(self, name: str, tmp_path: Path) -> None:
        refuse_existing_log(tmp_path / "a.tlog")
        (tmp_path / name).write_text("kept")
        with pytest.raises(RunFolderError, match=f"{name} exists and is not overwritten"):
            refuse_existing_log(tmp_path / "a.tlog")


class TestDiskThatRefuses:
    @pytest.mark.parametrize("name", ["no/such/folder/a.tlog", "."])
    def test_a_place_that_cannot_be_written_is_told_at_once(self, name: str, tmp_path: Path) -> None:
        with pytest.raises(RunFolderError, match="cannot write the log"):
            recorder(tmp_path / name)

    def test_a_sidecar_that_cannot_be_written_leaves_no_log_behind(self, tmp_path: Path) -> None:
        sidecar_path(tmp_path / "a.tlog").mkdir()
        with pytest.raises(RunFolderError, match="cannot begin the log"):
            recorder(tmp_path / "a.tlog")
        assert not (tmp_path / "a.tlog").exists()

    def test_a_full_disk_is_an_error_within_moments_and_said_once(self, tmp_path: Path) -> None:
        path = tmp_path / "a.tlog"
        log = recorder(path)
        with small_disk(700):
            said = self._write_until_told(log)
            log.write(0, numbered(1)[0])  # no second time
            log.close()  # the new sidecar does not fit either: the one from the beginning stays
        assert "cannot write the log" in said
        assert read_sidecar(path)["complete"] is False
        kept = numbers_in(path)
        assert kept == list(range(len(kept)))
        assert path.stat().st_size == sum(8 + len(frame) for frame in numbered(len(kept)))

    @staticmethod
    def _write_until_told(log: Recorder) -> str:
        told = ""

        def write_all() -> bool:
            nonlocal told
            try:
                for frame in numbered(100):
                    log.write(0, frame)
            except RunFolderError as error:
                told = str(error)
            return bool(told)

        wait_until(write_all)
        return told

    def test_told_of_it_the_loop_goes_on_and_the_sidecar_counts(self, tmp_path: Path) -> None:
        path = tmp_path / "a.tlog"
        said: list[str] = []
        log = recorder(path, tell=said.append)
        frames = numbered(200)
        with small_disk(2000):
            for frame in frames:
                log.write(0, frame)
            wait_until(lambda: is_told(log, said))
            log.close()  # the sidecar still fits
        content = read_sidecar(path)
        kept = numbers_in(path)
        assert len(said) == 1
        assert "File too large" in said[0]
        assert 0 < len(kept) < 200
        assert kept == list(range(len(kept)))
        assert (content["complete"], content["frames"], content["lost"]) == (False, len(kept), 200 - len(kept))
        assert path.stat().st_size == content["bytes"] == sum(8 + len(frame) for frame in frames[: len(kept)])

    def test_once_there_is_room_again_nothing_is_lost(self, tmp_path: Path) -> None:
        path = tmp_path / "a.tlog"
        said: list[str] = []
        with recorder(path, tell=said.append) as log:
            with small_disk(1000):
                for frame in numbered(200):
                    log.write(0, frame)
                wait_until(lambda: is_told(log, said))
            log.write(0, numbered(201)[-1])
        assert numbers_in(path) == list(range(201))
        content = read_sidecar(path)
        assert (content["complete"], content["lost"], content["frames"]) == (True, 0, 201)
        assert "File too large" in content["error"]


LOST_AT_MOST_S = 0.1
LONGEST_STEP_NS = 5_000_000
"""A gap between two frames that is longer than this was no running: the machine had other things to do."""
ROOM = 20_000


def record_until_killed(folder: str) -> None:
    """The recording process: a source sends numbered frames over a link, a listener records them, for ever."""
    times = np.memmap(Path(folder) / "sent.bin", dtype=np.int64, mode="r+", shape=(ROOM,))
    near, far = memory_pair()
    log = recorder(Path(folder) / "a.tlog")
    threading.Thread(target=Listener(0, far, log).run, daemon=True).start()
    clock, writer = MonotonicClock(), FrameWriter(1, 1)
    for number in range(ROOM):
        near.send(writer.seal(HEARTBEAT, HEARTBEAT.pack_fields(custom_mode=number, mavlink_version=3)))
        times[number] = clock.now_ns()
        clock.sleep_until_ns(times[number] + 500_000)


def test_killed_at_any_moment_it_has_lost_less_than_the_last_100_ms(tmp_path: Path) -> None:
    # The server forks each recording process, so that none has to load the libraries anew.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    clock, chance = MonotonicClock(), random.Random(11)
    worst_s, recorded = 0.0, 0
    for kill in range(50):
        folder = tmp_path / str(kill)
        folder.mkdir()
        times = np.memmap(folder / "sent.bin", dtype=np.int64, mode="w+", shape=(ROOM,))
        process: Any = context.Process(target=record_until_killed, args=(str(folder),), daemon=True)
        process.start()
        wait_until(lambda times=times: bool(times[0]))  # type: ignore[misc]
        clock.sleep_until_ns(clock.now_ns() + round(chance.uniform(0.0, 0.17) * 1e9))
        os.kill(process.pid, signal.SIGKILL)
        process.join()

        sent = times[: np.count_nonzero(times)]
        found = numbers_in(folder / "a.tlog")
        assert found == list(range(len(found))), "every frame but the last ones, each once"
        steps_ns = np.minimum(np.diff(sent[len(found) :]), LONGEST_STEP_NS)
        worst_s = max(worst_s, float(steps_ns.sum()) * 1e-9)
        recorded += len(found)
        assert json.loads(sidecar_path(folder / "a.tlog").read_text())["complete"] is False
    assert worst_s < LOST_AT_MOST_S
    assert recorded > 1000, "the kills came too early to show anything"
