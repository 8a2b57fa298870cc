"""How well a run followed its reference: RMSE (34) and MAE (35) of the true state, per axis."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from controller.laws.reference import reference_trajectory
from protocol.messages import AXES, FloatArray
from protocol.scenario import NANOSECONDS, Scenario

SETTLED_S = 2.0
"""Start of the settled part: the start-up transient is over."""


def desired_positions(scenario: Scenario, count: int) -> FloatArray:
    """q_d(t_k) (count, 6) of a scenario."""
    return reference_trajectory(scenario.reference, count, scenario.period_ns)[:, 0]


def tracking_error(scenario: Scenario, q: FloatArray) -> FloatArray:
    """q - q_d (n, 6) of true positions q(t_k) (n, 6), angles wrapped to +-pi."""
    error = q - desired_positions(scenario, len(q))
    error[:, 3:] = (error[:, 3:] + np.pi) % (2.0 * np.pi) - np.pi
    return np.asarray(error)


def scores(scenario: Scenario, t_ns: npt.NDArray[np.int64], q: FloatArray) -> dict[str, Any]:
    """`rmse` and `mae` over the run, and both from SETTLED_S on (None where the run is shorter); m and rad by axis."""
    error = tracking_error(scenario, q)
    settled = error[t_ns >= SETTLED_S * NANOSECONDS]
    return {
        "rmse": _by_axis(_rmse(error)),
        "mae": _by_axis(_mae(error)),
        "rmse_settled": _by_axis(_rmse(settled)) if len(settled) else None,
        "mae_settled": _by_axis(_mae(settled)) if len(settled) else None,
    }


def _rmse(error: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(error**2, axis=0))) if len(error) else np.full(6, np.nan)


def _mae(error: FloatArray) -> FloatArray:
    return np.asarray(np.mean(np.abs(error), axis=0)) if len(error) else np.full(6, np.nan)


def _by_axis(values: FloatArray) -> dict[str, float | None]:
    return {axis: float(value) if np.isfinite(value) else None for axis, value in zip(AXES, values, strict=True)}
