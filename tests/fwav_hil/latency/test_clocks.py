"""Clocks that drift: the offset at any time is wrong by no more than is said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.latency.segments import Rows
from fwav_hil.latency.clocks import MOST_DRIFT, offset_at

S = 1_000_000_000
BEGUN_NS = 10**15


def answers(times_ns: list[int], there_ns: list[int], back_ns: list[int], drift: float) -> Rows:
    """Rows as TIMESYNC makes them on a clock that is ahead by 7 s at BEGUN_NS and gains `drift`."""
    rows = []
    for asked_ns, there, back in zip(times_ns, there_ns, back_ns, strict=True):
        answered_ns = asked_ns + there
        middle_ns = asked_ns + (there + back) // 2
        theirs_ns = answered_ns + true_offset(answered_ns, drift)
        rows.append((middle_ns, theirs_ns - middle_ns, there + back))
    return np.array(rows, dtype=np.int64)


def true_offset(t_ns: int, drift: float) -> int:
    return 7 * S + round(drift * (t_ns - BEGUN_NS))


@given(
    legs=st.lists(st.tuples(st.integers(0, 120 * S), st.integers(0, 10**7), st.integers(0, 10**7)), min_size=1, max_size=30),
    at=st.lists(st.integers(-5 * S, 130 * S), min_size=1, max_size=20),
    drift=st.floats(-0.99 * MOST_DRIFT, 0.99 * MOST_DRIFT),
)  # fmt: skip
def test_it_is_wrong_by_no_more_than_its_bound(legs: list[tuple[int, int, int]], at: list[int], drift: float) -> None:
    asked, there, back = (list(column) for column in zip(*legs, strict=True))
    clocks = answers([BEGUN_NS + t for t in asked], there, back, drift)
    at_ns = np.array([BEGUN_NS + t for t in at], dtype=np.int64)
    offset, bound = offset_at(clocks, at_ns)
    wrong = np.abs(offset - np.array([true_offset(int(t), drift) for t in at_ns]))
    assert (wrong <= bound + 2).all()  # two roundings to whole ns
    # And no answer would have been a better choice.
    every = clocks[:, 2] / 2.0 + MOST_DRIFT * np.abs(at_ns[:, None] - clocks[:, 0])
    assert bound == pytest.approx(every.min(axis=1), abs=2.0)


def test_over_a_minute_a_drift_of_20_ppm_is_followed() -> None:
    """One offset for the whole run, from the last answers, would be wrong by 1.2 ms at its start."""
    asked = [BEGUN_NS + second * S for second in range(61)]
    clocks = answers(asked, [50_000] * 61, [50_000] * 61, 2e-5)
    at_ns = BEGUN_NS + np.linspace(0, 60 * S, 6001).astype(np.int64)
    offset, bound = offset_at(clocks, at_ns)
    true = np.array([true_offset(int(t), 2e-5) for t in at_ns])
    assert np.abs(offset - true).max() < 12_000, "half a second of drift"
    assert bound.max() <= 50_000 + MOST_DRIFT * S / 2 + 100_000 * MOST_DRIFT + 2
    assert abs(clocks[-1, 1] - true[0]) > 1_190_000
