"""Core affinity of each process of a run, and how it waits."""

from __future__ import annotations

import os

import msgspec


class Placement(msgspec.Struct, frozen=True):
    """The core affinity of the two processes of a run, and how they wait for each other.

    In lockstep one process waits while the other works. Sleeping on a core of its own costs the wake-up of that core at
    each hand-over; sharing a core costs a context switch and cold caches; polling on a core of its own costs
    neither, but uses that core. So with two cores each process has its own and polls for a short time; otherwise both share
    one. In real time each process sleeps, and the scheduler places it; with `--realtime` each has a core of its own, if
    there are two, and polls only at the end of a wait.

    emulator, controller: the core of each, None: any. spin_s: how long each polls; None: chosen by the process.
    """

    text: str
    emulator: int | None = None
    controller: int | None = None
    spin_s: float | None = None


SPIN_S = 500e-6
"""How long a lockstep process polls before it sleeps: several ticks; longer waits are stalls."""


def choose_placement(clock: str, *, realtime: bool = False, spin_s: float | None = None) -> Placement:
    """The placement for a clock mode on this machine; spin_s: how long to poll, where the user has set it."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if (clock == "realtime" and not realtime) or not cores:
        return Placement("placed by the scheduler, sleeping while they wait", spin_s=spin_s)
    if len(cores) == 1:
        return Placement("both processes on the only core, sleeping while they wait", spin_s=spin_s)
    polling = "the end of each wait"
    if clock == "lockstep":
        spin_s = SPIN_S if spin_s is None else spin_s
        polling = f"up to {1e6 * spin_s:.0f} us before sleeping"
    return Placement(
        f"a core each (emulator {cores[-1]}, controller {cores[-2]}), polling {polling}", cores[-1], cores[-2], spin_s
    )
