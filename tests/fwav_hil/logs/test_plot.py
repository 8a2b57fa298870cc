"""`fwav-hil log plot`."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from fwav_hil.logs.choice import Choice
from fwav_hil.logs.plot import lines_of
from protocol.logs.files import open_log
from tests.fwav_hil.logs.conftest import COUNT, Shell
from tests.protocol.logs.log_records import KNOWN, Pen

TIMES = np.array([0.1 * row + (1.0 if row >= 30 else 0.0) for row in range(COUNT)])


def test_the_lines_of_a_field(flight_log: Path) -> None:
    (line,) = lines_of(open_log(flight_log), "ATT_POS_MOCAP.x", Choice())
    assert line.label == ""
    np.testing.assert_allclose(line.t_s, TIMES)
    np.testing.assert_allclose(line.values, 0.1 * np.arange(COUNT), rtol=1e-6)


def test_one_element_and_all_elements_of_an_array(flight_log: Path) -> None:
    log = open_log(flight_log)
    (line,) = lines_of(log, "ATT_POS_MOCAP.q[3]", Choice())
    assert line.label == "[3]"
    np.testing.assert_array_equal(line.values, np.arange(COUNT))
    assert [line.label for line in lines_of(log, "ATT_POS_MOCAP.q", Choice())] == ["[0]", "[1]", "[2]", "[3]"]


def test_each_sender_has_a_line_of_its_own(tmp_path: Path) -> None:
    pens = [Pen(system=system) for system in (1, 2)]
    (tmp_path / "two.tlog").write_bytes(b"".join(pen.record(30).data for _ in range(5) for pen in pens))
    assert 30 in KNOWN
    log = open_log(tmp_path / "two.tlog")
    assert [line.label for line in lines_of(log, "ATTITUDE.roll", Choice())] == ["1.191", "2.191"]
    assert [line.label for line in lines_of(log, "ATTITUDE.roll", Choice(senders=[(2, None)]))] == [""]


def test_the_picture(shell: Shell, flight_log: Path, tmp_path: Path) -> None:
    ended = shell("plot", flight_log, "ATT_POS_MOCAP.x", "HIL_ACTUATOR_CONTROLS.controls", "--from", "1")
    assert ended == (0, "plot: flight_plot.png\n", "")
    picture = matplotlib.image.imread(tmp_path / "flight_plot.png")
    assert picture.shape[0] > 300
    assert picture.std() > 0.01
    assert {path.name for path in tmp_path.iterdir()} == {"flight_plot.png", "flight.tlog"}


def test_a_picture_that_is_there_stays(shell: Shell, flight_log: Path, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"mine")
    ended = shell("plot", flight_log, "ATT_POS_MOCAP.x", "--out", "a.png")
    assert (ended.code, ended.err) == (
        6,
        "fwav-hil: a.png is there already and stays: choose another place with --out\n",
    )
    assert (tmp_path / "a.png").read_bytes() == b"mine"


def test_a_place_that_cannot_be_written(shell: Shell, flight_log: Path) -> None:
    ended = shell("plot", flight_log, "ATT_POS_MOCAP.x", "--out", "no/such/a.png")
    assert (ended.code, ended.err) == (6, "fwav-hil: cannot write no/such/a.png: No such file or directory\n")


@pytest.mark.parametrize(
    ("field", "sentence"),
    [
        ("ATT_POS_MOCAP.w", "ATT_POS_MOCAP has no field w; it holds time_usec, q, x, y, z, covariance"),
        ("ATT_POS_MOCAP.time_sec", "ATT_POS_MOCAP has no field time_sec; did you mean time_usec?"),
        ("ATT_POS_MOCP.x", "{log} holds no message ATT_POS_MOCP; did you mean ATT_POS_MOCAP?"),
        ("x", "x is no field: write MESSAGE.field or MESSAGE.field[index]"),
        ("ATT_POS_MOCAP.q[4]", "ATT_POS_MOCAP.q[4]: ATT_POS_MOCAP.q has 4 elements"),
        ("ATT_POS_MOCAP.x[0]", "ATT_POS_MOCAP.x[0]: ATT_POS_MOCAP.x has no elements"),
        ("STATUSTEXT.text", "STATUSTEXT.text is text, which has no plot; "),
    ],
)
def test_a_field_that_is_none_is_one_sentence(shell: Shell, flight_log: Path, field: str, sentence: str) -> None:
    ended = shell("plot", flight_log, field)
    assert (ended.code, ended.out) == (2, "")
    assert ended.err.startswith("fwav-hil: " + sentence.format(log=flight_log))
    assert len(ended.err.splitlines()) == 1


def test_a_system_that_sent_no_such_message(shell: Shell, flight_log: Path) -> None:
    ended = shell("plot", flight_log, "ATT_POS_MOCAP.x", "--system", "9")
    assert (ended.code, ended.err) == (2, f"fwav-hil: {flight_log} holds no ATT_POS_MOCAP of that time and system\n")
