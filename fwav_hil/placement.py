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

    emulator, controller: the core of each, if it matters. spin_s: how long each polls; None: as the process chooses.
    """

    text: str
    emulator: int | None = None
    controller: int | None = None
    spin_s: float | None = None


SPIN_S = 500e-6
"""How long a lockstep process polls before it sleeps: several ticks' worth; longer waits are stalls."""


def choose_placement(clock: str, *, realtime: bool = False, spin_s: float | None = None) -> Placement:
    """The placement for a clock mode on this machine; spin_s: how long to poll, where the user said so."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if (clock == "realtime" and not realtime) or not cores:
        return Placement("placed by the scheduler, sleeping while they wait", spin_s=spin_s)
    if len(cores) == 1:
        return Placement("both processes on the one core there is, sleeping while they wait", spin_s=spin_s)
    polling = "the end of each wait"
    if clock == "lockstep":
        spin_s = SPIN_S if spin_s is None else spin_s
        polling = f"up to {1e6 * spin_s:.0f} us before sleeping"
    return Placement(
        f"a core each (emulator {cores[-1]}, controller {cores[-2]}), polling {polling}", cores[-1], cores[-2], spin_s
    )
