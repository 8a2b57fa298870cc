"""The loop's recorder: whole and in order whatever becomes of its writer, its disk or its own process."""

from __future__ import annotations

import multiprocessing
import os
import random
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bridge.recording.ring_recorder import RingRecorder
from bridge.recording.sidecar import LinkOfLog, read_sidecar, sidecar_path
from bridge.timing.clock import MonotonicClock
from protocol.errors import RunFolderError
from tests.bridge.recording.test_thread_recorder import numbered, numbers_in, wait_until
from tests.disk import small_disk

LINK = LinkOfLog("mem://a", sent_by=((1, 191),))
FRAMES = numbered(3000)


def recorder(path: Path, *, may_wait: bool = True, capacity: int = 1 << 20, **more: object) -> RingRecorder:
    return RingRecorder(
        path, LINK, stamps="Unix time", source={"scenario": "test"}, may_wait=may_wait, capacity=capacity, **more  # type: ignore[arg-type]
    )  # fmt: skip


@contextmanager
def small_disk_for(log: RingRecorder, room: int) -> Iterator[None]:
    """A disk with little room, for the writer and for this process."""
    resource.prlimit(log.writer_pid, resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
    with small_disk(room):
        yield


def after_flush(log: RingRecorder) -> RingRecorder:
    log.flush()
    return log


def test_every_frame_is_there_in_order_and_the_sidecar_says_so(tmp_path: Path) -> None:
    log = recorder(tmp_path / "a.tlog")
    assert read_sidecar(log.path)["complete"] is False
    for n, frame in enumerate(FRAMES):
        log.write(n, frame)
        if n % 3 == 0:
            log.hand_over()
    log.close()
    log.close()
    assert numbers_in(log.path) == list(range(3000))
    sidecar = read_sidecar(log.path)
    assert (sidecar["complete"], sidecar["frames"], sidecar["lost"], sidecar["error"]) == (True, 3000, 0, None)
    assert sidecar["bytes"] == log.path.stat().st_size


def test_what_is_handed_over_is_on_disk_soon_without_a_flush(tmp_path: Path) -> None:
    log = recorder(tmp_path / "a.tlog")
    log.write(0, FRAMES[0])
    log.hand_over()
    wait_until(lambda: numbers_in(log.path) == [0])
    log.close()


def test_a_writer_that_is_killed_is_replaced_and_nothing_is_lost_or_doubled(tmp_path: Path) -> None:
    log, generator = recorder(tmp_path / "a.tlog"), random.Random(3)
    kills = sorted(generator.sample(range(3000), 4))
    for n, frame in enumerate(FRAMES):
        log.write(n, frame)
        log.hand_over()
        if n in kills:
            os.kill(log.writer_pid, signal.SIGKILL)
            killed = log.restarts
            wait_until(lambda killed=killed: after_flush(log).restarts > killed)  # type: ignore[misc]
    log.close()
    assert numbers_in(log.path) == list(range(3000))
    assert read_sidecar(log.path)["writer"]["restarts"] == 4


def _record_until_killed(path: Path, pipe: int) -> None:
    log = recorder(path)
    for n, frame in enumerate(numbered(200_000)):
        log.write(n, frame)
        log.hand_over()
        if n % 500 == 0:
            os.write(pipe, b".")


def test_a_recording_process_that_is_killed_loses_nothing_it_handed_over(tmp_path: Path) -> None:
    for attempt in range(3):
        path, (reader, writer) = tmp_path / f"{attempt}.tlog", os.pipe()
        process = multiprocessing.get_context("fork").Process(target=_record_until_killed, args=(path, writer))
        process.start()
        os.close(writer)
        for _ in range(2 + attempt):
            os.read(reader, 1)
        process.kill()
        process.join()
        dots = 2 + attempt
        while os.read(reader, 1):
            dots += 1
        os.close(reader)
        wait_until(lambda path=path, dots=dots: len(numbers_in(path)) > 500 * (dots - 1))  # type: ignore[misc]
        numbers = numbers_in(path)
        assert numbers == list(range(len(numbers)))
        assert read_sidecar(path)["complete"] is False


def test_in_real_time_a_full_ring_loses_frames_and_counts_them(tmp_path: Path) -> None:
    log = recorder(tmp_path / "a.tlog", may_wait=False, capacity=4096)
    os.kill(log.writer_pid, signal.SIGSTOP)
    for n in range(500):
        log.write(n, FRAMES[n])
        log.hand_over()
    assert log.lost > 0
    os.kill(log.writer_pid, signal.SIGCONT)
    log.close()
    numbers = numbers_in(log.path)
    assert numbers == list(range(500 - log.lost))
    sidecar = read_sidecar(log.path)
    assert (sidecar["complete"], sidecar["lost"], sidecar["frames"]) == (False, log.lost, len(numbers))


def test_in_lockstep_a_full_ring_is_waited_for(tmp_path: Path) -> None:
    log = recorder(tmp_path / "a.tlog", capacity=4096)
    for n, frame in enumerate(FRAMES):
        log.write(n, frame)
        log.hand_over()
    log.close()
    assert numbers_in(log.path) == list(range(3000))


def test_a_disk_that_refuses_is_told_once_and_the_log_ends_with_a_whole_record(tmp_path: Path) -> None:
    said: list[str] = []
    log = recorder(tmp_path / "a.tlog", tell=said.append)
    with small_disk_for(log, 5000):
        for n, frame in enumerate(FRAMES[:500]):
            log.write(n, frame)
            log.hand_over()
        wait_until(lambda: after_flush(log) is log and bool(said))
        log.flush()
        log.close()
    assert len(said) == 1
    assert "a.tlog" in said[0]
    numbers = numbers_in(log.path)
    assert numbers == list(range(len(numbers)))
    assert 0 < len(numbers) < 500
    sidecar = read_sidecar(log.path)
    assert (sidecar["complete"], sidecar["lost"]) == (False, 500 - len(numbers))
    assert sidecar["bytes"] == log.path.stat().st_size


def test_without_somebody_to_tell_a_disk_that_refuses_is_an_error(tmp_path: Path) -> None:
    log = recorder(tmp_path / "a.tlog")
    with small_disk_for(log, 5000):
        for n, frame in enumerate(FRAMES[:500]):
            log.write(n, frame)
        with pytest.raises(RunFolderError, match=r"a\.tlog"):
            log.close()
    log.close()


def test_a_place_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError):
        recorder(tmp_path / "nowhere" / "a.tlog")
    sidecar_path(tmp_path / "b.tlog").mkdir()
    with pytest.raises(RunFolderError):
        recorder(tmp_path / "b.tlog")
    assert not (tmp_path / "b.tlog").exists()


def test_handing_over_takes_no_time_while_the_writer_stands_still(tmp_path: Path) -> None:
    log, clock = recorder(tmp_path / "a.tlog", may_wait=False), MonotonicClock()
    os.kill(log.writer_pid, signal.SIGSTOP)
    begun_ns = clock.now_ns()
    for n in range(1000):
        log.write(n, FRAMES[n])
        log.hand_over()
    assert clock.now_ns() - begun_ns < 5_000_000_000  # it would be forever if it waited
    os.kill(log.writer_pid, signal.SIGCONT)
    log.close()
    assert numbers_in(log.path) == list(range(1000))
