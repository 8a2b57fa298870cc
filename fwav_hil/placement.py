"""Which core each process of a run has, and how it waits."""

from __future__ import annotations

import os

import msgspec


class Placement(msgspec.Struct, frozen=True):
    """Where the two processes of a run sit, and how they wait for each other.

    In lockstep one process waits while the other works. Asleep on a core of its own it costs the wake-up of that core at
    each hand-over; on a shared core it costs a switch of contexts, and cold caches; polling on a core of its own it costs
    neither, only that core. So: two cores and a short spin where there are two, one core where not. In real time each
    process sleeps, and the scheduler places it; with `--realtime` each has a core of its own, if there are two, and polls
    the end of a wait only.
    """

    text: str
    emulator: tuple[str, ...] = ()
    controller: tuple[str, ...] = ()


SPIN_US = "500"
"""How long a lockstep process polls before it sleeps: several ticks' worth; longer waits are stalls."""


def choose_placement(clock: str, *, realtime: bool = False, spin_us: int | None = None) -> Placement:
    """The placement for a clock mode on this machine."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    wanted = () if spin_us is None else ("--spin-us", str(spin_us))
    if realtime:
        told = ("--realtime", *wanted)
        if len(cores) < 2:
            return Placement("both processes on the one core there is, sleeping while they wait", told, told)
        return Placement(
            f"a core each (emulator {cores[-1]}, controller {cores[-2]}), polling the end of each wait",
            ("--core", str(cores[-1]), *told),
            ("--core", str(cores[-2]), *told),
        )
    if clock == "lockstep" and len(cores) > 1:
        spin = wanted or ("--spin-us", SPIN_US)
        return Placement(
            f"a core each (emulator {cores[-1]}, controller {cores[-2]}), polling up to {spin[1]} us before sleeping",
            ("--core", str(cores[-1]), *spin),
            ("--core", str(cores[-2]), *spin),
        )
    if clock == "lockstep" and cores:
        return Placement("both processes on the one core there is, sleeping while they wait", wanted, wanted)
    return Placement("placed by the scheduler, sleeping while they wait", wanted, wanted)
