"""The anchor of the lockstep tick: a bare UDP ping-pong of the same bytes between two processes, in the same placement."""

from __future__ import annotations

import multiprocessing
import os
import socket
import statistics
import time

TICK_BYTES, ANSWER_BYTES = 126, 93


def round_trip_us(cores: tuple[int, int], *, poll: bool, count: int = 20_000) -> float:
    """Median round trip (us) between two processes on these cores, polling or asleep while they wait."""
    near, far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    with near, far:
        near.bind(("127.0.0.1", 0))
        far.bind(("127.0.0.1", 0))
        near.connect(far.getsockname())
        far.connect(near.getsockname())
        other = multiprocessing.get_context("fork").Process(target=_echo, args=(far, cores[1], poll, count))
        other.start()
        before = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {cores[0]})
        try:
            times_ns = []
            for _ in range(count):
                begun_ns = time.perf_counter_ns()
                near.send(b"x" * TICK_BYTES)
                _receive(near, poll=poll)
                times_ns.append(time.perf_counter_ns() - begun_ns)
        finally:
            os.sched_setaffinity(0, before)
            other.join(10.0)
    return statistics.median(times_ns) / 1e3


def _echo(link: socket.socket, core: int, poll: bool, count: int) -> None:
    os.sched_setaffinity(0, {core})
    for _ in range(count):
        _receive(link, poll=poll)
        link.send(b"y" * ANSWER_BYTES)


def _receive(link: socket.socket, *, poll: bool) -> bytes:
    while poll:
        try:
            return link.recv(2048, socket.MSG_DONTWAIT)
        except BlockingIOError:
            continue
    return link.recv(2048)
