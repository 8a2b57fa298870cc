"""The offset between two drifting clocks over time, from the answers to TIMESYNC."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bridge.latency.segments import Rows

MOST_DRIFT = 1e-4
"""Two ordinary quartz clocks, of 50 ppm each, drift apart by this much at most."""


def offset_at(clocks: Rows, at_ns: Rows) -> tuple[Rows, Rows]:
    """(offset, bound of its error), ns, (n,) each, at the times at_ns; clocks: rows of CLOCK_COLUMNS, one at least.

    The error of an answer is at most half its round trip, plus MOST_DRIFT times the time since or until it: the answer with the
    smallest sum is used.
    """
    rows = clocks[np.argsort(clocks[:, 0], kind="stable")]
    start_ns = rows[0, 0]
    t, t_answers = (at_ns - start_ns).astype(float), (rows[:, 0] - start_ns).astype(float)
    error, number = rows[:, 2] / 2.0, np.arange(len(rows))
    # The best of all answers before a time stays the best at any later time, and vice versa: a running minimum finds it.
    earlier = _running_best(error - MOST_DRIFT * t_answers)
    later = number[::-1][_running_best((error + MOST_DRIFT * t_answers)[::-1])][::-1]
    place = np.searchsorted(t_answers, t, side="right")
    before, after = earlier[np.maximum(place - 1, 0)], later[np.minimum(place, len(rows) - 1)]
    cost_before, cost_after = (error[one] + MOST_DRIFT * np.abs(t - t_answers[one]) for one in (before, after))
    best = np.where(cost_before <= cost_after, before, after)
    return rows[best, 1], np.ceil(np.minimum(cost_before, cost_after)).astype(np.int64)


def _running_best(cost: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """At each place the index of the smallest value so far."""
    is_best = cost == np.minimum.accumulate(cost)
    return np.maximum.accumulate(np.where(is_best, np.arange(len(cost)), 0))
