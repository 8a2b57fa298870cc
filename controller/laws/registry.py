"""The registry of the control laws: one row each. A law's file is loaded when the law is built or its gains are read."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from controller.laws.state_space import Realisation
from protocol.errors import ScenarioError, UsageError
from protocol.scenario import Scenario, Table, unknown_key


class LawEntry(NamedTuple):
    """What is known of a law without loading it; a place is module:name.

    number          identifies the law in logs (LAW_INDEX): it never changes and is never reused
    place           the function that computes its matrices from the scenario and its gains
    gains           its tables in the scenario's [gains], name -> struct, in the order of the function's arguments
    needs_velocity  state feedback: available in `simulate` only
    """

    number: int
    place: str
    gains: Mapping[str, str]
    needs_velocity: bool
    summary: str


_UDE = {"ude": "controller.laws.ude:UdeGains", "filters": "controller.laws.filters:Filters"}
_PD = {"pd": "controller.laws.pd:PdGains", "filters": "controller.laws.filters:Filters"}
_STATE = {**_UDE, "filters": "controller.laws.filters:StateFeedbackFilters"}

LAWS: Mapping[str, LawEntry] = MappingProxyType(
    {
        "ude": LawEntry(0, "controller.laws.ude:ude", _UDE, False, "the paper's output feedback with the estimator (21)"),
        "ude_state": LawEntry(1, "controller.laws.ude:ude_state", _STATE, True, "the paper's state feedback (20)"),
        "pd": LawEntry(2, "controller.laws.pd:pd", _PD, False, "PD"),
        "dob": LawEntry(3, "controller.laws.dob:dob", _PD, False, "PD and a disturbance observer"),
        "dob_ff": LawEntry(4, "controller.laws.dob:dob_ff", _PD, False, "`dob` with feed-forward of the reference's q_d''"),
        "uncompensated": LawEntry(5, "controller.laws.ude:uncompensated", _UDE, False, "`ude` without its estimate: G_f = 0"),
    }
)  # fmt: skip
"""A new law gets the next number; the number of a removed law is not reused."""


def law_entry(name: str) -> LawEntry:
    """The registry's row of the law called `name`. Raises UsageError for an unknown name."""
    if name not in LAWS:
        raise UsageError(f"there is no law '{name}': choose one of {', '.join(LAWS)}")
    return LAWS[name]


def gains_tables() -> dict[str, str]:
    """Every table of gains that a law has, in the order of the registry: name -> place of its struct."""
    return {name: place for entry in LAWS.values() for name, place in entry.gains.items()}


def declared_gains(scenario: Scenario) -> dict[str, type[Table]]:
    """The structs of the gains tables that the scenario has or its law needs. Raises UsageError for an unknown law."""
    own = law_entry(scenario.law).gains
    places = {**gains_tables(), **own}  # two laws may have different structs for a table that they share
    return {name: load(place) for name, place in places.items() if name in own or name in scenario.gains}


def check_law(scenario: Scenario, source: object = None) -> None:
    """Raise UsageError for an unknown law, ScenarioError where a table of gains is not as its laws declare it.

    source: names the file in the error message. Loads the files of these laws only.
    """
    declared = declared_gains(scenario)
    for name in scenario.gains:
        if name not in declared:
            named = source or f"scenario {scenario.name}"
            raise ScenarioError(unknown_key(named, "gains", name, list(gains_tables())))
    for name, struct in declared.items():
        scenario.read_gains(name, struct, source)


def refuse_on_a_link(scenario: Scenario, source: object = None) -> None:
    """`check_law`; also raises UsageError where the law needs velocities, which a link does not carry."""
    check_law(scenario, source)
    if law_entry(scenario.law).needs_velocity:
        raise UsageError(velocity_sentence(scenario.law))


def velocity_sentence(name: str) -> str:
    """Why a state-feedback law cannot run on a link."""
    return (
        f"the law '{name}' needs velocities, which the link does not carry: "
        "use it in `fwav-hil simulate`, or choose an output-feedback law such as 'ude'"
    )


def make_realisation(name: str, scenario: Scenario) -> Realisation:
    """The matrices of the law called `name`, without its kernels. Raises as `make_law`."""
    entry = law_entry(name)
    gains = [scenario.read_gains(table, load(place)) for table, place in entry.gains.items()]
    realisation: Realisation = load(entry.place)(scenario, *gains)
    return realisation


def load(place: str) -> Any:
    """The object at a place, module:name."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)
