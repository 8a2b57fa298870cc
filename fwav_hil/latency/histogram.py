"""Distributions of durations: HDR histograms, their percentiles, their files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from hdrh.histogram import HdrHistogram

from bridge.summary import write_text

PERCENTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p999": 99.9, "p9999": 99.99}
_LONGEST_NS = 3_600_000_000_000
_DIGITS = 3


def histogram_of(durations_ns: npt.NDArray[np.int64]) -> Any:
    """An HDR histogram of durations (n,) in ns, three significant digits, up to an hour."""
    histogram = HdrHistogram(1, _LONGEST_NS, _DIGITS)
    values, counts = np.unique(np.clip(durations_ns, 1, _LONGEST_NS), return_counts=True)
    for value, count in zip(values.tolist(), counts.tolist(), strict=True):
        histogram.record_value(value, count)
    return histogram


def percentiles(durations_ns: npt.NDArray[np.int64]) -> dict[str, float | int | None]:
    """count, p50 to p9999 and max, in microseconds; None each where there are no values."""
    if not len(durations_ns):
        return {"count": 0, **dict.fromkeys((*PERCENTILES, "max"))}
    histogram = histogram_of(durations_ns)
    most_us = float(durations_ns.max()) / 1e3
    shown = {  # a histogram gives the upper end of a bin, which may lie above the largest value
        name: min(most_us, histogram.get_value_at_percentile(share) / 1e3) for name, share in PERCENTILES.items()
    }
    return {"count": len(durations_ns), **shown, "max": most_us}


def write_hgrm(path: Path, durations_ns: npt.NDArray[np.int64]) -> None:
    """Write the percentile distribution in microseconds as HdrHistogram's plotters read it. Raises RunFolderError."""
    out = io.BytesIO()
    histogram_of(durations_ns).output_percentile_distribution(out, 1000.0)
    write_text(path, out.getvalue().decode())
