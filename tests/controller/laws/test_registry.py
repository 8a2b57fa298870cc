"""The registry of the laws; each of them keeps the contract."""

from __future__ import annotations

import subprocess
import sys

import msgspec
import pytest

from controller.laws.law import make_law
from controller.laws.registry import LAWS, refuse_on_a_link
from protocol.errors import ScenarioError, UsageError
from protocol.scenario import find_scenario, load_scenario, replace_gains
from tests.contracts.law_contract import LawContract


class TestUde(LawContract):
    name, number = "ude", 0


class TestUdeState(LawContract):
    name, number = "ude_state", 1


class TestPd(LawContract):
    name, number = "pd", 2


class TestDob(LawContract):
    name, number = "dob", 3


class TestDobFeedForward(LawContract):
    name, number = "dob_ff", 4


class TestUncompensated(LawContract):
    name, number = "uncompensated", 5


def test_every_law_has_its_contract_tested() -> None:
    tested = [
        test.name
        for test in globals().values()
        if isinstance(test, type) and issubclass(test, LawContract) and test is not LawContract
    ]
    assert sorted(tested) == sorted(LAWS)


def test_a_law_there_is_not_is_named_with_those_there_are() -> None:
    scenario = load_scenario(find_scenario("flapper"))
    with pytest.raises(UsageError, match="no law 'pid'") as caught:
        make_law("pid", scenario)
    for name in LAWS:
        assert name in str(caught.value)


def test_every_law_says_what_it_is() -> None:
    summaries = [entry.summary for entry in LAWS.values()]
    assert all(summaries)
    assert len(set(summaries)) == len(summaries)


def test_no_two_laws_have_one_number() -> None:
    assert len({entry.number for entry in LAWS.values()}) == len(LAWS)


@pytest.mark.parametrize("name", LAWS)
def test_what_cannot_fly_on_a_link_is_refused_without_making_it(name: str) -> None:
    scenario = msgspec.structs.replace(load_scenario(find_scenario("flapper")), law=name)
    if LAWS[name].needs_velocity:
        with pytest.raises(UsageError, match=f"'{name}' needs velocities, which the link does not carry"):
            refuse_on_a_link(scenario)
        return
    refuse_on_a_link(scenario)
    for table in LAWS[name].gains:
        wrong = replace_gains(scenario, table, xyzzy=1.0)
        with pytest.raises(ScenarioError, match=f"unknown key 'gains.{table}.xyzzy'") as early:
            refuse_on_a_link(wrong)
        with pytest.raises(ScenarioError) as late:
            make_law(name, wrong)
        assert str(early.value) == str(late.value)


def test_what_is_refused_before_a_start_needs_neither_numpy_nor_a_compiler() -> None:
    program = """
import sys
from controller.laws.registry import refuse_on_a_link
from protocol.scenario import find_scenario, load_scenario
assert "controller.laws.ude" not in sys.modules, "the registry itself loads no law"
refuse_on_a_link(load_scenario(find_scenario("flapper")))
print("controller.laws.ude" in sys.modules, "numba" in sys.modules, "numpy" in sys.modules)
"""
    told = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert told == "True False False\n"
