"""The plots of a run: files that are pictures, or one sentence why there are none."""

from __future__ import annotations

import struct
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from matplotlib.figure import Figure

from fwav_hil.plots import _show_limits, plot_run
from fwav_hil.simulate import simulate
from fwav_hil.simulation_results import ground_truth
from protocol.errors import RunFolderError
from protocol.scenario import find_scenario, load_scenario

SCENARIO = msgspec.structs.replace(load_scenario(find_scenario("flapper")), duration_s=0.5)
NAMES = {"tracking", "error", "command", "hysteresis"}


@pytest.fixture(scope="module")
def truth() -> npt.NDArray[np.void]:
    return ground_truth(simulate(SCENARIO))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("plots")


@pytest.fixture(scope="module")
def plots(folder: Path, truth: npt.NDArray[np.void]) -> dict[str, Path]:
    return plot_run(folder, SCENARIO, truth, "flapper, ude, 250 Hz")


def test_there_are_four_and_nothing_else(plots: dict[str, Path], folder: Path) -> None:
    assert set(plots) == NAMES
    assert sorted(plots.values()) == sorted(folder.iterdir()) == sorted(folder / f"{name}.png" for name in NAMES)


@pytest.mark.parametrize("name", sorted(NAMES))
def test_each_is_a_picture_that_fills_a_screen(plots: dict[str, Path], name: str) -> None:
    data = plots[name].read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    assert data[12:16] == b"IHDR"
    width, height = struct.unpack(">II", data[16:24])
    assert 1000 <= width <= 4000
    assert 500 <= height <= 3000
    assert 10_000 < len(data) < 2_000_000, "neither blank nor a burden"
    assert data.endswith(b"IEND\xaeB`\x82"), "whole"


def test_they_differ(plots: dict[str, Path]) -> None:
    assert len({path.read_bytes() for path in plots.values()}) == len(NAMES)


def test_the_run_is_left_as_it_was(plots: dict[str, Path], truth: npt.NDArray[np.void]) -> None:
    assert plots
    assert truth.tobytes() == ground_truth(simulate(SCENARIO)).tobytes()


def test_a_folder_that_is_not_there_is_named(tmp_path: Path, truth: npt.NDArray[np.void]) -> None:
    with pytest.raises(RunFolderError, match=r"cannot write the plot .*nowhere/tracking\.png: No such file"):
        plot_run(tmp_path / "nowhere", SCENARIO, truth, "")


@pytest.mark.parametrize("count", [0, 1])
def test_a_run_of_hardly_a_tick_can_be_drawn(
    tmp_path: Path, truth: npt.NDArray[np.void], monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)  # drawing takes a second each
    assert set(plot_run(tmp_path, SCENARIO, truth[:count], "short")) == NAMES


@pytest.mark.parametrize(
    ("low", "high", "shown"),
    [(-1.0, 1.0, [-2.0, 2.0]), (-0.8, 1.0, [2.0]), (-1.0, 0.8, [-2.0]), (-0.8, 0.8, []), (-0.95, 0.95, [-2.0, 2.0])],
)
def test_a_limit_is_shown_where_the_command_came_near(low: float, high: float, shown: list[float]) -> None:
    """Limits of 1 and -1, drawn at twice their value as the curve is; near is a tenth."""
    actuators = msgspec.structs.replace(SCENARIO.actuators, lower=(-1.0,) * 6, upper=(1.0,) * 6, scale=(1.0,) * 6)
    scenario = msgspec.structs.replace(SCENARIO, actuators=actuators)
    panel = Figure().subplots()
    _show_limits(panel, 2.0, scenario, 0, np.array([0.0, low, high, 0.0]))
    assert [np.asarray(line.get_ydata())[0] for line in panel.get_lines()] == shown
