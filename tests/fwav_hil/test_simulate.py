"""The closed loop in one process: what it must fly, and that it is just the parts of the two ends put together."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from controller.laws.law import make_law
from controller.laws.reference import reference_trajectory
from fwav_hil.simulate import Simulation, simulate
from plant_emulator.plant.backlash import GearHysteresis
from plant_emulator.plant.integrate import PENDING, Plant
from plant_emulator.plant.safety import SafetyEnvelope
from plant_emulator.plant.sensors import PositionSensor, add_noise
from protocol.errors import UsageError
from protocol.messages import ActuatorCommand, FloatArray
from protocol.scenario import Delay, Noise, Play, Scenario, find_scenario, load_scenario
from protocol.wire import mapping

FLAPPER = load_scenario(find_scenario("flapper"))
PAPER = load_scenario(find_scenario("paper"))
FIELDS = ("q", "q_dot", "command", "tau", "u")
DEGREE = np.pi / 180.0


def replaced(scenario: Scenario, **changes: Any) -> Scenario:
    copy: Scenario = msgspec.structs.replace(scenario, **changes)
    return copy


def errors(scenario: Scenario, run: Simulation, from_s: float = 0.0) -> FloatArray:
    """True q - q_d (n, 6), from a time on."""
    error: FloatArray = run.q - reference_trajectory(scenario.reference, len(run.q), scenario.period_ns)[:, 0]
    return error[round(from_s * scenario.rate_hz) :]


def rmse(scenario: Scenario, run: Simulation, from_s: float = 0.0) -> FloatArray:
    result: FloatArray = np.sqrt(np.mean(np.square(errors(scenario, run, from_s)), axis=0))
    return result


def same_bytes(one: Simulation, other: Simulation) -> bool:
    return all(getattr(one, field).tobytes() == getattr(other, field).tobytes() for field in FIELDS)


@pytest.mark.parametrize("rate_hz", [250.0, 500.0])
def test_flapper_stays_within_its_bounds(rate_hz: float) -> None:
    scenario = replaced(FLAPPER, rate_hz=rate_hz)
    run = simulate(scenario)
    assert run.divergence is None
    whole, late = rmse(scenario, run), rmse(scenario, run, from_s=2.0)
    assert whole[:3].max() <= 0.005
    assert whole[3:].max() <= 0.45 * DEGREE
    assert late[:3].max() <= 0.001
    assert late[3:].max() <= 0.20 * DEGREE


def test_without_noise_the_backlash_is_not_dithered_away() -> None:
    """A limit cycle of the gears, which the noise of `flapper` breaks up: its attitude is worse without any."""
    quiet = replaced(FLAPPER, noise=Noise())
    assert rmse(quiet, simulate(quiet), 2.0)[3:].min() > 1.2 * rmse(FLAPPER, simulate(FLAPPER), 2.0)[3:].max()


def test_the_papers_run_follows_its_reference() -> None:
    run = simulate(PAPER)
    assert run.divergence is None
    assert all(np.isfinite(getattr(run, field)).all() for field in FIELDS)
    late = np.abs(errors(PAPER, run, from_s=2.0)).max(axis=0)
    assert late[:3].max() < 0.03
    assert late[3:].max() < 0.05


def test_the_paper_says_and_so_do_we_that_pd_is_worse_on_every_axis() -> None:
    ude, pd = (rmse(PAPER, simulate(PAPER, make_law(name, PAPER))) for name in ("ude", "pd"))
    assert np.all(pd > ude)


def test_the_papers_gains_are_of_no_use_at_100_hz() -> None:
    """They ring between the limits, which keep the flight from ending: nothing like the run at 1 kHz."""
    slow = replaced(PAPER, rate_hz=100.0)
    run = simulate(slow)
    assert run.law_counts["saturated"] > 0.4 * slow.ticks
    assert rmse(slow, run, 2.0)[3:].min() > 5.0 * rmse(PAPER, simulate(PAPER), 2.0)[3:].max()


@pytest.mark.parametrize("delay_s", [0.03, 0.06])
def test_a_divergence_ends_the_run_and_is_named(delay_s: float) -> None:
    scenario = replaced(FLAPPER, delay=Delay(samples=1, seconds=delay_s))
    run = simulate(scenario)
    count = len(run.t_ns)
    assert 0 < count < scenario.ticks
    assert run.divergence is not None
    assert run.divergence.startswith(
        f"the flight diverged at t = {count / 250:.3f} s: the pitch angle exceeded 1.4 rad"
    )
    assert all(getattr(run, field).shape == (count, 6) for field in FIELDS)
    assert np.abs(run.q[:, 4]).max() < 1.4, "the rows are those from before"
    assert run.law_counts["steps"] == count


def test_a_queue_that_is_too_short_for_the_delay_ends_the_run_and_is_named() -> None:
    """No command may get lost without a word: Plant.command raises for the same reason."""
    scenario = replaced(FLAPPER, rate_hz=5000.0, substep_s=0.0002, duration_s=1.0, delay=Delay(seconds=1.0))
    run = simulate(scenario)
    assert len(run.t_ns) == PENDING
    assert run.divergence is not None
    assert f"more than {PENDING} delayed commands are pending" in run.divergence


@pytest.mark.parametrize("rate_hz", [100.0, 250.0, 1000.0])
def test_the_arrays_of_a_run_belong_together(rate_hz: float) -> None:
    scenario = replaced(FLAPPER, rate_hz=rate_hz, duration_s=1.0, delay=Delay())
    run = simulate(scenario)
    period = scenario.period_ns * 1e-9
    assert run.t_ns.tolist() == [k * scenario.period_ns for k in range(scenario.ticks)]
    assert all(getattr(run, field).shape == (scenario.ticks, 6) for field in FIELDS)
    assert np.concatenate((run.q[0], run.q_dot[0])).tolist() == scenario.initial_motion.tolist()
    # The trapezoidal rule's error is a twelfth of the period squared times the change of the acceleration.
    moved, mean = np.diff(run.q, axis=0), 0.5 * (run.q_dot[1:] + run.q_dot[:-1])
    jerk = np.abs(np.diff(run.q_dot, n=2, axis=0)).max(axis=0)
    assert np.all(np.abs(moved - period * mean) <= period * (0.5 * jerk + 1e-9))


@pytest.mark.parametrize(
    ("delay", "late"),
    [(Delay(), 0), (Delay(samples=1), 1), (Delay(seconds=0.001), 1), (Delay(samples=1, seconds=0.005), 3),
     (Delay(samples=2, seconds=0.004), 3)],
)  # fmt: skip
def test_a_command_acts_when_its_delay_is_over(delay: Delay, late: int) -> None:
    """At t_k acts the newest command with t_j + delay <= t_k; before the first one, the scenario's initial command."""
    run = simulate(replaced(FLAPPER, duration_s=0.4, delay=delay))
    allowed = np.clip(run.command, FLAPPER.actuators.lower, FLAPPER.actuators.upper)
    assert run.tau[late:].tobytes() == allowed[: len(allowed) - late].tobytes()
    assert run.tau[:late].tolist() == [list(FLAPPER.initial.command)] * late


class TestGivenDelays:
    """A delay for each command, in place of the scenario's."""

    SHORT = replaced(FLAPPER, duration_s=0.4)

    def delays(self, value_ns: int) -> npt.NDArray[np.int64]:
        return np.full(self.SHORT.ticks, value_ns)

    @pytest.mark.parametrize("delay", [Delay(), Delay(samples=1, seconds=0.005), Delay(seconds=0.0123)])
    def test_one_delay_for_all_is_the_scenarios_to_the_bit(self, delay: Delay) -> None:
        scenario = replaced(self.SHORT, delay=delay)
        assert same_bytes(simulate(scenario), simulate(self.SHORT, delays_ns=self.delays(scenario.delay_ns)))

    def test_a_command_below_zero_never_acts(self) -> None:
        delays_ns = self.delays(0)
        delays_ns[40:43] = -1
        run = simulate(self.SHORT, delays_ns=delays_ns)
        allowed = np.clip(run.command, FLAPPER.actuators.lower, FLAPPER.actuators.upper)
        allowed[40:43] = allowed[39]
        assert run.tau.tobytes() == allowed.tobytes()

    def test_where_none_acts_the_initial_command_stands(self) -> None:
        run = simulate(replaced(self.SHORT, duration_s=0.02), delays_ns=np.full(5, -1))
        assert run.tau.tolist() == [list(FLAPPER.initial.command)] * 5

    def test_no_command_overtakes_the_one_before_it(self) -> None:
        """Command 40 comes three periods late, so those after it wait for it: then the newest of them acts."""
        delays_ns = self.delays(0)
        delays_ns[40] = 3 * self.SHORT.period_ns
        run = simulate(self.SHORT, delays_ns=delays_ns)
        allowed = np.clip(run.command, FLAPPER.actuators.lower, FLAPPER.actuators.upper)
        allowed[40:43] = allowed[39]
        assert run.tau.tobytes() == allowed.tobytes()

    @pytest.mark.parametrize("shape", [(99,), (101,), (0,), (100, 1)])
    def test_another_number_of_delays_than_ticks_is_refused(self, shape: tuple[int, ...]) -> None:
        assert self.SHORT.ticks == 100
        with pytest.raises(UsageError, match="100 ticks"):
            simulate(self.SHORT, delays_ns=np.zeros(shape, dtype=np.int64))


@pytest.mark.parametrize("hysteresis", [FLAPPER.hysteresis, Play(h=(1.1,) * 6, B=(0.001,) * 3 + (2e-6,) * 3)])
def test_the_force_is_what_the_gears_make_of_the_commands(hysteresis: Any) -> None:
    """One command each period, so the gears can be moved again from the record, tick by tick."""
    run = simulate(replaced(FLAPPER, duration_s=1.0, hysteresis=hysteresis))
    gears = GearHysteresis(hysteresis, run.tau[0])
    assert run.divergence is None
    assert run.u[0].tolist() == gears.u.tolist()
    for tau, u in zip(run.tau[1:], run.u[1:], strict=True):
        assert gears.step(tau).tobytes() == u.tobytes()


def test_the_loop_is_the_parts_of_the_two_ends_put_together() -> None:
    """Sensor, wire, law, wire, safety envelope, plant: through the very messages, the same numbers to the bit."""
    # On this scale float32 rounds some limits up, so that the safety envelope has a hair to cut off.
    scale = 1.3 * np.array(FLAPPER.actuators.scale)
    actuators = msgspec.structs.replace(FLAPPER.actuators, scale=tuple(scale.tolist()))
    scenario = replaced(FLAPPER, duration_s=1.0, actuators=actuators)
    plant, law = Plant(scenario), make_law(scenario.law, scenario)
    sensor, envelope = PositionSensor(scenario.seed), SafetyEnvelope(scenario.actuators)
    state = law.start()
    rows, measured = [], np.empty(6)
    for k in range(scenario.ticks):
        t_ns = k * scenario.period_ns
        add_noise(plant.state.motion, sensor.draw(1)[0], scenario.noise.position, scenario.noise.attitude, measured)
        sample = mapping.decode_pose(mapping.encode_pose(t_ns, measured))
        assert sample is not None
        said = ActuatorCommand(sample.t_ns, law.step(state, sample.t_ns, sample.q), armed=True)
        heard = mapping.decode_command(mapping.encode_command(said, scale, lockstep=True), scale)
        assert heard is not None
        plant.command(t_ns + scenario.delay_ns, envelope.pass_command(t_ns, heard.tau, armed=heard.armed))
        plant.apply_due_commands()
        rows.append(np.concatenate((plant.state.motion, heard.tau, plant.state.tau, plant.state.u)))
        plant.advance(t_ns + scenario.period_ns)
    run = simulate(scenario)
    assert np.array(rows).tobytes() == np.concatenate([getattr(run, field) for field in FIELDS], axis=1).tobytes()
    assert envelope.counters == {"clamped": 0, "disarmed": 0, "stale": 0}
    assert np.any(run.command > scenario.actuators.upper) or np.any(run.command < scenario.actuators.lower)
    assert law.counts(state) == run.law_counts


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others() -> None:
    one, again, other = (simulate(replaced(FLAPPER, duration_s=1.0, seed=seed)) for seed in (1, 1, 2))
    assert same_bytes(one, again)
    assert one.command[0].tolist() != other.command[0].tolist()


def test_a_longer_run_begins_like_a_shorter_one() -> None:
    short, long = (simulate(replaced(FLAPPER, duration_s=duration_s)) for duration_s in (0.5, 1.0))
    assert long.q[: len(short.q)].tobytes() == short.q.tobytes()


def test_a_law_that_is_given_replaces_the_scenarios_own_and_is_left_as_it_was() -> None:
    scenario = replaced(FLAPPER, duration_s=1.0)
    pd = make_law("pd", scenario)
    first, second = simulate(scenario, pd), simulate(scenario, pd)
    named = simulate(replaced(scenario, law="pd"))
    assert same_bytes(first, second)
    assert same_bytes(first, named)
    assert not same_bytes(first, simulate(scenario))
    assert first.law_counts == second.law_counts == named.law_counts


def test_a_law_by_state_feedback_flies_here() -> None:
    """And nowhere else: the velocity that it needs is the true one of the plant."""
    run = simulate(replaced(FLAPPER, law="ude_state"))
    assert run.divergence is None
    assert rmse(FLAPPER, run, 2.0)[:3].max() < 0.001
