"""The registry of the control laws: one line each. A law's own file is loaded when the law is made."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from protocol.errors import ScenarioError, UsageError
from protocol.scenario import Scenario

if TYPE_CHECKING:
    from controller.laws.state_space import Realisation


class LawEntry(NamedTuple):
    """What is known of a law without loading it.

    number          what logs know it by (LAW_INDEX): it never changes, and goes to no other law
    place           module:function that builds it
    needs_velocity  state feedback: it flies in `simulate` only
    """

    number: int
    place: str
    needs_velocity: bool
    summary: str


LAWS: Mapping[str, LawEntry] = MappingProxyType(
    {
        "ude": LawEntry(0, "controller.laws.ude:ude", False, "the paper's output feedback with the estimator (21)"),
        "ude_state": LawEntry(
            1, "controller.laws.ude:ude_state", True, "the paper's state feedback (20); in `simulate` only"
        ),
        "pd": LawEntry(2, "controller.laws.pd:pd", False, "PD"),
        "dob": LawEntry(3, "controller.laws.dob:dob", False, "PD and a disturbance observer"),
        "dob_ff": LawEntry(
            4, "controller.laws.dob:dob_ff", False, "the same with feed-forward of the reference's acceleration"
        ),
        "uncompensated": LawEntry(
            5, "controller.laws.ude:uncompensated", False, "the UDE law without its estimate (G_f = 0)"
        ),
    }
)
"""A new law takes the next number; one that is taken out leaves its own unused."""


def law_entry(name: str) -> LawEntry:
    """What is known of the law called `name`. Raises UsageError for a name there is not."""
    if name not in LAWS:
        raise UsageError(f"there is no law '{name}': choose one of {', '.join(LAWS)}")
    return LAWS[name]


def refuse_on_a_link(scenario: Scenario) -> None:
    """Raise UsageError or ScenarioError where the scenario's law cannot fly on a link, which carries no velocities.

    The same errors come from making and stepping the law; this asks for none of what that needs.
    """
    if law_entry(scenario.law).needs_velocity:
        raise UsageError(velocity_sentence(scenario.law))
    check_order(scenario, 2)


def check_order(scenario: Scenario, least: int) -> None:
    """Raise ScenarioError where the filter G_f cannot be differentiated `least` times."""
    if scenario.control.order < least:
        raise ScenarioError(
            f"scenario {scenario.name}, control.order: output feedback needs a filter of order {least} or more, "
            f"this one has {scenario.control.order}: set control.order = {least}"
        )


def velocity_sentence(name: str) -> str:
    """Why a state-feedback law cannot run on a link."""
    return (
        f"the law '{name}' needs velocities, which the link does not carry: "
        "use it in `fwav-hil simulate`, or choose an output-feedback law such as 'ude'"
    )


def make_realisation(name: str, scenario: Scenario) -> Realisation:
    """The matrices of the law called `name`, without its kernels. Raises as `make_law`."""
    module, _, function = law_entry(name).place.partition(":")
    realisation: Realisation = getattr(importlib.import_module(module), function)(scenario)
    return realisation
