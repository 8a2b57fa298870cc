"""Gains for a link: the search for K, Lambda, T and N of position and of attitude.

It minimises the tracking error subject to: a gain margin of 2 both ways and stability at twice the delay, by the eigenvalues
of the linear loop (`loop_model`), and no flight lost (`flight_check`), neither at the link's delay nor at twice that.

The error of a set of gains is the geometric mean of the RMSE of the group's axes, over the whole flight and from 2 s on, over
a few seeds of noise: axes of any unit have equal weight, and so have start-up and steady flight. The optimiser is
scipy's differential evolution over the logarithms of the gains, first attitude (it does not depend on position), then
position. The scenario's own gains are a candidate (those of the group's first axis, clipped to the bounds of the search);
where they fly on this link, a cell (axis, whole flight or from 2 s on) that is worse than theirs is penalised, so that no
axis improves at the cost of another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.optimize import Bounds, OptimizeResult, differential_evolution

from controller.laws.filters import Filters
from controller.laws.law import Law, make_law
from controller.laws.registry import make_realisation
from controller.laws.state_space import Realisation
from controller.laws.ude import UdeGains
from fwav_hil.score import SETTLED_S, tracking_error
from fwav_hil.simulate import simulate
from fwav_hil.studies.flight_check import judge_flight
from fwav_hil.studies.loop_model import channels_of
from protocol.errors import UsageError
from protocol.messages import AXES, FloatArray
from protocol.scenario import NANOSECONDS, Delay, Scenario, Vector6, replace_gains

MARGIN = 2.0
_SPARE = 1.01
"""Additional margin kept by the search, so that rounding its result does not lose the margin."""

SEARCHED = {
    "ude": ("K", "Lambda", "T", "N"),
    "ude_state": ("K", "Lambda", "T"),
    "uncompensated": ("K", "Lambda", "N"),
}
"""The gains searched, by law. The baselines' gains, Kp and Kd, are not searched."""

TABLES = {"K": "ude", "Lambda": "ude", "T": "filters", "N": "filters"}
"""The table of each gain, within the scenario's [gains]."""

_BOUNDS = {"K": (0.02, 3.0), "Lambda": (0.003, 1.0), "T": (0.2, 30.0), "N": (0.2, 30.0)}
"""Lowest and highest of each, in units of 1/d (T: of d), d being the delay plus one and a half periods."""

_POPULATION = 8
"""Number of gain sets in a generation, for each gain searched."""

_PUNISHED = 10.0
_CLEARLY = 0.03
"""A cell should be better by three per cent, since later flights have other seeds than the search."""

_INFEASIBLE = 1e3
_LOST = 1e2


class Group(NamedTuple):
    """Three axes with common gains."""

    name: str
    axes: range


GROUPS = (Group("attitude", range(3, 6)), Group("position", range(3)))


class Task(msgspec.Struct, frozen=True):
    """The data of one evaluation: the scenario with the gains found so far, the group, and the seeds to fly.

    own: mean log RMSE of the group's axes with the initial gains, as from `flown_error`; None where a flight is lost.
    """

    scenario: Scenario
    group: str
    axes: tuple[int, ...]
    names: tuple[str, ...]
    seeds: tuple[int, ...]
    own: tuple[tuple[float, ...], ...] | None


def with_gains(scenario: Scenario, axes: Iterable[int], names: Iterable[str], values: Iterable[float]) -> Scenario:
    """The scenario with these gains on these axes."""
    axes = tuple(axes)
    for name, value in zip(names, values, strict=True):
        gains = list(gain_of(scenario, name))
        for axis in axes:
            gains[axis] = float(value)
        scenario = replace_gains(scenario, TABLES[name], **{name: gains})
    return scenario


def gain_of(scenario: Scenario, name: str) -> Vector6:
    """One of the searched gains, on each axis."""
    table = TABLES[name]
    gain: Vector6 = getattr(scenario.read_gains(table, UdeGains if table == "ude" else Filters), name)
    return gain


def shortfall(scenario: Scenario, axes: Iterable[int], margin: float = MARGIN, law: Realisation | None = None) -> float:
    """How far the loops of these axes miss their margins: the poles' excess over the unit circle, summed; 0: not at all.

    Checked: gains from 1/margin to margin times at the delay, and delays from 0 to margin times. `law`: reused if given.
    """
    delay_s = scenario.delay_ns / NANOSECONDS
    loops = list(channels_of(scenario, law or make_realisation(scenario.law, scenario)).values())
    seen: list[int] = []
    total = 0.0
    for axis in axes:
        if any(loops[axis].twin_of(loops[other]) for other in seen):
            continue
        seen.append(axis)
        ratio = loops[axis].ratio
        corners = [(ratio * factor, delay_s) for factor in np.geomspace(1.0 / margin, margin, 7)]
        corners += [(ratio, margin * delay_s * k / 6.0) for k in range(7)]
        for gain, delay in corners:
            total += max(0.0, float(np.abs(loops[axis].poles(gain, delay)).max()) - 1.0 + 1e-9)
    return total


def flown_error(
    scenario: Scenario, seeds: Iterable[int], law: Law | None = None
) -> tuple[FloatArray | None, str | None]:
    """(log of RMSE over the flight and from 2 s on, (m, 6), mean over the seeds; None) or (None, why a flight is lost)."""
    law = law or make_law(scenario.law, scenario)
    logs = []
    for seed in seeds:
        one = msgspec.structs.replace(scenario, seed=seed)
        result = simulate(one, law)
        if why := judge_flight(one, result).lost:
            return None, why
        error = tracking_error(one, result.q)
        parts = [error, error[result.t_ns >= SETTLED_S * NANOSECONDS]]
        logs.append([np.log(np.sqrt(np.mean(part**2, axis=0)) + 1e-12) for part in parts if len(part)])
    return np.mean(logs, axis=0), None


def at_twice_the_delay(scenario: Scenario) -> Scenario:
    """The scenario with `MARGIN` times its total delay."""
    return msgspec.structs.replace(
        scenario, delay=Delay(samples=0, seconds=min(1.0, MARGIN * scenario.delay_ns / NANOSECONDS))
    )


def cost(task: Task, logarithms: FloatArray) -> float:
    """The mean log RMSE of the group's axes; far higher where a flight is lost, higher still where margins are short."""
    candidate = with_gains(task.scenario, task.axes, task.names, np.exp(logarithms))
    law = make_law(candidate.law, candidate)  # no delay and no seed changes it
    missing = shortfall(candidate, task.axes, _SPARE * MARGIN, law.realisation)
    if missing > 0.0:
        return _INFEASIBLE * (1.0 + min(missing, 100.0))
    if flown_error(at_twice_the_delay(candidate), task.seeds[:1], law)[1]:
        return _LOST
    logs, lost = flown_error(candidate, task.seeds, law)
    if logs is None or lost:
        return 2.0 * _LOST
    mine = logs[:, list(task.axes)]
    worse = 0.0 if task.own is None else float(np.maximum(mine - np.array(task.own) + _CLEARLY, 0.0).mean())
    return float(mine.mean()) + _PUNISHED * worse


class Found(NamedTuple):
    """The result of a search: the scenario with its gains, and how many sets of gains were tried."""

    scenario: Scenario
    evaluations: int


Map = Callable[[Callable[[FloatArray], float], Iterable[FloatArray]], Iterable[float]]


def gains_of(scenario: Scenario) -> tuple[str, ...]:
    """The names of the gains of the scenario's law. Raises UsageError for a law whose gains cannot be searched."""
    if scenario.law not in SEARCHED:
        raise UsageError(
            f"`design` searches the gains K, Lambda, T and N, which the law '{scenario.law}' does not have: "
            f"choose one of {', '.join(SEARCHED)}"
        )
    return SEARCHED[scenario.law]


def bounds(scenario: Scenario, names: Iterable[str]) -> list[tuple[float, float]]:
    """Lowest and highest logarithm of each gain, from the delay and the rate of the link."""
    d = (scenario.delay_ns + 1.5 * scenario.period_ns) / NANOSECONDS
    return [
        (float(np.log(low * d)), float(np.log(high * d))) if name == "T" else
        (float(np.log(low / d)), float(np.log(high / d)))
        for name in names
        for low, high in (_BOUNDS[name],)
    ]  # fmt: skip


def search(
    scenario: Scenario,
    *,
    seed: int,
    flights: int,
    generations: int,
    mapping: Callable[[Task], Map],
    progress: Callable[[str, float], None] = lambda _group, _cost: None,
) -> Found:
    """Search attitude, then position; `mapping` makes the map over candidates for a task; `progress`: called each generation.

    seed: of the optimiser; the flights' noise has the scenario's seed and those after it. Raises UsageError where no gains
    within the bounds have the margins, and for a scenario of less than 4 s.
    """
    names = gains_of(scenario)
    if scenario.duration_s < 2.0 * SETTLED_S:
        raise UsageError(
            f"duration_s {scenario.duration_s:g} is too short to judge gains: make it {2.0 * SETTLED_S:g} s or more"
        )
    evaluations = 0
    for group in GROUPS:
        limits = bounds(scenario, names)
        seeds = tuple(range(scenario.seed, scenario.seed + flights))
        start, _ = flown_error(scenario, seeds)
        held = None if start is None else tuple(tuple(row[list(group.axes)].tolist()) for row in start)
        task = Task(scenario, group.name, tuple(group.axes), names, seeds, held)
        own = np.log([gain_of(scenario, name)[group.axes[0]] for name in names])
        low, high = np.array(limits).T

        result = differential_evolution(
            _evaluated_by_the_map,
            Bounds(low, high),
            x0=np.clip(own, low, high),
            rng=np.random.default_rng([seed, group.axes[0]]),
            popsize=_POPULATION,
            maxiter=generations,
            tol=1e-4,
            init="sobol",
            polish=False,
            updating="deferred",
            workers=mapping(task),
            callback=_teller(group.name, progress),
        )
        evaluations += int(result.nfev)
        if result.fun >= _LOST:
            raise UsageError(
                f"no gains of {group.name} were found with a gain margin of {MARGIN:g} both ways and {MARGIN:g} times "
                f"the delay of {scenario.delay_ns / 1e6:g} ms at {scenario.rate_hz:g} Hz: "
                "try a higher rate, less delay or more --generations"
            )
        scenario = _rounded(with_gains(scenario, group.axes, names, np.exp(result.x)), group, names)
    return Found(scenario, evaluations)


def _evaluated_by_the_map(_: FloatArray) -> float:
    """The optimiser passes this to the map, which evaluates the task instead."""
    raise NotImplementedError


def _teller(name: str, progress: Callable[[str, float], None]) -> Callable[[OptimizeResult], None]:
    def tell(intermediate_result: OptimizeResult) -> None:  # the optimiser requires this argument name
        progress(name, float(intermediate_result.fun))

    return tell


def _rounded(scenario: Scenario, group: Group, names: Iterable[str]) -> Scenario:
    """Gains rounded to three digits, if they keep the margins."""
    names = tuple(names)
    values = [float(f"{gain_of(scenario, name)[group.axes[0]]:.3g}") for name in names]
    plain = with_gains(scenario, group.axes, names, values)
    return plain if shortfall(plain, group.axes) == 0.0 else scenario


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """Gains flown over seeds not used in the search: RMSE by axis (m, rad), median and worst; or why a flight is lost."""

    rmse_median: dict[str, float] | None
    rmse_worst: dict[str, float] | None
    rmse_settled_median: dict[str, float] | None
    rmse_settled_worst: dict[str, float] | None
    lost: str | None


def compare(scenario: Scenario, seeds: Iterable[int]) -> tuple[Comparison, FloatArray | None]:
    """Fly the seeds; also the mean log RMSE (m, 6) of `flown_error`, None where a flight is lost."""
    seeds = tuple(seeds)
    logs = []
    for seed in seeds:
        found, lost = flown_error(scenario, (seed,))
        if found is None:
            return Comparison(
                rmse_median=None, rmse_worst=None, rmse_settled_median=None, rmse_settled_worst=None, lost=lost
            ), None
        logs.append(found)
    errors = np.exp(np.array(logs))  # (seeds, m, 6)
    whole, settled = errors[:, 0], errors[:, 1] if errors.shape[1] > 1 else None
    return Comparison(
        rmse_median=_by_axis(np.median(whole, axis=0)),
        rmse_worst=_by_axis(np.max(whole, axis=0)),
        rmse_settled_median=None if settled is None else _by_axis(np.median(settled, axis=0)),
        rmse_settled_worst=None if settled is None else _by_axis(np.max(settled, axis=0)),
        lost=None,
    ), np.asarray(np.mean(logs, axis=0))


def _by_axis(values: FloatArray) -> dict[str, float]:
    return dict(zip(AXES, values.tolist(), strict=True))
