"""Probes of real peers, briefly, and of one that answers as it should not; cyclictest's words."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from bridge.endpoint import Endpoint
from bridge.latency.probes import ProbeResult
from bridge.links.link import Link
from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from bridge.timing.clock import MonotonicClock
from bridge.timing.timesync import Estimate
from fwav_hil.latency import peers
from fwav_hil.latency.peers import (
    cyclictest,
    lateness_of,
    probe_echo,
    probe_mavutil,
    probe_responder,
    probe_time_sync,
)
from protocol.errors import Interrupted, PeerMissingError
from protocol.messages import VEHICLE
from protocol.wire import mapping
from protocol.wire.codec import Frame

STATION = (255, 190)


def untold(_sent: int) -> None:
    pass


@pytest.mark.processes
@pytest.mark.parametrize("ask", [probe_responder, probe_echo, probe_mavutil])
def test_each_peer_answers(ask: Callable[..., ProbeResult]) -> None:
    result = ask(StopFlag(), rate_hz=200.0, count=40, told=untold)
    assert len(result.from_due_ns) == 40
    assert (result.duplicates, result.out_of_order, result.unknown) == (0, 0, 0)
    answered = result.from_sent_ns[result.from_sent_ns >= 0]
    assert len(answered) == 40, "loopback loses nothing, and the last ones are waited for"
    assert answered.min() > 1_000
    assert (result.from_due_ns >= result.from_sent_ns).all()


@contextmanager
def peer(answer: Callable[[Endpoint, Frame], list[bytes]]) -> Iterator[Link]:
    """A link with somebody at its other end who gives these datagrams for each frame that comes."""
    near, far = memory_pair()
    endpoint, stop = Endpoint(far, *VEHICLE), StopFlag()

    def serve() -> None:
        while not stop.requested:
            for frame in endpoint.receive(0.02):
                for datagram in answer(endpoint, frame):
                    far.send(datagram)

    with near, far, ThreadPoolExecutor(1) as threads:
        service = threads.submit(serve)
        try:
            yield near
        finally:
            stop.requested = True
            service.result(10.0)


def reply(endpoint: Endpoint, frame: Frame, *, ahead_ns: int = 0, asked_ns: int | None = None) -> bytes:
    _, ts1 = mapping.decode_timesync(frame.payload)
    told_ns = MonotonicClock().now_ns() + ahead_ns
    payload = mapping.encode_timesync(told_ns, ts1 if asked_ns is None else asked_ns)
    return endpoint.seal(mapping.TIMESYNC, payload)


def ask(link: Link, count: int = 10) -> tuple[ProbeResult, Estimate | None]:
    return probe_time_sync(link, StopFlag(), rate_hz=500.0, count=count, told=untold)


AHEAD_NS = 5 * 10**15


class TestTimeSync:
    def test_the_other_clock_is_told_within_its_bound(self) -> None:
        with peer(lambda endpoint, frame: [reply(endpoint, frame, ahead_ns=AHEAD_NS)]) as link:
            result, clock = ask(link)
        assert result.lost == 0
        assert clock is not None
        assert clock.answers == 10
        assert abs(clock.offset_ns - AHEAD_NS) <= clock.error_ns
        assert (
            clock.round_trip_ns == result.from_sent_ns.min() or clock.round_trip_ns <= result.from_sent_ns.min() + 10**5
        )

    def test_answers_said_twice_are_counted_once(self) -> None:
        def twice(endpoint: Endpoint, frame: Frame) -> list[bytes]:
            return [reply(endpoint, frame), reply(endpoint, frame, ahead_ns=AHEAD_NS)]

        with peer(twice) as link:
            result, clock = ask(link)
        assert result.lost == 0
        assert 8 <= result.duplicates <= 10, "the last ones may come when nobody listens any more"
        assert clock is not None
        assert clock.answers == 10
        assert abs(clock.offset_ns) <= clock.error_ns, "the first answer counts"

    def test_answers_to_what_nobody_asked_are_told_apart(self) -> None:
        with peer(lambda endpoint, frame: [reply(endpoint, frame, asked_ns=7), reply(endpoint, frame)]) as link:
            result, clock = ask(link)
        assert (result.lost, result.unknown, result.duplicates) == (0, 10, 0)
        assert clock is not None
        assert clock.answers == 10

    def test_a_line_that_gives_back_what_is_sent_is_no_peer(self) -> None:
        with peer(lambda endpoint, frame: [frame.raw]) as link:
            result, clock = probe_time_sync(link, StopFlag(), rate_hz=2000.0, count=10, told=untold)
        assert result.lost == 10
        assert clock is None

    def test_a_peer_that_asks_too_is_answered(self) -> None:
        heard: list[tuple[int, int]] = []

        def asking(endpoint: Endpoint, frame: Frame) -> list[bytes]:
            told_ns, ts1 = mapping.decode_timesync(frame.payload)
            if told_ns:
                heard.append((frame.system, ts1))
                return []
            question = endpoint.seal(mapping.TIMESYNC, mapping.encode_timesync(0, 42))
            return [question, b"\xfd noise", reply(endpoint, frame)]

        with peer(asking) as link:
            result, clock = ask(link)
        assert result.lost == 0
        assert clock is not None
        assert clock.answers == 10
        assert set(heard) == {(STATION[0], 42)}

    def test_nobody_there_is_no_clock(self) -> None:
        with peer(lambda endpoint, frame: []) as link:
            result, clock = ask(link, 3)
        assert result.lost == 3
        assert clock is None


def test_a_child_that_does_not_start_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/true")
    with pytest.raises(PeerMissingError, match="python -m nobody"), peers._child("nobody"):
        pass


class TestCyclictest:
    SAID = """# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000001 000003
000002 000001
# Total: 000000004
# Min Latencies: 00001
# Avg Latencies: 00001
# Max Latencies: 00500
# Histogram Overflows: 00002
# Histogram Overflow at cycle number:
# Thread 0: 00007 00009
"""

    def test_the_histogram_and_what_did_not_fit_into_it(self) -> None:
        found = lateness_of(self.SAID)
        assert found is not None
        assert found.tolist() == [1000, 1000, 1000, 2000, 500_000, 500_000]

    @pytest.mark.parametrize("said", ["", "unable to set scheduling policy\n", "# Histogram\n000000 000000\n"])
    def test_no_histogram_is_nothing(self, said: str) -> None:
        assert lateness_of(said) is None

    def run(self, program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: StopFlag) -> list[int] | None:
        path = tmp_path / "cyclictest"
        path.write_text(f"#!/bin/sh\n{program}")
        path.chmod(0o755)
        monkeypatch.setattr(shutil, "which", lambda _: str(path))
        found = cyclictest(stop, rate_hz=1000.0, seconds=0.1, told=untold)
        return None if found is None else found.tolist()

    def test_what_it_prints_is_read(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        said = self.run("echo 000003 000002\n", tmp_path, monkeypatch, StopFlag())
        assert said == [3000, 3000]

    def test_a_refusal_is_nothing(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        assert self.run("echo 000003 000002\nexit 1\n", tmp_path, monkeypatch, StopFlag()) is None

    def test_a_stop_ends_it_at_once(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        stop = StopFlag()
        stop.requested = True
        clock = MonotonicClock()
        begun_ns = clock.now_ns()
        with pytest.raises(Interrupted):
            self.run("exec sleep 60\n", tmp_path, monkeypatch, stop)
        assert clock.now_ns() - begun_ns < 30 * 10**9

    def test_it_is_nothing_where_it_is_not_installed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(shutil, "which", lambda _: None)
        monkeypatch.setattr(Path, "exists", lambda _: False)
        monkeypatch.setattr(subprocess, "Popen", None)
        assert cyclictest(StopFlag(), rate_hz=1000.0, seconds=0.1, told=untold) is None


def test_probes_of_ours_are_free_of_coordinated_omission_by_construction() -> None:
    """from_due counts what from_sent does not: it can only be larger."""
    with peer(lambda endpoint, frame: [reply(endpoint, frame)]) as link:
        result, _ = ask(link, 20)
    assert np.all(result.from_due_ns >= result.from_sent_ns)
