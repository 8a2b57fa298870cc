"""What the machine is, read from trees of files that tests make up; any of them may be missing."""

from __future__ import annotations

import os
import platform
import resource
from pathlib import Path

import pytest

from bridge.links.udp import WANTED_BUFFER_BYTES
from bridge.timing.machine import Finding, Machine
from bridge.timing.realtime import SHELL_REMEDY


def tree(root: Path, **files: str) -> Machine:
    """A machine of files; "__" stands for "/" in their names."""
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
    return Machine(root)


def test_without_any_file_everything_is_still_answered(tmp_path: Path) -> None:
    findings = Machine(tmp_path).findings()
    assert len({finding.name for finding in findings}) == len(findings) >= 14
    for finding in findings:
        assert finding.found
        if finding.good is False:
            assert finding.remedy


def test_this_machine_is_read_without_an_error() -> None:
    assert all(isinstance(finding, Finding) for finding in Machine().findings())


@pytest.mark.parametrize(
    ("version", "files", "good", "words"),
    [
        ("#1 SMP PREEMPT_RT", {}, True, "PREEMPT_RT"),
        ("#1 SMP", {"sys__kernel__realtime": "1"}, True, "PREEMPT_RT"),
        ("#1 SMP PREEMPT_DYNAMIC", {}, None, "model unknown"),
        ("#1 SMP PREEMPT_DYNAMIC", {"sys__kernel__debug__sched__preempt": "none voluntary (full)"}, True, "full"),
        ("#1 SMP PREEMPT_DYNAMIC", {"sys__kernel__debug__sched__preempt": "none (voluntary) full"}, False, "voluntary"),
        ("#1 SMP PREEMPT_DYNAMIC", {"proc__cmdline": "quiet preempt=none"}, False, "none"),
        ("#1 SMP PREEMPT", {}, True, "PREEMPT"),
        ("#1 SMP", {}, False, "voluntary"),
    ],
)
def test_preemption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, files: dict[str, str], good: bool | None, words: str
) -> None:
    monkeypatch.setattr(platform, "version", lambda: version)
    found = tree(tmp_path, **files).preemption()
    assert found.good is good
    assert words in found.found


@pytest.mark.parametrize(
    ("capabilities", "limit", "priority", "memory"),
    [("0000000000000000", 0, False, False), ("0000000000804000", 0, True, True), ("0000000000000000", -1, True, True)],
)
def test_privileges(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capabilities: str, limit: int, priority: bool, memory: bool
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _which: (limit, limit))
    machine = tree(tmp_path, proc__self__status=f"Name:\tx\nCapEff:\t{capabilities}")
    assert (machine.priority().good, machine.locked_memory().good) == (priority, memory)
    if not priority:
        assert machine.priority().remedy == machine.locked_memory().remedy == SHELL_REMEDY


@pytest.mark.parametrize(("runtime", "good"), [("950000", True), ("-1", None), ("100000", False)])
def test_throttling(tmp_path: Path, runtime: str, good: bool | None) -> None:
    machine = tree(
        tmp_path, proc__sys__kernel__sched_rt_runtime_us=runtime, proc__sys__kernel__sched_rt_period_us="1000000"
    )
    assert machine.throttling().good is good


@pytest.mark.parametrize(("quota", "good"), [("max 100000", True), ("150000 100000", False)])
def test_quota(tmp_path: Path, quota: str, good: bool) -> None:
    assert tree(tmp_path, **{"sys__fs__cgroup__cpu.max": quota}).quota().good is good


@pytest.mark.parametrize(("names", "good"), [(("performance",) * 2, True), (("performance", "powersave"), False)])
def test_governor(tmp_path: Path, names: tuple[str, ...], good: bool) -> None:
    files = {f"sys__devices__system__cpu__cpu{i}__cpufreq__scaling_governor": name for i, name in enumerate(names)}
    assert tree(tmp_path, **files).governor().good is good


@pytest.mark.parametrize(
    ("current", "available", "good", "remedy"),
    [
        ("tsc", "tsc hpet", True, ""),
        ("hpet", "tsc hpet acpi_pm", False, "echo tsc | sudo tee /sys/"),
        ("hpet", "hpet", False, "tsc=reliable"),
    ],
)
def test_clock_source(tmp_path: Path, current: str, available: str, good: bool, remedy: str) -> None:
    folder = "sys__devices__system__clocksource__clocksource0__"
    files = {folder + "current_clocksource": current, folder + "available_clocksource": available}
    found = tree(tmp_path, **files).clock_source()
    assert found.good is good
    assert remedy in found.remedy


def test_socket_buffers(tmp_path: Path) -> None:
    machine = tree(
        tmp_path, proc__sys__net__core__rmem_max="212992", proc__sys__net__core__wmem_max=str(WANTED_BUFFER_BYTES)
    )
    receive, send = machine.socket_buffers()
    assert (receive.good, send.good) == (False, True)
    assert receive.remedy == f"sudo sysctl -w net.core.rmem_max={WANTED_BUFFER_BYTES}"


def test_idle_states(tmp_path: Path) -> None:
    assert "--device" in Machine(tmp_path).idle_states().remedy
    assert tree(tmp_path, dev__cpu_dma_latency="").idle_states().good is True


@pytest.mark.parametrize(("load", "good"), [("0.01 0.5 0.5 1/1 1", True), ("99.0 0.5 0.5 1/1 1", False)])
def test_load(tmp_path: Path, load: str, good: bool) -> None:
    assert tree(tmp_path, proc__loadavg=load).load().good is good


def test_a_host_that_steals_is_told(tmp_path: Path) -> None:
    machine = tree(
        tmp_path, proc__cpuinfo="flags\t\t: fpu hypervisor sse", proc__stat="cpu  50 0 0 45 0 0 0 5 0 0\ncpu0 1"
    )
    assert "5 % stolen" in machine.virtualisation().found


@pytest.mark.parametrize(("cores", "good"), [({0}, False), ({0, 1}, True)])
def test_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: set[int], good: bool) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: cores)
    assert tree(tmp_path, sys__devices__system__cpu__isolated="1").cores().good is good
