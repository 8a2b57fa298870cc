"""Compile the kernels once, before two processes would compile them at the same time."""

from __future__ import annotations

import click

from protocol.kernel_cache import kernels_are_warm, mark_warm
from protocol.scenario import Scenario

_BOTH_ENDS = ("controller", "plant_emulator")


def compile_kernels(scenario: Scenario) -> None:
    """Compile every kernel of a run, and of its drives on a bus, into the cache. Does nothing where they are there."""
    if kernels_are_warm(*_BOTH_ENDS):
        return
    click.echo("compiling the kernels (needed once after installation or a change; up to half a minute) ...", err=True)
    import controller.process
    import plant_emulator.process
    from controller.laws.law import make_law
    from plant_emulator.drives import motor_node
    from protocol.can_frame import CanFrame
    from protocol.motors.can_stuffing import exact_bits

    plant_emulator.process.warm_up(scenario)
    controller.process.warm_up(scenario, make_law(scenario.law, scenario))
    motor_node.warm_up(scenario, "odrive")
    exact_bits(CanFrame(0))
    mark_warm(*_BOTH_ENDS)
