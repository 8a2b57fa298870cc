"""Evaluation of design candidates on every core; it reacts to a stop at once."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, wait
from contextlib import contextmanager

from bridge.process import StopFlag, end_with_parent
from fwav_hil.studies.design import Map, Task, cost
from protocol.messages import FloatArray

_LOOK_S = 0.1


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _begin_worker() -> None:
    """Let a worker end with its parent and ignore Ctrl-C."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def mapping(workers: int, stop: StopFlag) -> Iterator[Callable[[Task], Map]]:
    """A map over candidates for each task, on `workers` processes (1: this one). A stop raises Interrupted in it."""
    if workers == 1:

        def here(task: Task) -> Map:
            def run(_: Callable[[FloatArray], float], candidates: Iterable[FloatArray]) -> list[float]:
                results = []
                for candidate in candidates:
                    stop.check()
                    results.append(cost(task, candidate))
                return results

            return run

        yield here
        return

    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_begin_worker)
    try:
        yield lambda task: _pooled(pool, task, stop)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _pooled(pool: Executor, task: Task, stop: StopFlag) -> Map:
    def run(_: Callable[[FloatArray], float], candidates: Iterable[FloatArray]) -> list[float]:
        futures = [pool.submit(cost, task, candidate) for candidate in candidates]
        waiting = set(futures)
        while waiting:
            waiting = wait(waiting, timeout=_LOOK_S).not_done
            stop.check()
        return [future.result() for future in futures]

    return run
