"""`fwav-hil doctor`: what it says of a machine, and how it ends."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from bridge.command_line import run_command
from bridge.timing.wake_up import Trial
from fwav_hil.cli import cli
from fwav_hil.doctor_command import verdict


def trial(rate_hz: float, p999_us: float, *, realtime: bool, missed: int = 0) -> Trial:
    late = {"p50": 1.0, "p99": 2.0, "p999": p999_us, "max": 9999.0, "late_by": {}, "spin": 0.0}
    return Trial(rate_hz, realtime, 5000, late, missed)


@pytest.mark.parametrize(
    ("without", "with_it", "line"),
    [
        ((900.0, 0), (60.0, 0), "1 kHz: yes with --realtime, p99.9 60 us; no without, p99.9 900 us"),
        ((90.0, 0), (6.25, 0), "1 kHz: yes with --realtime, p99.9 6.2 us; yes without, p99.9 90 us"),
        (
            (5000.0, 31),
            (60.0, 1),
            "1 kHz: no with --realtime, p99.9 60 us and 1 of 5000 periods missed; "
            "no without, p99.9 5000 us and 31 of 5000 periods missed",
        ),
    ],
)
def test_the_verdict_on_a_rate_is_one_line(without: tuple[float, int], with_it: tuple[float, int], line: str) -> None:
    said = verdict(
        trial(1000.0, without[0], realtime=False, missed=without[1]),
        trial(1000.0, with_it[0], realtime=True, missed=with_it[1]),
    )
    assert said == line


def test_below_1_khz_rates_are_in_hertz_and_judged_by_their_own_period() -> None:
    said = verdict(trial(250.0, 399.0, realtime=False), trial(250.0, 401.0, realtime=True))
    assert said == "250 Hz: no with --realtime, p99.9 401 us; yes without, p99.9 399 us"


def test_it_tries_each_rate_both_ways_and_leaves_one_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = run_command(cli, "fwav-hil", ["doctor", "--seconds", "0.1", "--rate", "50", "--rate", "100", "--json", "-"])
    captured = capsys.readouterr()
    told: dict[str, Any] = json.loads(captured.out)
    assert code == (0 if told["kept"] else 1)
    assert [(one["rate_hz"], one["realtime"], one["wake_ups"]) for one in told["trials"]] == [
        (50.0, False, 5), (50.0, True, 5), (100.0, False, 10), (100.0, True, 10),
    ]  # fmt: skip
    assert len(told["verdicts"]) == 2
    assert len(told["realtime"]) == 6
    assert {"kernel preemption", "cores", "clock source"} <= {finding["name"] for finding in told["findings"]}
    for line in told["verdicts"]:
        assert line in captured.err


def test_a_rate_of_nothing_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(cli, "fwav-hil", ["doctor", "--rate", "0"]) == 2
    assert "--rate" in capsys.readouterr().err
