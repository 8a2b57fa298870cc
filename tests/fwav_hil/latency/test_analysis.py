"""From stamps to legs, where every leg is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.latency.segments import ANSWER_COLUMNS, CONTROLLER_FILE, EMULATOR_FILE, LegTable
from bridge.timing.timesync import Estimate
from fwav_hil.latency.analysis import LEGS, Legs, clock_check, join_legs, legs_of
from protocol.errors import RunFolderError
from tests.fwav_hil.latency.rows import (
    AGE_NS,
    DELAY_NS,
    DURATIONS_NS,
    LEGS_WITHIN_AGE,
    PERIOD_NS,
    START_NS,
    Stamps,
    save,
    stamps,
)

COUNT = 50
CROSSING = ("to_kernel", "back_to_kernel")


def joined(stamped: Stamps, clocks: list[tuple[int, int, int]] | None = None) -> Legs:
    rows = None if clocks is None else np.array(clocks, dtype=np.int64).reshape(-1, 3)
    return legs_of(stamped.ticks.rows, stamped.answers.rows, stamped.samples.rows, None, clocks=rows)


def at_once(offset_ns: int) -> list[tuple[int, int, int]]:
    """Clocks that one answer without delay relates."""
    return [(START_NS, offset_ns, 0)]


def assert_known(legs: Legs, names: tuple[str, ...] = tuple(DURATIONS_NS)) -> None:
    for name in names:
        assert legs.durations_ns[name].tolist() == [DURATIONS_NS[name] + tick for tick in range(COUNT)], name
    assert legs.durations_ns["age"].tolist() == [AGE_NS + LEGS_WITHIN_AGE * tick for tick in range(COUNT)]


def test_every_leg_comes_out_as_it_was() -> None:
    legs = joined(stamps(COUNT))
    assert list(legs.durations_ns) == list(LEGS)
    assert_known(legs)
    assert legs.t_ns.tolist() == [tick * PERIOD_NS for tick in range(COUNT)]
    assert legs.delay_ns.tolist() == [DELAY_NS] * COUNT
    assert legs.negative == 0


@given(st.integers(-(10**12), 10**12))
def test_two_clocks_give_the_same_legs_as_one(offset_ns: int) -> None:
    assert_known(joined(stamps(COUNT, offset_ns=offset_ns), at_once(offset_ns)))


def test_a_clock_that_ran_before_zero_is_a_clock_too() -> None:
    assert_known(joined(stamps(COUNT, offset_ns=-(10**14)), at_once(-(10**14))))


def test_where_the_offset_is_not_known_the_crossing_legs_are_not() -> None:
    legs = joined(stamps(COUNT, offset_ns=10**9), [])
    assert_known(legs, tuple(name for name in DURATIONS_NS if name not in CROSSING))
    assert all(len(legs.known(name)) == 0 for name in CROSSING)
    assert legs.negative == 0


def test_without_kernel_stamps_the_legs_to_and_from_the_kernel_are_not_known() -> None:
    legs = joined(stamps(COUNT, stamped=False))
    unknown = ("to_kernel", "to_controller", "back_to_kernel", "to_emulator")
    assert all(legs.durations_ns[name].tolist() == [-1] * COUNT for name in unknown)
    assert all(len(legs.known(name)) == 0 for name in unknown)
    assert_known(legs, tuple(name for name in DURATIONS_NS if name not in unknown))


def test_a_leg_that_ended_before_it_began_counts_as_nothing_and_is_counted() -> None:
    wrong_ns = DURATIONS_NS["to_kernel"] + 10  # the controller seems to hear of the first ten samples before they left
    legs = joined(stamps(COUNT), at_once(wrong_ns))
    assert legs.negative == 10
    assert legs.durations_ns["to_kernel"].tolist() == [max(0, tick - 10) for tick in range(COUNT)]


def test_samples_that_were_not_answered_or_not_noted_are_left_out() -> None:
    whole = stamps(COUNT)
    ticks, answers, samples = whole.ticks.rows, whole.answers.rows, whole.samples.rows
    legs = legs_of(ticks, np.delete(answers, 7, axis=0), np.delete(samples, [9, 10], axis=0), None)
    left = [tick for tick in range(COUNT) if tick not in (7, 9, 10)]
    assert legs.t_ns.tolist() == [tick * PERIOD_NS for tick in left]
    assert legs.durations_ns["wake"].tolist() == [DURATIONS_NS["wake"] + tick for tick in left]


def test_of_a_sample_that_came_again_the_first_row_counts() -> None:
    whole = stamps(COUNT)
    again = whole.samples.rows[:5].copy()
    again[:, 1:] += 10**9
    legs = legs_of(whole.ticks.rows, whole.answers.rows, np.vstack([whole.samples.rows, again]), None)
    assert_known(legs)


def test_rows_may_come_in_any_order() -> None:
    whole = stamps(COUNT)
    assert_known(legs_of(whole.ticks.rows[::-1], whole.answers.rows, whole.samples.rows[::-1], None))


def test_a_run_without_an_answer_has_no_legs() -> None:
    whole = stamps(COUNT)
    legs = legs_of(whole.ticks.rows, LegTable(ANSWER_COLUMNS).rows, whole.samples.rows, None)
    assert len(legs.t_ns) == len(legs.delay_ns) == 0
    assert all(len(legs.known(name)) == 0 for name in LEGS)


class TestFolders:
    def test_one_folder_is_one_clock_whatever_timesync_says(self, tmp_path: Path) -> None:
        clock = Estimate(80_000, 200_000, 5)
        save(stamps(COUNT), tmp_path, clock=clock)
        legs = join_legs(tmp_path)
        assert_known(legs)
        assert legs.clock == clock

    def test_two_folders_are_two_clocks_that_timesync_relates(self, tmp_path: Path) -> None:
        other = tmp_path / "other"
        other.mkdir()
        save(stamps(COUNT, offset_ns=-(10**12)), tmp_path, other, Estimate(-(10**12), 200_000, 5))
        assert_known(join_legs(tmp_path, other))

    def test_two_folders_that_nothing_relates(self, tmp_path: Path) -> None:
        other = tmp_path / "other"
        other.mkdir()
        save(stamps(COUNT, offset_ns=10**12), tmp_path, other)
        assert len(join_legs(tmp_path, other).known("to_kernel")) == 0

    @pytest.mark.parametrize("missing", [EMULATOR_FILE, CONTROLLER_FILE])
    def test_half_of_a_run_is_refused(self, missing: str, tmp_path: Path) -> None:
        save(stamps(COUNT), tmp_path)
        (tmp_path / missing).unlink()
        with pytest.raises(RunFolderError, match=f"there is no .*{missing}.*--legs"):
            join_legs(tmp_path)

    def test_the_file_of_the_other_end_is_no_file_of_this_end(self, tmp_path: Path) -> None:
        save(stamps(COUNT), tmp_path)
        (tmp_path / EMULATOR_FILE).write_bytes((tmp_path / CONTROLLER_FILE).read_bytes())
        with pytest.raises(RunFolderError, match="damaged"):
            join_legs(tmp_path)


@pytest.mark.parametrize(("offset_ns", "round_trip_ns", "held"), [(0, 0, True), (100, 200, True), (-101, 200, False)])
def test_timesync_is_checked_against_the_one_clock(offset_ns: int, round_trip_ns: int, held: bool) -> None:
    legs = joined(stamps(3))._replace(clock=Estimate(offset_ns, round_trip_ns, 9))
    assert clock_check(legs) == {
        "offset_us": offset_ns / 1e3,
        "true_offset_us": 0.0,
        "error_us": abs(offset_ns) / 1e3,
        "bound_us": round_trip_ns / 2e3,
        "answers": 9,
        "held": held,
    }


def test_where_nobody_answered_there_is_nothing_to_check() -> None:
    assert clock_check(joined(stamps(3))) is None
