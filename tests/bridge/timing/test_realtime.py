"""What is asked of the system: each thing by itself, what is refused said with its remedy, all given back."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import resource
import sys
from pathlib import Path
from typing import Any

import pytest

from bridge.timing import realtime
from bridge.timing.realtime import (
    OWN_CORE,
    SHELL_REMEDY,
    Setting,
    check_real_time,
    has_own_core,
    maybe_real_time,
    own_core,
    real_time,
    report_settings,
)
from protocol.errors import UsageError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="NOT TESTED: the settings are Linux's")


def state() -> tuple[Any, ...]:
    return (
        os.sched_getscheduler(0),
        os.sched_getparam(0).sched_priority,
        os.sched_getaffinity(0),
        ctypes.CDLL(None).prctl(30, 0, 0, 0, 0),
        gc.isenabled(),
        gc.get_freeze_count(),
    )


def by_name(settings: tuple[Setting, ...]) -> dict[str, Setting]:
    return {setting.name.split(",")[0]: setting for setting in settings}


def test_whatever_is_granted_is_given_back() -> None:
    before = state()
    files = set(Path("/proc/self/fd").iterdir())
    core = max(os.sched_getaffinity(0))
    with real_time(core) as settings:
        inside = state()
        given = by_name(settings)
        assert (inside[0] & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO) == given["SCHED_FIFO"].granted
        assert inside[2] == {core}
        assert given[OWN_CORE].granted
        assert not inside[4]
        assert given["garbage collector off"].granted
    assert state()[:5] == before[:5]
    assert gc.get_freeze_count() == 0
    # Fewer where the collection inside closed what an earlier test had left behind.
    assert set(Path("/proc/self/fd").iterdir()) <= files


def test_an_error_inside_gives_everything_back_too() -> None:
    before = state()
    with pytest.raises(RuntimeError), real_time(None):
        raise RuntimeError
    assert state()[:5] == before[:5]


def test_an_unprivileged_process_is_let_go_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a limit rtprio but no CAP_SYS_NICE the kernel grants SCHED_FIFO, and refuses to take back the reset on fork."""
    policies = [os.SCHED_OTHER]

    def set_scheduler(_pid: int, policy: int, _parameters: os.sched_param) -> None:
        if policies[-1] & ~policy & os.SCHED_RESET_ON_FORK:
            raise PermissionError(errno.EPERM, "Operation not permitted")
        policies.append(policy)

    monkeypatch.setattr(os, "sched_getscheduler", lambda _pid: policies[-1])
    monkeypatch.setattr(os, "sched_setscheduler", set_scheduler)
    for _ in range(2):
        with real_time(None) as settings:
            assert by_name(settings)["SCHED_FIFO"].granted
            assert policies[-1] & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        assert policies[-1] & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER


def test_a_system_that_refuses_everything_is_quoted_with_remedies_and_nothing_breaks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    class Library:
        def __getattr__(self, name: str) -> Any:
            return lambda *_: -1

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr(ctypes, "CDLL", lambda *_args, **_options: Library())
    monkeypatch.setattr(ctypes, "get_errno", lambda: 12)
    monkeypatch.setattr(realtime, "DMA_LATENCY", tmp_path / "none")
    with real_time(0) as settings:
        given = by_name(settings)
    assert [name for name, setting in given.items() if setting.granted] == ["garbage collector off"]
    assert "Operation not permitted" in given["SCHED_FIFO"].said
    assert given["SCHED_FIFO"].remedy == given["memory locked"].remedy == SHELL_REMEDY
    assert "Cannot allocate memory" in given["memory locked"].said
    assert "--device" in given["no deep idle states"].remedy
    assert not has_own_core(settings)


def test_a_file_that_is_not_for_us_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(realtime, "DMA_LATENCY", tmp_path)  # a folder cannot be opened for writing, even by root
    with real_time(None) as settings:
        idle = by_name(settings)["no deep idle states"]
    assert not idle.granted
    assert str(tmp_path) in idle.said


def test_the_latency_request_stands_while_the_block_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "cpu_dma_latency"
    file.write_bytes(b"")
    monkeypatch.setattr(realtime, "DMA_LATENCY", file)
    with real_time(None) as settings:
        assert by_name(settings)["no deep idle states"].granted
        assert file.read_bytes() == bytes(4)
        assert any(link.exists() and link.samefile(file) for link in Path("/proc/self/fd").iterdir())
    assert not any(link.exists() and link.samefile(file) for link in Path("/proc/self/fd").iterdir())


@pytest.mark.parametrize(("limit", "root", "flags"), [(-1, False, 3), (1 << 20, False, 1), (1 << 20, True, 3)])
def test_under_a_limit_only_what_is_there_is_locked(
    monkeypatch: pytest.MonkeyPatch, limit: int, root: bool, flags: int
) -> None:
    asked: list[int] = []

    class Library:
        def mlockall(self, how: int) -> int:
            asked.append(how)
            return 0

        def munlockall(self) -> int:
            return 0

        def prctl(self, *_: Any) -> int:
            return 0

    monkeypatch.setattr(resource, "getrlimit", lambda _which: (limit, limit))
    monkeypatch.setattr(os, "geteuid", lambda: 0 if root else 1000)
    monkeypatch.setattr(ctypes, "CDLL", lambda *_args, **_options: Library())
    with real_time(None):
        assert asked == [flags]


def test_each_end_of_a_pair_gets_a_core_where_there_are_two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {0, 3, 5})
    assert [own_core(place) for place in range(4)] == [5, 3, 0, None]
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {3})
    assert own_core(0) is None


def test_nothing_is_asked_for_unless_wanted() -> None:
    events: list[dict[str, Any]] = []
    with maybe_real_time(None, wanted=False) as settings:
        assert settings == ()
        report_settings(events.append, settings)
    assert events == []
    report_settings(events.append, (Setting(OWN_CORE, True, "core 1"),))
    assert [event["event"] for event in events] == ["realtime"]


def test_lockstep_keeps_no_wall_time() -> None:
    check_real_time("realtime", realtime=True, trigger="clock")
    check_real_time("lockstep", realtime=False)
    with pytest.raises(UsageError, match=r"--realtime .* add --clock realtime"):
        check_real_time("lockstep", realtime=True)
    with pytest.raises(UsageError, match=r"--trigger clock .* add --clock realtime"):
        check_real_time("lockstep", realtime=False, trigger="clock")
