"""LawContract: what every control law must do. Inherit it as `class TestMyLaw(LawContract)`: its `name` and `number`."""

from __future__ import annotations

import functools
from typing import ClassVar

import msgspec
import numpy as np
import pytest

from controller.laws.law import Law, LawState, make_law
from controller.laws.registry import law_entry, load
from controller.parameters import parameters_of, value_of
from fwav_hil.simulate import simulate
from protocol.errors import UsageError
from protocol.messages import FloatArray
from protocol.scenario import Actuators, Noise, Scenario, find_scenario, load_scenario

Sample = tuple[int, FloatArray, FloatArray]
"""t_ns, q, q_dot."""

RANGE = np.array([0.5, 0.5, 0.5, 0.005, 0.005, 0.005])
WIDE = Actuators(lower=tuple(-RANGE), upper=tuple(RANGE), scale=tuple(RANGE))
"""Limits that no flight here comes near."""


def rotation_to_body(alpha: float, beta: float, gamma: float) -> FloatArray:
    """R^BI = C^B2 C^21 C^1I, written out as in the paper."""
    (sa, sb, sg), (ca, cb, cg) = np.sin((alpha, beta, gamma)), np.cos((alpha, beta, gamma))
    c_b2 = np.array([[1, 0, 0], [0, ca, sa], [0, -sa, ca]])
    c_21 = np.array([[cb, 0, -sb], [0, 1, 0], [sb, 0, cb]])
    product: FloatArray = c_b2 @ c_21 @ np.array([[cg, sg, 0], [-sg, cg, 0], [0, 0, 1]])
    return product


@functools.cache
def quiet_flight(name: str) -> tuple[Scenario, list[Sample]]:
    """`flapper` with this law and without noise, so that the flight can be flown again from its true states."""
    flapper = load_scenario(find_scenario("flapper"))
    scenario = msgspec.structs.replace(flapper, noise=Noise(), law=name, duration_s=0.6)
    run = simulate(scenario)
    assert run.divergence is None
    return scenario, list(zip(run.t_ns.tolist(), run.q, run.q_dot, strict=True))


def fly(law: Law, samples: list[Sample], state: LawState | None = None) -> FloatArray:
    """The commands (n, 6) to these samples, from the start or from `state` on."""
    state = state or law.start()
    return np.array([law.step(state, t_ns, q, q_dot) for t_ns, q, q_dot in samples])


def memory(state: LawState) -> list[bytes]:
    """All that a state remembers, without its scratch."""
    kept = {name: part for name, part in state._asdict().items() if name not in ("scratch", "packed")}
    return [part.tobytes() for part in kept.values()]


def wild_samples(period_ns: int, seed: int, count: int = 60) -> list[Sample]:
    """Leaps, turns, gaps and repetitions as no vehicle makes them."""
    rng = np.random.default_rng(seed)
    far = 10.0 ** rng.uniform(-6, 4, size=(count, 1))
    q = far * rng.normal(size=(count, 6))
    q[:, 3:] = rng.uniform(-1.0, 1.0, size=(count, 3)) * (np.pi, 1.4, np.pi)
    t_ns = np.cumsum(rng.choice([0, 0.4, 0.9, 1.0, 1.0, 1.0, 2.3, 11.0, 200.0], size=count) * period_ns).astype(int)
    return list(zip(t_ns.tolist(), q, far * rng.normal(size=(count, 6)), strict=True))


class LawContract:
    """The tests; `name` is the law's in the registry, `number` the one that logs know it by, for ever.

    Samples are those of a quiet flight of `flapper` with that very law, and with its gains' defaults where it has no others.
    """

    name: ClassVar[str]
    number: ClassVar[int]

    @pytest.fixture
    def scenario(self) -> Scenario:
        return quiet_flight(self.name)[0]

    @pytest.fixture
    def samples(self) -> list[Sample]:
        return quiet_flight(self.name)[1]

    @pytest.fixture
    def law(self, scenario: Scenario) -> Law:
        return make_law(self.name, scenario)

    @pytest.fixture
    def free(self, scenario: Scenario) -> Law:
        """The same law with limits out of reach."""
        return make_law(self.name, msgspec.structs.replace(scenario, actuators=WIDE))

    def test_the_same_samples_give_the_same_bytes(self, law: Law, scenario: Scenario, samples: list[Sample]) -> None:
        again = make_law(self.name, scenario)
        one, other = law.start(), again.start()
        assert fly(law, samples, one).tobytes() == fly(again, samples, other).tobytes()
        assert memory(one) == memory(other)

    def test_a_law_can_fly_any_number_of_states_at_once(self, law: Law, samples: list[Sample]) -> None:
        late = [(t_ns, q + 0.01, q_dot) for t_ns, q, q_dot in samples]
        alone, alone_late = fly(law, samples), fly(law, late)
        one, other = law.start(), law.start()
        for k, (sample, late_sample) in enumerate(zip(samples, late, strict=True)):
            assert law.step(one, *sample).tobytes() == alone[k].tobytes()
            assert law.step(other, *late_sample).tobytes() == alone_late[k].tobytes()

    def test_a_command_is_a_copy_and_a_sample_is_not_kept(self, law: Law, samples: list[Sample]) -> None:
        expected = fly(law, samples[:2])
        state = law.start()
        (t_ns, q, q_dot), following = samples[0], samples[1]
        q, q_dot = q.copy(), q_dot.copy()
        tau = law.step(state, t_ns, q, q_dot)
        q[:] = q_dot[:] = tau[:] = 9.0
        assert law.step(state, *following).tobytes() == expected[1].tobytes()

    @pytest.mark.parametrize("seed", range(5))
    def test_whatever_is_measured_the_command_is_finite_and_within_the_limits(self, law: Law, seed: int) -> None:
        tau = fly(law, wild_samples(law.period_ns, seed))
        hair = 1e-7 * law.output.scale  # what float32 may add; the safety envelope cuts it off
        assert np.isfinite(tau).all()
        assert np.all(tau >= law.output.lower - hair)
        assert np.all(tau <= law.output.upper + hair)

    def test_a_command_is_exactly_what_the_wire_carries(self, law: Law, samples: list[Sample]) -> None:
        for tau in (fly(law, samples), fly(law, wild_samples(law.period_ns, 1))):
            on_the_wire = (tau / law.output.scale).astype(np.float32)
            assert (on_the_wire.astype(np.float64) * law.output.scale).tobytes() == tau.tobytes()

    def test_steps_and_saturation_are_counted(self, law: Law, samples: list[Sample]) -> None:
        state = law.start()
        t_ns, q, q_dot = samples[100]  # the reference of the first ones asks for more than the limits
        law.step(state, t_ns, q, q_dot)
        assert law.counts(state) == {"steps": 1, "missed_samples": 0, "restarts": 0, "saturated": 0}
        far = q.copy()
        far[:2] += 50.0, -50.0  # two axes at their limits are one saturated step
        law.step(state, t_ns + law.period_ns, far, q_dot)
        assert law.counts(state) == {"steps": 2, "missed_samples": 0, "restarts": 0, "saturated": 1}

    def test_a_flight_within_the_limits_counts_no_saturation(self, free: Law, samples: list[Sample]) -> None:
        state = free.start()
        fly(free, samples, state)
        counts = free.counts(state)
        assert counts == {"steps": len(samples), "missed_samples": 0, "restarts": 0, "saturated": 0}

    @pytest.mark.parametrize("periods", [0.0, 0.3, 0.499, -1.0, -7.0])
    def test_a_sample_that_comes_too_early_or_again_changes_nothing(
        self, law: Law, samples: list[Sample], periods: float
    ) -> None:
        state = law.start()
        fly(law, samples[:20], state)
        before, tau = memory(state), state.tau.copy()
        t_ns, q, q_dot = samples[19]
        again = law.step(state, t_ns + round(periods * law.period_ns), q + 0.1, q_dot + 5.0)
        assert again.tobytes() == tau.tobytes(), "the command stands"
        assert memory(state) == before

    def test_a_whole_turn_of_an_angle_changes_nothing(self, free: Law, samples: list[Sample]) -> None:
        turns = 2.0 * np.pi * np.random.default_rng(2).integers(-2, 3, size=(len(samples), 6))
        turns[:, :3] = 0.0
        turned = [(t_ns, q + turn, q_dot) for (t_ns, q, q_dot), turn in zip(samples, turns, strict=True)]
        difference = fly(free, turned) - fly(free, samples)
        # Rounding of an angle is worth a few float32 steps of the command at most.
        assert np.all(np.abs(difference) <= 1e-6 * free.output.scale)

    def test_the_body_force_turned_back_is_the_inertial_force(
        self, scenario: Scenario, free: Law, samples: list[Sample]
    ) -> None:
        straight = make_law(
            self.name,
            msgspec.structs.replace(
                scenario, actuators=WIDE, control=msgspec.structs.replace(scenario.control, rotate_force=False)
            ),
        )
        state = free.start()
        for sample in samples[:50]:
            # The straight law takes its step from where the other one stands.
            beside = straight.start()
            for mine, other in zip(beside[:-1], state[:-1], strict=True):
                mine[...] = other
            inertial = straight.step(beside, *sample)
            body = free.step(state, *sample)
            back = rotation_to_body(*sample[1][3:]).T @ body[:3]
            assert back == pytest.approx(inertial[:3], rel=0.0, abs=2e-7 * np.abs(inertial[:3]).max())
            assert body[3:].tobytes() == inertial[3:].tobytes(), "torques are body torques already"
            assert state.applied == pytest.approx(np.concatenate((back, body[3:])), rel=1e-12, abs=1e-15)

    def test_velocities_are_ignored_unless_they_are_asked_for(self, law: Law, samples: list[Sample]) -> None:
        rng = np.random.default_rng(3)
        other = [(t_ns, q, q_dot + 0.1 * rng.normal(size=6)) for t_ns, q, q_dot in samples]
        blind = not law_entry(self.name).needs_velocity
        assert (fly(law, other).tobytes() == fly(law, samples).tobytes()) == blind

    def test_without_velocities_a_law_flies_blind_or_says_why_not(self, law: Law, samples: list[Sample]) -> None:
        t_ns, q, q_dot = samples[0]
        if not law.needs_velocity:
            assert law.step(law.start(), t_ns, q).tobytes() == law.step(law.start(), t_ns, q, q_dot).tobytes()
            return
        with pytest.raises(UsageError, match=f"'{self.name}' needs velocities, which the link does not carry"):
            law.step(law.start(), t_ns, q)

    def test_a_law_knows_its_name_and_its_period(self, law: Law, scenario: Scenario) -> None:
        assert law.name == self.name
        assert law.period_ns == scenario.period_ns
        assert law.needs_velocity == law_entry(self.name).needs_velocity

    def test_a_law_keeps_its_number(self) -> None:
        assert law_entry(self.name).number == self.number

    def test_every_gain_is_a_parameter_by_a_name_of_its_own(self, scenario: Scenario) -> None:
        parameters = parameters_of(scenario)
        said = {(parameter.table, parameter.field) for parameter in parameters}
        for table, place in law_entry(self.name).gains.items():
            assert {(f"gains.{table}", gain) for gain in load(place).__struct_fields__} <= said
        names = [parameter.name for parameter in parameters]
        assert len(set(names)) == len(names)
        assert all(name.isascii() and name.isupper() and len(name) <= 16 for name in names)
        assert np.isfinite([value_of(scenario, parameter) for parameter in parameters]).all()
