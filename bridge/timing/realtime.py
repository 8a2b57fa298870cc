"""Real-time settings that a process requests from the system, and the result of each.

    scheduler    SCHED_FIFO: no ordinary process preempts this one             needs rtprio or CAP_SYS_NICE
    memory       mlockall: none of its pages is ever read from disk            needs memlock or CAP_IPC_LOCK
    core         core affinity: a core of its own, where there are two
    idle states  /dev/cpu_dma_latency held open at 0: no deep idle states      needs write access to that file
    timer slack  1 ns: a sleep is not extended to share a wake-up (prctl)
    collector    garbage collection frozen and off

Each is requested separately; a refusal causes more jitter, but never ends the run. Sources: sched(7), mlockall(2),
prctl(2), and the kernel's Documentation/power/pm_qos_interface.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec

from bridge.reporting import Report
from protocol.errors import UsageError

PRIORITY = 80
"""SCHED_FIFO priority, 1 to 99: above the kernel's threaded interrupts (50), below its watchdogs (99)."""

OWN_CORE = "a core of its own"
DMA_LATENCY = Path("/dev/cpu_dma_latency")
SHELL_REMEDY = "sudo prlimit --pid $$ --rtprio=99 --memlock=unlimited"
"""Sets both limits for programs started from this shell; docs/realtime.md explains the permanent setting."""

_LOCK_CURRENT, _LOCK_FUTURE = 1, 2
_SET_TIMER_SLACK, _GET_TIMER_SLACK = 29, 30


class Setting(msgspec.Struct, frozen=True):
    """One requested setting: whether it was granted, what that means or why not, and the remedy."""

    name: str
    granted: bool
    said: str
    remedy: str = ""


Settings = tuple[Setting, ...]


def own_core(place: int) -> int | None:
    """The core for process number `place` of a pair, counted from the last core, since the first serves most interrupts.

    None where this process may use only one core, or the system does not provide the affinity.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    return cores[-1 - place] if place < len(cores) and len(cores) > 1 else None


def check_real_time(clock: str, *, realtime: bool, trigger: str = "sample") -> None:
    """Raise UsageError where real-time settings, or the controller's own clock, are requested in lockstep."""
    if clock != "realtime" and trigger == "clock":
        raise UsageError("--trigger clock steps on wall time, which lockstep does not follow: add --clock realtime")
    if clock != "realtime" and realtime:
        raise UsageError("--realtime helps to keep wall time, which lockstep does not follow: add --clock realtime")


@contextlib.contextmanager
def real_time(core: int | None) -> Iterator[Settings]:
    """Request all settings above, with affinity to `core`, while the block runs; yields the result of each.

    All are restored at the end. Affects the calling thread (scheduler, core, slack) and the process (the rest).
    """
    with contextlib.ExitStack() as undo:
        # Lock memory first: it loads the whole process into memory, which should not run at real-time priority.
        yield (
            _lock_memory(undo),
            _hold_idle_states(undo),
            _take_core(undo, core),
            _take_priority(undo),
            _cut_timer_slack(undo),
            _stop_collector(undo),
        )


def has_own_core(settings: Settings) -> bool:
    """Whether the process has a core of its own, where polling takes no time from other processes."""
    return any(setting.granted for setting in settings if setting.name == OWN_CORE)


def report_settings(report: Report, settings: Settings) -> None:
    """Report the result of each setting, if any was requested."""
    if settings:
        report({"event": "realtime", "settings": settings})


@contextlib.contextmanager
def maybe_real_time(core: int | None, *, wanted: bool) -> Iterator[Settings]:
    """`real_time` where `wanted`; else no setting is requested, and an empty tuple is yielded."""
    if not wanted:
        yield ()
        return
    with real_time(core) as settings:
        yield settings


def _take_priority(undo: contextlib.ExitStack) -> Setting:
    name = f"SCHED_FIFO, priority {PRIORITY}"
    if not hasattr(os, "sched_setscheduler"):
        return Setting(name, False, f"{sys.platform} has no such call")
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        # Child processes (such as a recorder) start as ordinary processes.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except OSError as error:
        limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
        return Setting(name, False, f"{error.strerror}: the limit rtprio is {limit}", SHELL_REMEDY)
    undo.callback(_give_back_priority, *before)
    return Setting(name, True, "ahead of every ordinary process")


def _give_back_priority(policy: int, parameters: os.sched_param) -> None:
    """Restore the scheduler. Without CAP_SYS_NICE the reset-on-fork flag cannot be cleared, and stays."""
    try:
        os.sched_setscheduler(0, policy, parameters)
    except PermissionError:
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameters)


def _lock_memory(undo: contextlib.ExitStack) -> Setting:
    name = "memory locked"
    try:
        library = ctypes.CDLL(None, use_errno=True)
        lock, unlock = library.mlockall, library.munlockall
    except (OSError, AttributeError):
        return Setting(name, False, f"{sys.platform} has no such call")
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    # With a limit the lock could succeed now and a later allocation fail during the run: then lock present memory only.
    wanted = _LOCK_CURRENT | _LOCK_FUTURE if limit == resource.RLIM_INFINITY or _is_root() else _LOCK_CURRENT
    if lock(wanted) != 0:
        reason = os.strerror(ctypes.get_errno())
        return Setting(name, False, f"{reason}: the limit memlock is {_bytes(limit)}", SHELL_REMEDY)
    undo.callback(unlock)
    if wanted & _LOCK_FUTURE:
        return Setting(name, True, "no page of the process is read from disk")
    return Setting(name, True, f"present memory; later allocations are not locked (memlock is {_bytes(limit)})")


def _take_core(undo: contextlib.ExitStack, core: int | None) -> Setting:
    name = OWN_CORE
    if not hasattr(os, "sched_setaffinity"):
        return Setting(name, False, f"{sys.platform} has no such call")
    before = os.sched_getaffinity(0)
    if core is None:
        return Setting(name, False, f"this process may use {len(before)} core", "give the container or machine two")
    try:
        os.sched_setaffinity(0, {core})
    except (OSError, ValueError, OverflowError) as error:
        return Setting(name, False, f"core {core}: {error}", "choose one that /proc/self/status lists as allowed")
    undo.callback(os.sched_setaffinity, 0, before)
    return Setting(name, True, f"core {core}; other processes may still use it (isolcpus prevents that)")


def _hold_idle_states(undo: contextlib.ExitStack) -> Setting:
    name = "no deep idle states"
    try:
        file = os.open(DMA_LATENCY, os.O_WRONLY)
    except FileNotFoundError:
        return Setting(name, False, f"there is no {DMA_LATENCY}", f"in a container: --device {DMA_LATENCY}")
    except OSError as error:
        return Setting(name, False, f"{DMA_LATENCY}: {error.strerror}", f"sudo chmod o+w {DMA_LATENCY}")
    try:
        os.write(file, bytes(4))  # an int32 of 0 us, valid while the file is open
    except OSError as error:
        os.close(file)
        return Setting(name, False, f"{DMA_LATENCY}: {error.strerror}", f"sudo chmod o+w {DMA_LATENCY}")
    undo.callback(os.close, file)
    return Setting(name, True, f"{DMA_LATENCY} held at 0")


def _cut_timer_slack(undo: contextlib.ExitStack) -> Setting:
    name = "timer slack 1 ns"
    if sys.platform != "linux":
        return Setting(name, False, f"{sys.platform} has no such call")
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    before = prctl(_GET_TIMER_SLACK, 0, 0, 0, 0)
    if prctl(_SET_TIMER_SLACK, ctypes.c_ulong(1), 0, 0, 0) != 0:
        return Setting(name, False, os.strerror(ctypes.get_errno()))
    if before > 0:  # 0 of a real-time thread would mean "the default"
        undo.callback(prctl, _SET_TIMER_SLACK, ctypes.c_ulong(before), 0, 0, 0)
    return Setting(name, True, f"instead of {before} ns" if before > 0 else "sleeps are not extended")


def _stop_collector(undo: contextlib.ExitStack) -> Setting:
    was_on = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    undo.callback(gc.unfreeze)
    if was_on:
        undo.callback(gc.enable)
    return Setting("garbage collector off", True, "existing objects are frozen, the loop makes no cycles")


def _is_root() -> bool:
    return hasattr(os, "geteuid") and os.geteuid() == 0


def _bytes(limit: int) -> str:
    return "unlimited" if limit == resource.RLIM_INFINITY else f"{limit // 1024} KiB"
