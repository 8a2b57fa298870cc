"""Distributions: percentiles to the histogram's three digits, and files as HdrHistogram's plotters read them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fwav_hil.latency.histogram import PERCENTILES, percentiles, write_hgrm
from protocol.errors import RunFolderError

ORDER = [*PERCENTILES, "max"]
ROW = re.compile(r"^\s*([\d.]+)\s+([\d.]+)\s+(\d+)(?:\s+([\d.]+))?\s*$")


def ns(*values: int) -> npt.NDArray[np.int64]:
    return np.array(values, dtype=np.int64)


def read_hgrm(path: Path) -> list[tuple[float, float, int]]:
    """(value in us, share, count up to there) of each row."""
    lines = path.read_text().splitlines()
    assert lines[0].split() == ["Value", "Percentile", "TotalCount", "1/(1-Percentile)"]
    rows = [(float(row[1]), float(row[2]), int(row[3])) for row in map(ROW.match, lines) if row]
    trailer = [line for line in lines if line.startswith("#[")]
    assert len(trailer) == 3
    assert len(rows) + 2 + len(trailer) >= len([line for line in lines if line])
    return rows


def test_a_known_distribution() -> None:
    """1 .. 10000 us: each percentile is its own rank."""
    values = np.random.default_rng(1).permutation(np.arange(1, 10_001, dtype=np.int64) * 1000)
    found = percentiles(values)
    assert found["count"] == 10_000
    expected = {"p50": 5000.0, "p90": 9000.0, "p99": 9900.0, "p999": 9990.0, "p9999": 9999.0, "max": 10_000.0}
    assert {name: found[name] for name in ORDER} == pytest.approx(expected, rel=1e-3)
    assert found["max"] == 10_000.0


def test_one_late_one_in_a_thousand_is_in_the_maximum_and_in_no_percentile_below_it() -> None:
    found = percentiles(ns(*[10_000] * 1999, 50_000_000))
    assert found["max"] == 50_000.0
    assert [found[name] for name in ("p50", "p90", "p99", "p999")] == pytest.approx([10.0] * 4, rel=1e-3)
    assert found["p9999"] == pytest.approx(50_000.0, rel=1e-3)


@settings(max_examples=60)
@given(st.lists(st.integers(0, 10**11), min_size=1, max_size=50))
def test_percentiles_rise_up_to_the_maximum_which_is_exact(values: list[int]) -> None:
    found = percentiles(ns(*values))
    shown = [found[name] for name in ORDER]
    assert shown == sorted(shown)  # type: ignore[type-var]
    assert found["max"] == max(values) / 1e3
    assert found["p50"] == pytest.approx(sorted(values)[(len(values) - 1) // 2] / 1e3, rel=2e-3, abs=2e-3)


def test_of_nothing_there_is_nothing_to_say() -> None:
    assert percentiles(ns()) == {"count": 0, **dict.fromkeys(ORDER)}


def test_what_is_longer_than_the_histogram_still_counts() -> None:
    found = percentiles(ns(1000, 10**15))
    assert found["count"] == 2
    assert found["max"] == 1e12


def test_the_file_is_that_of_the_plotters(tmp_path: Path) -> None:
    values = np.arange(1, 10_001, dtype=np.int64) * 1000
    path = tmp_path / "age.hgrm"
    write_hgrm(path, values)
    rows = read_hgrm(path)
    assert len(rows) > 20
    assert rows == sorted(rows)
    assert rows[-1][0] == pytest.approx(10_000.0, rel=1e-3)
    assert rows[-1][1:] == (1.0, 10_000)
    for value_us, share, count in rows:
        assert value_us == pytest.approx(max(1.0, 10_000 * share), rel=2e-3, abs=1.0)
        assert count == pytest.approx(10_000 * share, abs=10)


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"cannot write .*age\.hgrm"):
        write_hgrm(tmp_path / "nowhere" / "age.hgrm", ns(1))
