"""The registry of the laws; each of them keeps the contract."""

from __future__ import annotations

import pytest

from controller.laws import LAWS, make_law
from protocol.errors import UsageError
from protocol.scenario import find_scenario, load_scenario
from tests.contracts.law_contract import LawContract


class TestUde(LawContract):
    name = "ude"


class TestUdeState(LawContract):
    name = "ude_state"


class TestPd(LawContract):
    name = "pd"


class TestDob(LawContract):
    name = "dob"


class TestDobFeedForward(LawContract):
    name = "dob_ff"


class TestUncompensated(LawContract):
    name = "uncompensated"


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
