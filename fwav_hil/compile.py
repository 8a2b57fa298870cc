"""Compile the kernels once, before two processes would do it side by side."""

from __future__ import annotations

import click

from protocol.kernel_cache import kernels_are_warm, mark_warm
from protocol.scenario import Scenario


def compile_kernels(scenario: Scenario) -> None:
    """Have every kernel of a run in the cache. Does nothing where it is; else it takes some ten seconds, once."""
    if kernels_are_warm():
        return
    click.echo("compiling the kernels (once after each installation, some ten seconds) ...", err=True)
    import controller.process
    import plant_emulator.process
    from controller.laws.law import make_law

    plant_emulator.process.warm_up(scenario)
    controller.process.warm_up(scenario, make_law(scenario.law, scenario))
    mark_warm()
