"""Playing a log in time, on a clock that stands still until it is told to go on: every moment is exact."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.recording.replay import LATEST_LOOK_NS, LOOK_PERIOD_NS, LOOK_ROOM_NS, Player, log_times_ns
from bridge.timing.clock import VirtualClock

MS = 1_000_000
TICKS_NS = np.arange(100, dtype=np.int64) * 4 * MS


class Stage:
    """A player on a virtual clock, and what it sent when."""

    def __init__(
        self,
        times_ns: np.typing.NDArray[np.int64] = TICKS_NS,
        speed: float | None = 1.0,
        look: Callable[[Player], None] | None = None,
        send_takes_ns: int = 0,
    ) -> None:
        self.clock = VirtualClock(5_000)
        self.sent: list[tuple[int, bytes]] = []
        self._takes_ns = send_takes_ns
        self.player = Player(times_ns, self._prepare, self._send, self.clock, speed=speed, look=look)

    @staticmethod
    def _prepare(number: int, passes: int) -> bytes:
        return f"{passes}:{number}".encode()

    def _send(self, frame: bytes) -> None:
        self.sent.append((self.clock.now_ns() - 5_000, frame))
        self.clock.advance_ns(self._takes_ns)

    def times_ns(self) -> list[int]:
        return [t_ns for t_ns, _ in self.sent]

    def numbers(self) -> list[int]:
        return [int(frame.partition(b":")[2]) for _, frame in self.sent]


class TestTime:
    @pytest.mark.parametrize("speed", [0.1, 0.5, 1.0, 3.0, 10.0, 100.0])
    @pytest.mark.parametrize("look", [None, lambda player: None])
    def test_ten_times_is_really_ten_times(self, speed: float, look: Callable[[Player], None] | None) -> None:
        stage = Stage(speed=speed, look=look)
        stage.player.play()
        assert stage.times_ns() == [round(t_ns / speed) for t_ns in TICKS_NS.tolist()]
        assert stage.numbers() == list(range(100))
        assert stage.player.lateness_ns.tolist() == [0] * 100

    def test_as_fast_as_it_goes_takes_no_time(self) -> None:
        stage = Stage(speed=None)
        stage.player.play()
        assert stage.times_ns() == [0] * 100
        assert stage.player.lateness_ns.tolist() == []

    def test_lateness_is_told_and_never_adds_up(self) -> None:
        # Each send takes 6 ms, while frames are due each 4 ms: then ten times slower, and it is in time again.
        slow = Stage(speed=1.0, send_takes_ns=6 * MS)
        slow.player.play()
        assert slow.player.lateness_ns.tolist() == [2 * MS * k for k in range(100)]
        leisurely = Stage(speed=0.1, send_takes_ns=6 * MS)
        leisurely.player.play()
        assert leisurely.player.lateness_ns.tolist() == [0] * 100

    def test_frames_of_one_stamp_go_together_and_in_order(self) -> None:
        stage = Stage(np.repeat(TICKS_NS, 3))
        stage.player.play()
        assert stage.times_ns() == np.repeat(TICKS_NS, 3).tolist()
        assert stage.numbers() == list(range(300))

    @given(st.lists(st.integers(0, 10**14), min_size=1, max_size=50), st.none() | st.floats(0.0, 100.0))
    def test_log_time_never_runs_back_and_no_gap_is_longer_than_asked(
        self, stamps: list[int], gap: float | None
    ) -> None:
        times_ns = log_times_ns(np.array(stamps, dtype=np.int64), gap)
        steps = np.diff(times_ns)
        assert times_ns[0] == 0
        assert (steps >= 0).all()
        most = round(gap * 1e9) if gap is not None else None
        for step_ns, before, after in zip(steps.tolist(), stamps, stamps[1:], strict=False):
            expected = max(0, after - before) * 1000
            assert step_ns == (expected if most is None else min(expected, most))


class LateClock(VirtualClock):
    """Sleeps end 1 us late, as they do."""

    def sleep_until_ns(self, t_ns: int) -> None:
        if t_ns > self.now_ns():
            super().sleep_until_ns(t_ns + 1_000)


class TestLooks:
    """A look takes time, which must not be that of a frame."""

    LOOK_TAKES_NS = LOOK_ROOM_NS * 9 // 10

    def played(self, times_ns: np.typing.NDArray[np.int64]) -> tuple[list[int], list[int]]:
        """When looks began, and how late frames were."""
        looks: list[int] = []
        clock = LateClock(0)

        def look(_: Player) -> None:
            looks.append(clock.now_ns())
            clock.advance_ns(self.LOOK_TAKES_NS)

        player = Player(times_ns, lambda *_: b"", lambda _: None, clock, speed=1.0, look=look)
        player.play()
        return looks, player.lateness_ns.tolist()

    @given(st.lists(st.integers(LOOK_ROOM_NS, 40 * MS), min_size=1, max_size=60))
    def test_where_there_is_room_no_frame_waits_for_one(self, steps_ns: list[int]) -> None:
        looks, lateness_ns = self.played(np.cumsum([0, *(step + LOOK_ROOM_NS // 10 for step in steps_ns)]))
        assert max(lateness_ns) <= 1_000
        assert max(np.diff(looks), default=0) <= LOOK_PERIOD_NS + 40 * MS

    @pytest.mark.parametrize("offset_ns", [0, 1, 999, 1_000, 1_001])
    def test_a_look_that_just_fits_or_just_does_not_holds_nothing_up(self, offset_ns: int) -> None:
        first_look_ns = self.LOOK_TAKES_NS  # the one before the first frame; further ones a period after it begins
        due_ns = LOOK_PERIOD_NS + LOOK_ROOM_NS + offset_ns - first_look_ns
        _, lateness_ns = self.played(np.array([0, due_ns, due_ns + 4 * MS], dtype=np.int64))
        assert max(lateness_ns) <= 1_000

    def test_without_room_they_come_ten_times_a_second_all_the_same(self) -> None:
        looks, lateness_ns = self.played(np.arange(2000, dtype=np.int64) * (LOOK_ROOM_NS // 2))
        assert LOOK_PERIOD_NS < np.diff(looks).max() <= LOOK_PERIOD_NS + LATEST_LOOK_NS + LOOK_ROOM_NS
        assert len(looks) == 10
        assert max(lateness_ns) <= self.LOOK_TAKES_NS


class TestHand:
    def test_held_it_waits_and_goes_on_where_it_stood(self) -> None:
        looks = 0

        def look(player: Player) -> None:
            nonlocal looks
            looks += 1
            if looks in (3, 13):
                player.hold()

        stage = Stage(look=look)
        stage.player.play()
        assert stage.numbers() == list(range(100))
        pauses = np.diff(stage.times_ns())
        held = int(np.argmax(pauses))
        assert held * 4 * MS == 2 * LOOK_PERIOD_NS  # the third look is two periods after the start, the 13th ten later
        assert pauses[held] == 10 * LOOK_PERIOD_NS
        assert sorted(pauses)[-2] == 4 * MS

    def test_stepped_it_sends_one_frame_at_a_time(self) -> None:
        def look(player: Player) -> None:
            if len(stage.sent) < 5:
                player.step()
            else:
                player.stop()

        stage = Stage(look=look)
        stage.player.play()
        assert stage.numbers() == [0, 1, 2, 3, 4]
        assert np.diff(stage.times_ns()).tolist() == [LOOK_PERIOD_NS] * 4

    @pytest.mark.parametrize(("by_s", "expected"), [(0.2, 56), (0.001, 7), (-1.0, 0), (9.0, 99)])
    def test_moved_it_goes_on_from_there(self, by_s: float, expected: int) -> None:
        moved = False

        def look(player: Player) -> None:
            nonlocal moved
            if player.at == 6 and not moved:
                moved = True
                player.seek(by_s)

        stage = Stage(look=look)
        stage.player.play()
        numbers = stage.numbers()
        assert numbers == [*range(6), *range(expected, 100)]
        assert stage.times_ns()[6] == LOOK_PERIOD_NS, "at once"

    @pytest.mark.parametrize("move", [lambda p: p.seek(0.1), lambda p: p.hold(), lambda p: p.step()])
    def test_it_says_that_it_was_moved(self, move: Callable[[Player], None]) -> None:
        def look(player: Player) -> None:
            move(player)
            player.stop()

        untouched, touched = Stage(), Stage(look=look)
        for stage in (untouched, touched):
            stage.player.play()
        assert (untouched.player.moved, touched.player.moved) == (False, True)

    def test_it_stops_before_the_next_frame(self) -> None:
        stage = Stage(look=lambda player: player.stop() if player.sent else None)
        stage.player.play(loop=True)
        assert 0 < len(stage.sent) < 100
        assert stage.player.passes == 0

    def test_looped_it_begins_anew_in_time(self) -> None:
        def look(player: Player) -> None:
            if player.passes == 3:
                player.stop()

        stage = Stage(look=look)
        stage.player.play(loop=True)
        passes = [int(frame.partition(b":")[0]) for _, frame in stage.sent]
        assert [passes.count(k) for k in range(3)] == [100, 100, 100]
        span_ns = int(TICKS_NS[-1])
        for number, t_ns in enumerate(stage.times_ns()[:300]):
            assert t_ns == number // 100 * span_ns + 4 * MS * (number % 100)


def test_many_jumps_of_a_clock_leave_times_in_order() -> None:
    stamps_us = np.array([0, 1 << 51, 0, 1 << 51, 5, (1 << 52) - 1, 7, 1 << 51], dtype=np.int64)
    times = log_times_ns(stamps_us)
    assert (np.diff(times) >= 0).all()
    assert log_times_ns(stamps_us, 2.0).tolist() == [0, 2e9, 2e9, 4e9, 4e9, 6e9, 6e9, 8e9]
