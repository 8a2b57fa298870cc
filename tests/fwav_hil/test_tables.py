"""Results as tables: the figures in the units one thinks in, and plain text where there is no terminal."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import pytest

from fwav_hil.axis_names import AXIS_NAMES
from fwav_hil.tables import plain_console, print_spread, print_summary, show_error
from protocol.messages import AXES

DEGREE = math.pi / 180.0
LATENCY = {"p50": 81.4, "p99": 120.0, "p999": 300.0, "max": 950.6}
NO_LATENCY = dict.fromkeys(("p50", "p99", "p999", "max"))


@pytest.fixture(autouse=True)
def no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "120")


def by_axis(position: float | None, angle: float | None) -> dict[str, float | None]:
    return {axis: position if axis in "xyz" else angle for axis in AXES}


def summary(**changes: Any) -> dict[str, Any]:
    return {
        "scenario": "flapper",
        "law": "ude",
        "clock": "lockstep",
        "rate_hz": 250.0,
        "seed": 3,
        "duration_s": 10.0,
        "ticks": 2500,
        "ticks_per_s": 3456.7,
        "rmse": by_axis(0.0015, 2.0 * DEGREE),
        "mae": by_axis(0.001, DEGREE),
        "rmse_settled": None,
        "mae_settled": None,
        "latency_us": NO_LATENCY,
        "tick_us": None,
        "counters": {"missed": 1, "late": 2, "dropped": 3, "refused": 4, "emulator": {"sent": 9}},
        **changes,
    }


def rows(text: str) -> dict[str, list[str]]:
    """The cells of each axis."""
    found = [[cell.strip() for cell in line.strip("│┃").split("│")] for line in text.splitlines() if "│" in line]
    return {cells[0]: cells[1:] for cells in found}


@pytest.mark.parametrize(
    ("axis", "value", "shown"),
    [("x", 0.0015, "1.50 mm"), ("z", -0.1, "-100.00 mm"), ("alpha", DEGREE, "1.000 deg"), ("gamma", math.pi, "180.000 deg"),
     ("y", 0.0, "0.00 mm"), ("x", None, "-"), ("beta", None, "-")],
)  # fmt: skip
def test_an_error_in_the_units_one_thinks_in(axis: str, value: float | None, shown: str) -> None:
    assert show_error(axis, value) == shown


class TestSummary:
    def test_a_run_in_plain_text(self, capsys: pytest.CaptureFixture[str]) -> None:
        print_summary(summary())
        text = capsys.readouterr().out
        assert "\x1b" not in text
        assert "flapper, law ude, seed 3" in text
        assert "2500 ticks at 250 Hz (10 s, lockstep), 3457 ticks/s of wall time" in text
        assert "missed 1, late 2, dropped 3, refused 4" in text
        assert rows(text) == {
            AXIS_NAMES[axis]: ["1.50 mm", "1.00 mm"] if axis in "xyz" else ["2.000 deg", "1.000 deg"] for axis in AXES
        }
        assert "latency" not in text
        assert "from 2 s" not in text

    def test_the_settled_part_has_columns_of_its_own(self, capsys: pytest.CaptureFixture[str]) -> None:
        settled = {"rmse_settled": by_axis(0.0003, 0.3 * DEGREE), "mae_settled": by_axis(0.0002, 0.2 * DEGREE)}
        print_summary(summary(**settled))
        text = capsys.readouterr().out
        assert "RMSE from 2 s" in text
        assert "MAE from 2 s" in text
        assert rows(text)["x"] == ["1.50 mm", "1.00 mm", "0.30 mm", "0.20 mm"]
        assert rows(text)["yaw"] == ["2.000 deg", "1.000 deg", "0.300 deg", "0.200 deg"]

    def test_what_is_not_known_is_a_dash_or_left_out(self, capsys: pytest.CaptureFixture[str]) -> None:
        empty = by_axis(None, None)
        unknown = {"clock": None, "ticks_per_s": None, "rmse": empty, "mae": empty, "counters": {}, "ticks": 0}
        print_summary(summary(**unknown))
        text = capsys.readouterr().out
        assert rows(text) == {AXIS_NAMES[axis]: ["-", "-"] for axis in AXES}
        assert "0 ticks at 250 Hz (10 s)\n" in text
        assert "None" not in text
        assert "missed" not in text

    @pytest.mark.parametrize(("clock", "is_noted"), [("lockstep", True), ("realtime", False)])
    def test_in_lockstep_a_latency_is_no_latency_test_and_that_is_said(
        self, capsys: pytest.CaptureFixture[str], clock: str, is_noted: bool
    ) -> None:
        print_summary(summary(clock=clock, latency_us=LATENCY, tick_us=LATENCY))
        text = capsys.readouterr().out
        (latency,) = (line for line in text.splitlines() if line.startswith("loop latency"))
        (tick,) = (line for line in text.splitlines() if line.startswith("whole tick"))
        assert latency.startswith("loop latency p50 81 us, p99 120 us, max 951 us")
        assert ("not the latency of a real-time loop" in latency) is is_noted
        assert tick == "whole tick p50 81 us, p99 120 us, max 951 us"

    def test_it_goes_beside_the_json_where_that_has_standard_output(self, capsys: pytest.CaptureFixture[str]) -> None:
        print_summary(summary(), to_stderr=True)
        captured = capsys.readouterr()
        assert captured.out == ""
        assert "flapper, law ude" in captured.err


class TestSpread:
    SPREAD: ClassVar[dict[str, Any]] = {
        "scenario": "flapper",
        "law": "pd",
        "rate_hz": 500.0,
        "seeds": 20,
        "rmse_median": by_axis(0.001, DEGREE),
        "rmse_worst": by_axis(0.002, 2.0 * DEGREE),
        "rmse_settled_median": None,
        "rmse_settled_worst": None,
    }  # fmt: skip

    def test_median_and_worst(self, capsys: pytest.CaptureFixture[str]) -> None:
        print_spread(self.SPREAD)
        text = capsys.readouterr().out
        assert "\x1b" not in text
        assert "flapper, law pd, 500 Hz, 20 seeds" in text
        assert "RMSE, median" in text
        assert "RMSE, worst" in text
        assert "2 s" not in text
        assert rows(text) == {
            AXIS_NAMES[axis]: ["1.00 mm", "2.00 mm"] if axis in "xyz" else ["1.000 deg", "2.000 deg"] for axis in AXES
        }

    def test_the_settled_part_has_columns_of_its_own(self, capsys: pytest.CaptureFixture[str]) -> None:
        settled = {"rmse_settled_median": by_axis(0.0003, 0.1), "rmse_settled_worst": by_axis(0.0004, 0.1)}
        print_spread(self.SPREAD | settled, to_stderr=True)
        captured = capsys.readouterr()
        assert captured.out == ""
        assert "RMSE from 2 s, median" in captured.err
        assert "RMSE from 2 s, worst" in captured.err
        assert rows(captured.err)["y"] == ["1.00 mm", "2.00 mm", "0.30 mm", "0.40 mm"]


def test_what_a_user_named_is_shown_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    """rich would make a picture of `:b:`, leave out `[red]`, and fail on `[/x]`."""
    counters = {"motor_outages": 0, "motor_recoveries": 0}
    can = {
        "protocol": "mit",
        "uri": "virtual:b",
        "bitrate": 1_000_000,
        "measured_load_percent": {"1000000": 1.0},
        "load_percent": {"1000000": 2.0},
    }
    shown = summary(scenario="[red]", can=can)
    shown["counters"]["emulator"] = counters
    print_summary(shown)
    plain_console().print("run folder: runs/[/x]")
    said = capsys.readouterr().out
    assert "mit drives on virtual:b: 1 %" in said
    assert "[red], law ude" in said
    assert said.endswith("run folder: runs/[/x]\n")
