"""Scores of a run against figures worked out by hand, on a reference that stands still."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from controller.laws.reference import reference_trajectory
from fwav_hil.score import desired_positions, scores, tracking_error
from protocol.messages import AXES, FloatArray
from protocol.scenario import ZERO6, Scenario, find_scenario, load_scenario

FLAPPER = load_scenario(find_scenario("flapper"))
PERIOD_NS = 4_000_000


def standing(*place: float) -> Scenario:
    """Flapper, told to stay where it is: at zero, where the reference is zero for good, unless `place` says where it starts."""
    calm = msgspec.structs.replace(FLAPPER.reference, amplitude=ZERO6, initial=place or ZERO6)
    return msgspec.structs.replace(FLAPPER, reference=calm)


def times(count: int) -> np.typing.NDArray[np.int64]:
    return np.arange(count, dtype=np.int64) * PERIOD_NS


def test_two_ticks_by_hand() -> None:
    """3 and -4: the mean of 9 and 16 is 12.5, that of 3 and 4 is 3.5."""
    q = np.array([[0.003, 0.0, 1.0, 0.3, 0.0, 0.1], [-0.004, 0.0, 1.0, -0.4, 0.0, -0.1]])
    shown = scores(standing(), times(2), q)
    rmse = (math.sqrt(12.5e-6), 0.0, 1.0, math.sqrt(0.125), 0.0, 0.1)
    assert shown["rmse"] == pytest.approx(dict(zip(AXES, rmse, strict=True)))
    assert shown["mae"] == pytest.approx(dict(zip(AXES, (0.0035, 0.0, 1.0, 0.35, 0.0, 0.1), strict=True)))


def test_the_error_is_taken_from_the_reference_of_each_tick() -> None:
    count, off = 100, np.array([0.001, -0.002, 0.003, 0.01, -0.02, 0.03])
    desired: FloatArray = reference_trajectory(FLAPPER.reference, count, PERIOD_NS)[:, 0]
    assert np.ptp(desired, axis=0).min() > 0.01, "it moves"
    assert desired_positions(FLAPPER, count).tolist() == desired.tolist()
    assert tracking_error(FLAPPER, desired + off) == pytest.approx(np.tile(off, (count, 1)), abs=1e-12)
    shown = scores(FLAPPER, times(count), desired + off)
    for name in ("rmse", "mae"):
        assert shown[name] == pytest.approx(dict(zip(AXES, np.abs(off), strict=True)))


@pytest.mark.parametrize(
    ("desired", "actual", "error"),
    [
        (0.0, 2.0 * math.pi - 0.1, -0.1),
        (0.0, -2.0 * math.pi + 0.1, 0.1),
        (3.1, -3.1, 2.0 * math.pi - 6.2),
        (-3.1, 3.1, 6.2 - 2.0 * math.pi),
        (0.5, 0.5 + 4.0 * math.pi, 0.0),
        (0.0, 3.0, 3.0),
        (0.0, -3.0, -3.0),
    ],
)
def test_angles_are_wrapped_and_positions_are_not(desired: float, actual: float, error: float) -> None:
    (found,) = tracking_error(standing(*(desired,) * 6), np.full((1, 6), actual))
    assert found[3:] == pytest.approx([error] * 3, abs=1e-12)
    assert found[:3] == pytest.approx([actual - desired] * 3)


def test_what_was_flown_is_left_as_it_is() -> None:
    q = np.full((3, 6), 7.0)
    scores(standing(), times(3), q)
    assert q.tolist() == np.full((3, 6), 7.0).tolist()


def test_from_two_seconds_on_a_run_counts_as_settled() -> None:
    """Tick 500 is at 2 s. Before it the error is 1, from it on 0.01 and 0.03 by turns."""
    count = 520
    q = np.ones((count, 6))
    q[500::2], q[501::2] = 0.01, 0.03
    shown = scores(standing(), times(count), q)
    assert shown["rmse_settled"] == pytest.approx(dict.fromkeys(AXES, math.sqrt(0.0005)))
    assert shown["mae_settled"] == pytest.approx(dict.fromkeys(AXES, 0.02))
    assert shown["mae"] == pytest.approx(dict.fromkeys(AXES, (500 + 20 * 0.02) / count))
    assert shown["rmse"] == pytest.approx(dict.fromkeys(AXES, math.sqrt((500 + 20 * 0.0005) / count)))


@pytest.mark.parametrize(("count", "is_settled"), [(1, False), (500, False), (501, True)])
def test_a_short_run_has_no_settled_part(count: int, is_settled: bool) -> None:
    shown = scores(standing(), times(count), np.zeros((count, 6)))
    assert (shown["rmse_settled"] is not None) is is_settled
    assert (shown["mae_settled"] is not None) is is_settled
    assert shown["rmse"] == shown["mae"] == dict.fromkeys(AXES, 0.0)


def test_no_tick_has_no_score() -> None:
    shown = scores(standing(), times(0), np.empty((0, 6)))
    assert shown["rmse"] == shown["mae"] == dict.fromkeys(AXES)
    assert shown["rmse_settled"] is shown["mae_settled"] is None


def test_an_axis_that_is_no_number_has_no_score_and_the_others_have() -> None:
    q = np.zeros((2, 6))
    q[1, 4], q[0, 0] = np.nan, np.inf
    shown = scores(standing(), times(2), q)
    assert shown["rmse"] == shown["mae"] == {**dict.fromkeys(AXES, 0.0), "x": None, "beta": None}
