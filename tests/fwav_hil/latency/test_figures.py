"""The plot is drawn for whatever there is, and a line can be told from another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from matplotlib.image import imread

from fwav_hil.latency.analysis import LEGS
from fwav_hil.latency.figures import COLOURS, STYLES, draw
from protocol.errors import RunFolderError

NONE = np.zeros(0, dtype=np.int64)


def values(count: int) -> npt.NDArray[np.int64]:
    return np.arange(1, count + 1, dtype=np.int64) * 1000


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_it_draws_however_much_there_is(count: int, tmp_path: Path) -> None:
    path = tmp_path / "latency.png"
    curves = {"wake": values(count), "age": values(count), "to_kernel": NONE, "apply": values(count) * 0}
    assert draw(path, "title", curves, (np.arange(count) * 1e-3, "age", values(count))) == path
    assert imread(path).shape[:2] == (450, 1080)


def test_every_leg_has_a_line_of_its_own() -> None:
    assert len(set(COLOURS)) * len(set(STYLES)) >= len(LEGS)


def test_more_curves_change_the_picture(tmp_path: Path) -> None:
    series = (np.zeros(1), "age", values(1))
    one = draw(tmp_path / "one.png", "t", {"wake": values(9)}, series)
    two = draw(tmp_path / "two.png", "t", {"wake": values(9), "age": 2 * values(9)}, series)
    assert one.read_bytes() != two.read_bytes()


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"cannot write the figure .*latency\.png"):
        draw(tmp_path / "nowhere" / "latency.png", "t", {}, (NONE, "age", NONE))
