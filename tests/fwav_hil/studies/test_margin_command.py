"""`fwav-hil margin` as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from bridge.command_line import run_command
from fwav_hil.cli import cli
from fwav_hil.studies import flight_check, margin_study
from fwav_hil.studies.margin import RATES_HZ, at_rate, linear_margins, with_derivative_pole, with_gain_ratio
from protocol.messages import AXES
from tests.loop import scenario_of

CHANNEL_KEYS = {
    *("gain_ratio", "gain_range", "gain_margin", "phase_margin_rad", "max_delay_s", "crossover_rad_s", "stable"),
}


class Ended(NamedTuple):
    code: int
    out: str
    err: str


def call(capsys: pytest.CaptureFixture[str], *arguments: str) -> Ended:
    code = run_command(cli, "fwav-hil", ["margin", *arguments])
    return Ended(code, *capsys.readouterr())


def test_of_the_flapper(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr(margin_study, "VARIANTS", flight_check.VARIANTS[-1:])
    monkeypatch.setattr(margin_study, "_REGION_DELAYS", 12)
    out = tmp_path / "study"
    ended = call(capsys, "flapper", "--out", str(out), "--json", "-")
    assert ended.code == 0, ended.err
    result: dict[str, Any] = json.loads(ended.out)
    assert json.loads((out / "margin.json").read_text()) == result
    head = {key: result[key] for key in ("scenario", "law", "rate_hz", "delay_s", "verdict", "reasons")}
    expected = {
        "scenario": "flapper",
        "law": "ude",
        "rate_hz": 250.0,
        "delay_s": 0.009,
        "verdict": "good",
        "reasons": [],
    }
    assert head == expected
    assert tuple(result["channels"]) == AXES
    for channel in result["channels"].values():
        assert set(channel) >= CHANNEL_KEYS
        assert channel["stable"] is True
        assert channel["gain_range"][0] < channel["gain_ratio"] < channel["gain_range"][1]
    assert result["max_delay_s"] == min(channel["max_delay_s"] for channel in result["channels"].values())
    assert [row["rate_hz"] for row in result["rates"]] == list(RATES_HZ)
    for axis in AXES:
        rows = result["describing_function"][axis]
        assert rows[0]["relative_gain"] == pytest.approx(1.0 / 9.0, rel=0.01)  # kappa / h
        assert rows[-1]["relative_gain"] == pytest.approx(1.0, abs=1e-3)
        assert max(row["lag_rad"] for row in rows) > 0.6
        cycle = next(c for c in result["limit_cycles"][axis]["predicted"] if c["attracting"])
        assert result["limit_cycles"][axis]["simulated"]["motion"] == pytest.approx(cycle["motion"], rel=0.25)
        region = result["region"][axis]
        assert len(region["delay_s"]) == len(region["gain_ranges"])
    nonlinear = result["nonlinear"]
    assert 0.016 < nonlinear["max_delay_s"] < nonlinear["lost_delay_s"] < 0.025
    assert nonlinear["at_own_delay"]["lost"] is None
    small = nonlinear["variants"]["small motions, no noise, no hysteresis"]
    assert small == pytest.approx(result["max_delay_s"], rel=0.05)
    for figure in result["files"].values():
        assert Path(figure).read_bytes().startswith(b"\x89PNG")
    assert set(result["files"]) == {"stability_region", "describing_function", "reversal"}
    for words in ("gain margin up", "largest delay", "limit cycles", "verdict: good"):
        assert words in ended.err  # --json - leaves standard output to the JSON

    again = call(capsys, "flapper", "--out", str(out))
    assert again.code == 6
    assert "already holds a margin study" in again.err


def test_the_papers_gains_at_100_hz_are_unusable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(margin_study, "VARIANTS", ())
    monkeypatch.setattr(margin_study, "_REGION_DELAYS", 4)
    monkeypatch.setattr(margin_study, "RATES_HZ", (100.0,))
    file = tmp_path / "paper.json"
    ended = call(capsys, "paper", "--rate", "100", "--json", str(file))
    assert ended.code == 0
    result = json.loads(file.read_text())
    assert result["verdict"] == "unusable"
    assert result["nonlinear"]["at_own_delay"]["lost"]
    assert "verdict: unusable" in ended.out
    assert not list(tmp_path.glob("*.png"))


def test_any_cell_can_be_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(margin_study, "VARIANTS", ())
    monkeypatch.setattr(margin_study, "_REGION_DELAYS", 4)
    monkeypatch.setattr(margin_study, "RATES_HZ", (500.0,))
    file = tmp_path / "cell.json"
    options = ("--law", "pd", "--rate", "500", "--gain-ratio", "1.5", "--n-filter", "300")
    assert call(capsys, "flapper", *options, "--json", str(file)).code == 0
    result = json.loads(file.read_text())
    assert (result["law"], result["rate_hz"], result["delay_s"]) == ("pd", 500.0, 0.007)
    assert {round(channel["gain_ratio"], 9) for channel in result["channels"].values()} == {1.5}
    # The same cell from the model itself.
    cell = with_derivative_pole(with_gain_ratio(at_rate(scenario_of("flapper", law="pd"), 500.0), 1.5), 300.0)
    assert result["channels"]["z"]["max_delay_s"] == linear_margins(cell)["z"].max_delay_s


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere",), "there is no scenario nowhere"),
        (("flapper", "--law", "lqr"), "there is no law 'lqr'"),
        (("flapper", "--rate", "300"), "not a whole number of microseconds"),
        (("flapper", "--gain-ratio", "0"), "--gain-ratio"),
        (("flapper", "--n-filter", "-1"), "--n-filter"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(
    arguments: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = call(capsys, *arguments, "--out", str(tmp_path / "none"))
    assert ended.code == 2
    (line,) = ended.err.splitlines()
    assert words in line
    assert ended.out == ""


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    ended = call(capsys, "flapper", "--out", str(tmp_path / "file" / "study"))
    assert ended.code == 6
    assert "cannot create the folder" in ended.err
