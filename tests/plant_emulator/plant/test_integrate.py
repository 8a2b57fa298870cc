"""The plant in time: the order of the integrator, the moment at which commands act, and how a flight ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from plant_emulator.plant.backlash import GearHysteresis
from plant_emulator.plant.integrate import PENDING, Plant, PlantState, runge_kutta_step
from plant_emulator.plant.rigid_body import BodyParameters, acceleration
from protocol.errors import DivergenceError
from protocol.messages import FloatArray
from protocol.scenario import ZERO6, Disturbance, Initial, Scenario, find_scenario, load_scenario, with_overrides

MS = 1_000_000
THRUST = np.array([0.0, 0.0, -0.05, 0.0, 0.0, 0.0])
PUSH = np.array([0.01, -0.02, -0.04, 1e-5, -5e-6, 2e-5])
PULL = np.array([-0.03, 0.02, -0.06, -2e-5, 8e-6, -1e-5])


def replaced(scenario: Scenario, **changes: object) -> Scenario:
    copy: Scenario = msgspec.structs.replace(scenario, **changes)
    return copy


@pytest.fixture(scope="module")
def flapper() -> Scenario:
    return load_scenario(find_scenario("flapper"))


@pytest.fixture(scope="module")
def tumbling(flapper: Scenario) -> Scenario:
    """A fast turning flight under a disturbance, so that every term of the integrator is at work."""
    return replaced(
        flapper,
        rate_hz=125.0,  # a period that steps of 8 ms still fit into
        initial=Initial(
            position=(1.0, 2.0, 3.0),
            attitude=(0.4, -0.3, 0.2),
            velocity=(0.5, -0.5, 0.1),
            attitude_rate=(4.0, 1.0, 9.0),
            command=tuple(THRUST),
        ),
        disturbance=Disturbance(amplitude=(0.01, 0.02, -0.03, 1e-5, -1e-5, 2e-5), frequency_rad_s=40.0),
    )


def exact_flight(plant: Plant, motion: FloatArray, t: Sequence[float], wrenches: Sequence[FloatArray]) -> FloatArray:
    """The motion at the end of t (s) by DOP853, where wrenches[i] is the u of the gears from t[i] to t[i + 1]."""
    body = plant.body

    def slope(now: float, state: FloatArray, u: FloatArray) -> FloatArray:
        wrench = body.specific * u + np.sin(body.disturbance_frequency * now) * body.disturbance
        alpha, beta, gamma = state[3:6].tolist()
        alpha_dot, beta_dot, gamma_dot = state[9:].tolist()
        q_ddot = acceleration(alpha, beta, gamma, alpha_dot, beta_dot, gamma_dot, tuple(wrench), body)
        return np.concatenate((state[6:], np.array(q_ddot)))

    for (start, end), u in zip(pairwise(t), wrenches, strict=True):
        motion = solve_ivp(slope, (start, end), motion, "DOP853", args=(u,), rtol=1e-12, atol=1e-13).y[:, -1]
    return motion


def measured_order(error: Callable[[int], float], steps_ns: Sequence[int]) -> list[float]:
    """log2 of how much the error shrinks each time the step is halved."""
    errors = [error(step_ns) for step_ns in steps_ns]
    assert min(errors) > 1e-12, "rounding must not hide the order"
    return [float(np.log2(coarse / fine)) for coarse, fine in pairwise(errors)]


def with_substep(scenario: Scenario, substep_ns: int) -> Plant:
    return Plant(replaced(scenario, substep_s=substep_ns * 1e-9))


def test_the_integrator_is_of_fourth_order(tumbling: Scenario) -> None:
    still = Plant(tumbling)
    expected = exact_flight(still, tumbling.initial_motion, [0.0, 0.2], [still.state.u])

    def error(substep_ns: int) -> float:
        plant = with_substep(tumbling, substep_ns)
        plant.advance(200 * MS)
        return float(np.abs(plant.state.motion - expected).max())

    for order in measured_order(error, [8 * MS, 4 * MS, 2 * MS]):
        assert order == pytest.approx(4.0, abs=0.4)


def test_a_command_that_splits_a_step_keeps_the_fourth_order(tumbling: Scenario) -> None:
    """Were the command put off to the grid, the order would be one."""
    arrival_ns = 63_700_001
    gears = GearHysteresis(tumbling.hysteresis, THRUST)
    before = gears.u.copy()
    pieces = [0.0, arrival_ns * 1e-9, 0.128]
    expected = exact_flight(Plant(tumbling), tumbling.initial_motion, pieces, [before, gears.step(PUSH)])

    def error(substep_ns: int) -> float:
        plant = with_substep(tumbling, substep_ns)
        plant.command(arrival_ns, PUSH)
        plant.advance(128 * MS)
        return float(np.abs(plant.state.motion - expected).max())

    for order in measured_order(error, [8 * MS, 4 * MS, 2 * MS]):
        assert order == pytest.approx(4.0, abs=0.6)


def test_a_split_step_equals_two_steps_of_a_finer_grid(tumbling: Scenario) -> None:
    coarse, fine = with_substep(tumbling, MS), with_substep(tumbling, MS // 4)
    by_hand = tumbling.initial_motion
    gears = GearHysteresis(tumbling.hysteresis, THRUST)
    runge_kutta_step(by_hand, gears.u, 0.0, 250_000 * 1e-9, coarse.body)
    runge_kutta_step(by_hand, gears.step(PUSH), 250_000 * 1e-9, 750_000 * 1e-9, coarse.body)
    for plant in (coarse, fine):
        plant.command(MS // 4, PUSH)
        plant.advance(MS)
    assert coarse.state.motion.tobytes() == by_hand.tobytes()
    assert coarse.state.u.tobytes() == fine.state.u.tobytes()
    # The finer grid goes on in steps of its own after the split: it differs by the integrator's error alone.
    assert fine.state.motion == pytest.approx(by_hand, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("axis", [0, 5])
def test_a_disturbance_acts_on_the_body_after_the_gears(flapper: Scenario, axis: int) -> None:
    """Level and without thrust, a sinusoidal wrench has a closed form: x'' = A/m sin wt, gamma'' = A/Izz sin wt."""
    inertia, w, t = (flapper.body.mass, flapper.body.inertia[2])[axis == 5], 30.0, 0.3
    amplitude = (4.0 * inertia, 0.0, 0.0, 0.0, 0.0, 0.0) if axis == 0 else (0.0, 0.0, 0.0, 0.0, 0.0, 4.0 * inertia)
    plant = Plant(
        replaced(
            flapper,
            initial=Initial(position=(0.0,) * 3, attitude=(0.0,) * 3),
            disturbance=Disturbance(amplitude=amplitude, frequency_rad_s=w),
        )
    )
    plant.advance(300 * MS)
    assert plant.state.motion[axis] == pytest.approx(4.0 * (t / w - np.sin(w * t) / w**2), rel=1e-8)
    assert plant.state.u.tolist() == [0.0] * 6


def test_the_plant_starts_with_its_initial_command_and_free_gears(flapper: Scenario) -> None:
    state = Plant(flapper).state
    assert state.motion.tolist() == [0.1, 0.1, 0.1, 0.5, 0.5, 0.5] + [0.0] * 6
    assert state.tau.tolist() == list(flapper.initial.command)
    assert state.u.tolist() == [h * tau for h, tau in zip(flapper.hysteresis.h, flapper.initial.command, strict=True)]
    assert state.d.tolist() == [0.0] * 6


def test_commands_due_at_once_move_the_gears_one_after_the_other(flapper: Scenario) -> None:
    """Each reversal counts: jumping to the last command alone leaves the gears elsewhere."""
    commands = [PUSH, PULL, PUSH, 0.5 * PULL]
    plant, gears, jump = Plant(flapper), *(GearHysteresis(flapper.hysteresis, THRUST) for _ in range(2))
    plant.state.tau[:], plant.state.u[:] = THRUST, gears.u
    for tau in commands:
        plant.command(3 * MS, tau)
        u = gears.step(tau)
    jumped = jump.step(commands[-1])
    plant.advance(4 * MS)
    assert plant.state.u.tobytes() == u.tobytes()
    assert plant.state.d.tobytes() == gears.d.tobytes()
    assert np.abs(jumped - u).min() > 1e-9


@settings(deadline=None, max_examples=30)
@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 3_000_000)), max_size=12), st.lists(st.integers(1, 39)))
def test_in_pieces_is_the_same_as_at_once(commands: list[tuple[int, int]], cuts: list[int]) -> None:
    scenario = load_scenario(find_scenario("flapper"))
    substep_ns = scenario.substep_ns
    at_once, in_pieces = Plant(scenario), Plant(scenario)
    rng = np.random.default_rng(3)
    t_ns = 0
    for size, wait_ns in commands:
        t_ns += wait_ns
        tau = rng.normal(size=6) * size * 1e-6
        at_once.command(t_ns, tau)
        in_pieces.command(t_ns, tau)
    at_once.advance(40 * substep_ns)
    for cut in sorted({*cuts, 40}):
        in_pieces.advance(cut * substep_ns)
    for one, other in zip(at_once.state, in_pieces.state, strict=True):
        assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize("delay_ns", [0, 1, 700_000, 4 * MS, 9 * MS + 123])
def test_a_command_acts_from_its_arrival_until_the_next(flapper: Scenario, delay_ns: int) -> None:
    """Command k acts on [t_k + delay, t_(k+1) + delay): observed by stopping at, and one ns before, each arrival."""
    period_ns = flapper.period_ns
    plant = Plant(flapper)
    for k in range(4):
        plant.command(k * period_ns + delay_ns, np.full(6, 1e-6 * (k + 1)))

    def acting(t_ns: int) -> float:
        # The plant itself stands still here: what counts is which commands have become due.
        plant.t_ns = t_ns
        plant.apply_due_commands()
        return float(plant.state.tau[0])

    for k in range(4):
        arrival_ns = k * period_ns + delay_ns
        if arrival_ns > 0:
            assert acting(arrival_ns - 1) == (1e-6 * k if k else flapper.initial.command[0])
        assert acting(arrival_ns) == 1e-6 * (k + 1)


def test_the_motion_shows_when_a_command_began_to_act(flapper: Scenario) -> None:
    """A push along x that lasts from 1.3 to 2.9 ms leaves the momentum of just 1.6 ms."""
    plant = Plant(
        replaced(flapper, hysteresis=straight_gears(flapper), initial=Initial(position=(0.0,) * 3, attitude=(0.0,) * 3))
    )
    push = np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])
    plant.command(1_300_000, push)
    plant.command(2_900_000, np.zeros(6))
    plant.advance(4 * MS)
    assert plant.state.motion[6] == pytest.approx(0.02 / flapper.body.mass * 1.6e-3, rel=1e-12)


def straight_gears(scenario: Scenario) -> object:
    """A play without width: u = tau."""
    table = {"model": "play", "h": (1.0,) * 6, "B": ZERO6}
    return with_overrides(scenario, hysteresis=table).hysteresis


class TestAllocation:
    """What leaves the actuators (u) and the wrench on the body are two things: wrench = allocation u."""

    @pytest.fixture
    def matrix(self) -> FloatArray:
        result: FloatArray = np.random.default_rng(5).normal(size=(6, 6))
        return result

    @pytest.fixture
    def mixed(self, flapper: Scenario, matrix: FloatArray) -> Plant:
        plant = Plant(replaced(flapper, initial=Initial(position=(0.0,) * 3, attitude=(0.0,) * 3)))
        plant.parameters["allocation"][0] = matrix
        return plant

    def test_by_default_there_are_six_forces(self, flapper: Scenario) -> None:
        plant = Plant(flapper)
        assert plant.state.wrench.tolist() == plant.state.u.tolist()
        plant.command(0, PUSH)
        plant.apply_due_commands()
        assert plant.state.wrench.tolist() == plant.state.u.tolist()

    def test_the_gears_see_the_command_and_the_body_the_wrench(
        self, flapper: Scenario, mixed: Plant, matrix: FloatArray
    ) -> None:
        gears = GearHysteresis(flapper.hysteresis, np.zeros(6))
        mixed.command(0, PUSH)
        mixed.command(0, PULL)
        mixed.apply_due_commands()
        gears.step(PUSH)
        u = gears.step(PULL)
        assert mixed.state.tau.tolist() == PULL.tolist()
        assert mixed.state.u.tobytes() == u.tobytes()
        assert mixed.state.wrench == pytest.approx(matrix @ u, rel=1e-12)

    def test_the_body_moves_by_the_wrench(self, flapper: Scenario, mixed: Plant, matrix: FloatArray) -> None:
        """A plant of six forces that is told to push with that wrench moves just so."""
        mixed.command(0, 1e-3 * PUSH)
        mixed.advance(MS)
        plain = Plant(replaced(flapper, initial=Initial(position=(0.0,) * 3, attitude=(0.0,) * 3)))
        plain.state.wrench[:] = matrix @ mixed.state.u
        plain.advance(MS)
        assert mixed.state.motion == pytest.approx(plain.state.motion, rel=1e-9, abs=1e-15)
        assert plain.state.u.tolist() == [0.0] * 6

    def test_the_accelerometer_feels_the_wrench(self, flapper: Scenario, mixed: Plant) -> None:
        mixed.command(0, PUSH)
        mixed.apply_due_commands()
        expected = mixed.state.wrench[:3] / flapper.body.mass
        assert mixed.specific_force() == pytest.approx(expected, rel=1e-12)
        assert np.abs(expected - mixed.state.u[:3] / flapper.body.mass).max() > 1e-3


def test_too_many_commands_on_their_way_are_an_error(flapper: Scenario) -> None:
    plant = Plant(flapper)
    for k in range(PENDING):
        plant.command(k, np.zeros(6))
    with pytest.raises(DivergenceError, match=f"more than {PENDING} delayed commands are pending.*rate or the delay"):
        plant.command(PENDING, np.zeros(6))


def test_the_queue_keeps_its_order_past_its_end(flapper: Scenario) -> None:
    """The queue is a ring: go round it more than once, three commands on their way at any time."""
    plant = Plant(flapper)
    for k in range(PENDING + 100):
        plant.command(k, np.full(6, float(k)))
        plant.t_ns = k - 2
        plant.apply_due_commands()
        if k >= 2:
            assert plant.state.tau[0] == k - 2


def test_beyond_the_pitch_limit_the_flight_ends_with_a_named_error(flapper: Scenario) -> None:
    plant = Plant(flapper)
    plant.state.motion[10] = 20.0
    with pytest.raises(DivergenceError, match=r"diverged at t = 0\.100 s: the pitch angle exceeded 1\.4 rad") as caught:
        plant.advance(100 * MS)
    assert caught.value.exit_code == 5
    assert 1.4 < plant.state.motion[4] < 1.5, "the state is the last one computed"


def test_a_state_that_is_not_finite_ends_the_flight_with_a_named_error(flapper: Scenario) -> None:
    plant = Plant(flapper)
    plant.state.motion[6] = np.inf
    with pytest.raises(DivergenceError, match=r"diverged at t = 0\.004 s: the state is no longer finite"):
        plant.advance(4 * MS)


def test_two_plants_share_nothing(flapper: Scenario) -> None:
    one, other = Plant(flapper), Plant(flapper)
    before = snapshot(other.state), other.body
    one.command(0, PUSH)
    one.advance(10 * MS)
    assert (snapshot(other.state), parameters(other.body)) == (before[0], parameters(before[1]))
    assert snapshot(one.state) != before[0]


def snapshot(state: PlantState) -> list[bytes]:
    return [part.tobytes() for part in state]


def parameters(body: BodyParameters) -> list[object]:
    return [np.asarray(part).tobytes() for part in body]
