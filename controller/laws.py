"""The registry of the control laws: one line each."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from controller.dob import dob, dob_ff
from controller.law import Law, Realisation
from controller.pd import pd
from controller.ude import ude, ude_state, uncompensated
from protocol.errors import UsageError
from protocol.scenario import Scenario


class LawEntry(NamedTuple):
    """How to build a law, whether it needs velocities, and what it is in a few words."""

    build: Callable[[Scenario], Realisation]
    needs_velocity: bool
    summary: str


LAWS = {
    "ude": LawEntry(ude, False, "the paper's output feedback with the estimator (21)"),
    "ude_state": LawEntry(ude_state, True, "the paper's state feedback (20); in `simulate` only"),
    "pd": LawEntry(pd, False, "PD"),
    "dob": LawEntry(dob, False, "PD and a disturbance observer"),
    "dob_ff": LawEntry(dob_ff, False, "the same with feed-forward of the reference's acceleration"),
    "uncompensated": LawEntry(uncompensated, False, "the UDE law without its estimate (G_f = 0)"),
}


def make_law(name: str, scenario: Scenario) -> Law:
    """The law called `name` for the scenario's gains and rate. Raises UsageError for a name there is not."""
    if name not in LAWS:
        raise UsageError(f"there is no law '{name}': choose one of {', '.join(LAWS)}")
    entry = LAWS[name]
    return Law(name, scenario, entry.build(scenario), needs_velocity=entry.needs_velocity)
