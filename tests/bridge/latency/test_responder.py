"""The responder: TIMESYNC answered as an autopilot does, in this process and as a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import bridge
from bridge.endpoint import Endpoint
from bridge.latency.responder import main, respond
from bridge.links.link import counterpart, open_link
from bridge.links.memory import memory_pair
from bridge.process import StopFlag
from bridge.timing.clock import MonotonicClock
from bridge.timing.timesync import TimeSync
from protocol.messages import VEHICLE
from protocol.wire import mapping
from tests.contracts.link_contract import PATIENCE_S

ROOT = Path(str(bridge.__file__)).resolve().parent.parent
STATION = (255, 190)


def test_it_answers_questions_and_nothing_else_until_it_is_stopped() -> None:
    near, far = memory_pair()
    stop = StopFlag()
    station = Endpoint(near, *STATION)
    with near, far, ThreadPoolExecutor(1) as threads:
        service = threads.submit(respond, Endpoint(far, 1, 1), stop)
        try:
            near.send(b"\xfd no frame")
            station.send([station.seal(mapping.HEARTBEAT, mapping.encode_emulator_heartbeat())])
            station.send([station.seal(mapping.TIMESYNC, mapping.encode_timesync(123, 456))])  # an answer
            before_ns = MonotonicClock().now_ns()
            questions = [station.seal(mapping.TIMESYNC, mapping.encode_timesync(0, asked)) for asked in (7, 8)]
            station.send(questions)  # in one datagram
            answers = [station.receive(PATIENCE_S), station.receive(PATIENCE_S)]
            after_ns = MonotonicClock().now_ns()
            assert near.recv(0) is None
        finally:
            stop.requested = True
        service.result(PATIENCE_S)
    for asked, frames in zip((7, 8), answers, strict=True):
        (frame,) = frames
        assert (frame.system, frame.component) == VEHICLE
        told_ns, echoed = mapping.decode_timesync(frame.payload)
        assert echoed == asked
        assert before_ns <= told_ns <= after_ns


@pytest.mark.processes
def test_as_a_process_it_names_its_link_answers_and_ends_when_told() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "bridge.latency.responder", "udpin://127.0.0.1:0"],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    try:
        assert process.stdout is not None
        uri = process.stdout.readline().strip()
        clock = MonotonicClock()
        with open_link(counterpart(uri)) as link:
            station = Endpoint(link, *STATION)
            sync = TimeSync(station.seal, clock)
            station.send([sync.question()])
            for frame in station.receive(PATIENCE_S):
                sync.handle(frame, clock.now_ns())
        assert sync.estimate is not None
        assert abs(sync.estimate.offset_ns) <= sync.estimate.error_ns, "both have the one clock of this machine"
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.communicate()


def test_a_link_that_cannot_be_opened_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bridge.latency.responder.end_with_parent", lambda: None)
    monkeypatch.setattr(StopFlag, "install", lambda self: None)
    assert main("udpin://192.0.2.1:0") == 3
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("responder: udpin://192.0.2.1:0")
    assert captured.err.count("\n") == 1
