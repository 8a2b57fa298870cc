"""Tables: every figure that was found stands in them, and what is missing is said."""

from __future__ import annotations

import io
from typing import Any

from rich.console import Console

from fwav_hil.latency.analysis import LEGS
from fwav_hil.latency.tables import print_probes, print_report
from protocol.messages import AXES

FIGURES = {"count": 7, "p50": 1.25, "p90": 2.0, "p99": 3.5, "p999": 44.0, "p9999": 555.5, "max": 6666.6}
NOTHING = {"count": 0, **dict.fromkeys(("p50", "p90", "p99", "p999", "p9999", "max"))}


def shown(print_it: Any, result: dict[str, Any]) -> str:
    out = io.StringIO()
    print_it(result, Console(file=out, width=140, highlight=False, soft_wrap=True))
    return out.getvalue()


def report(**changes: Any) -> dict[str, Any]:
    return {
        "scenario": "flapper",
        "law": "ude",
        "rate_hz": 500.0,
        "legs_us": {name: FIGURES if name != "to_kernel" else NOTHING for name in LEGS},
        "losses": {"lost": 3, "out_of_order": 0},
        "negative_legs": 0,
        "time_sync": {"error_us": 3.0, "bound_us": 8.0, "answers": 12, "held": True},
        "beside": {},
        "prediction": None,
    } | changes


def row(text: str, name: str) -> list[str]:
    (line,) = (line for line in text.splitlines() if name in line)
    return [cell.strip() for cell in line.strip("│").split("│")]


def test_every_leg_has_its_row() -> None:
    text = shown(print_report, report())
    assert row(text, "age: stamped -> applied")[1:] == ["7", "1.2", "2.0", "3.5", "44.0", "555.5", "6667"]
    assert row(text, "-> kernel (controller)")[1:] == ["0", *["-"] * 6]
    assert all(label in text for label in LEGS.values())
    assert "lost 3, out of order 0" in text
    assert "negative" not in text
    assert "RMSE" not in text


def test_timesync_says_whether_it_held() -> None:
    assert "within its bound of 8.0 us" in shown(print_report, report())
    sync = {"error_us": 9.0, "bound_us": 8.0, "answers": 12, "held": False}
    assert "BEYOND its bound" in shown(print_report, report(time_sync=sync))
    assert "no answer;" in shown(print_report, report(time_sync=None))
    sync = {"offset_us": -5.5, "offset_at_end_us": 900.0, "bound_us": 8.0, "answers": 12}
    assert "ahead by -5.5 us at the start and 900.0 us at the end, within 8.0 us" in shown(
        print_report, report(time_sync=sync)
    )


def test_negative_durations_are_not_hidden() -> None:
    assert "13 durations were negative" in shown(print_report, report(negative_legs=13))


def test_what_stood_beside_it_has_rows_and_its_losses_are_said() -> None:
    found = {
        "open_loop": {"from_due": FIGURES, "from_sent": FIGURES, "lost": 0, "duplicate": 0, "out_of_order": 0},
        "mavutil": {"from_due": NOTHING, "from_sent": NOTHING, "lost": 43, "duplicate": 0, "out_of_order": 2},
        "cyclictest": {"wake": FIGURES},
    }
    text = shown(print_report, report(beside=found))
    assert row(text, "round trip, open loop")[1] == "7"
    assert row(text, "wake-up, cyclictest")[-1] == "6667"
    assert "mavutil: lost 43, out of order 2" in text
    assert "open loop: " not in text
    text = shown(print_report, report(beside={"cyclictest": {"note": "cyclictest was not found"}}))
    assert "cyclictest was not found" in text


def test_the_predictions_stand_beside_the_run_and_a_divergence_is_said() -> None:
    errors = dict.fromkeys(AXES, 0.001)
    predicted = {"delay_s": 0.005, "rmse_run": errors, "rmse_constant": errors, "rmse_recorded": None}
    text = shown(print_report, report(prediction=predicted))
    assert "x 1.00 mm / 1.00 mm / diverged" in text
    assert "5.000 ms" in text


def test_probes_of_a_link() -> None:
    result = {
        "link": "serial:///dev/x:921600",
        "rate_hz": 50.0,
        "round_trip_us": FIGURES,
        "from_sent_us": FIGURES,
        "lost": 1,
        "duplicate": 2,
        "out_of_order": 3,
        "unknown": 4,
        "clock_offset_us": 12.5,
        "clock_offset_bound_us": 99.0,
    }
    text = shown(print_probes, result)
    assert "serial:///dev/x:921600 at 50 Hz" in text
    assert "lost 1, duplicate 2, out of order 3, unrequested 4" in text
    assert "ahead by 12.5 us, within 99.0 us" in text
