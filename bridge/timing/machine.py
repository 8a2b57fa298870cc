"""Properties of this machine that matter to real time, read from /proc and /sys; both may be missing.

Each finding is good (True), bad (False) or neutral (None); a bad one has the command that corrects it.
"""

from __future__ import annotations

import os
import platform
import re
import resource
from collections.abc import Iterator
from pathlib import Path

import msgspec

from bridge.timing.realtime import DMA_LATENCY, PRIORITY, SHELL_REMEDY

WANTED_BUFFER_BYTES = 1 << 20
"""Socket buffer that a UDP link requests for each direction (`bridge.links.udp`)."""

_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_GOOD_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page")
_NOT_TOLD = "unknown"


class Finding(msgspec.Struct, frozen=True):
    """One property of the machine: its value, whether it is good, and the command that corrects it."""

    name: str
    found: str
    good: bool | None
    remedy: str = ""


class Machine:
    """Reads the properties of the machine. `root` replaces / in tests."""

    def __init__(self, root: Path = Path("/")) -> None:
        self._root = root

    def findings(self) -> list[Finding]:
        """All findings, in the order in which they are shown."""
        return [
            self.preemption(),
            self.priority(),
            self.throttling(),
            self.locked_memory(),
            self.idle_states(),
            self.cores(),
            self.quota(),
            self.governor(),
            self.timer_slack(),
            self.clock_source(),
            *self.socket_buffers(),
            self.load(),
            self.virtualisation(),
        ]

    def _read(self, path: str) -> str:
        """The text of a file, stripped; empty where it is missing or not readable."""
        try:
            return (self._root / path).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return ""

    def _capability(self, number: int) -> bool:
        effective = re.search(r"^CapEff:\s*([0-9a-fA-F]+)", self._read("proc/self/status"), re.MULTILINE)
        return bool(effective and int(effective[1], 16) >> number & 1)

    def preemption(self) -> Finding:
        """Whether tasks can preempt kernel code: nearly everywhere with PREEMPT_RT, nowhere with `none`."""
        release, version = platform.release(), platform.version()
        if self._read("sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
            return Finding("kernel preemption", f"{release}, PREEMPT_RT", True)
        chosen = re.search(r"\((\w+)\)", self._read("sys/kernel/debug/sched/preempt"))
        booted = re.search(r"\bpreempt=(\w+)", self._read("proc/cmdline"))
        model = chosen[1] if chosen else booted[1] if booted else ""
        if "PREEMPT_DYNAMIC" in version:
            found = f"{release}, PREEMPT_DYNAMIC, {model or 'model unknown'}"
            if model in ("", "full", "lazy"):
                return Finding("kernel preemption", found, None if not model else True)
            return Finding("kernel preemption", found, False, "boot with preempt=full, or a kernel with PREEMPT_RT")
        if "PREEMPT" in version:
            return Finding("kernel preemption", f"{release}, PREEMPT", True)
        return Finding(
            "kernel preemption", f"{release}, none or voluntary", False, "sudo apt install linux-image-rt-amd64"
        )

    def priority(self) -> Finding:
        """Whether this user may use SCHED_FIFO."""
        limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
        if self._capability(_CAP_SYS_NICE):
            return Finding("real-time priority", "allowed (CAP_SYS_NICE)", True)
        allowed = limit == resource.RLIM_INFINITY or limit >= PRIORITY
        found = f"limit rtprio {'unlimited' if limit == resource.RLIM_INFINITY else limit}, {PRIORITY} needed"
        return Finding("real-time priority", found, allowed, "" if allowed else SHELL_REMEDY)

    def throttling(self) -> Finding:
        """The share of a core that real-time processes may take before the kernel throttles them."""
        runtime, period = (
            self._read("proc/sys/kernel/sched_rt_runtime_us"),
            self._read("proc/sys/kernel/sched_rt_period_us"),
        )
        if not runtime.lstrip("-").isdigit() or not period.isdigit():
            return Finding("real-time throttling", _NOT_TOLD, None)
        if int(runtime) < 0:
            return Finding("real-time throttling", "off", None)
        share = 100 * int(runtime) / int(period)
        good = share >= 50
        remedy = "" if good else f"sudo sysctl -w kernel.sched_rt_runtime_us={int(period) * 95 // 100}"
        return Finding("real-time throttling", f"{share:g} % of a core", good, remedy)

    def locked_memory(self) -> Finding:
        """Whether this user may lock memory."""
        limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
        if self._capability(_CAP_IPC_LOCK):
            return Finding("locked memory", "allowed (CAP_IPC_LOCK)", True)
        if limit == resource.RLIM_INFINITY:
            return Finding("locked memory", "allowed, unlimited", True)
        return Finding("locked memory", f"limit memlock {limit // 1024} KiB", False, SHELL_REMEDY)

    def idle_states(self) -> Finding:
        """Whether this user may keep the cores out of deep idle states."""
        device = self._root / DMA_LATENCY.relative_to("/")
        if not device.exists():
            return Finding("idle states", f"no {DMA_LATENCY}", False, f"in a container: --device {DMA_LATENCY}")
        if os.access(device, os.W_OK):
            return Finding("idle states", f"{DMA_LATENCY} can be held at 0", True)
        return Finding("idle states", f"no write access to {DMA_LATENCY}", False, f"sudo chmod o+w {DMA_LATENCY}")

    def cores(self) -> Finding:
        """How many cores this process may use, and whether some are isolated from other processes."""
        usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        isolated = self._read("sys/devices/system/cpu/isolated")
        found = f"{usable} of {os.cpu_count()} usable" + (f", isolated: {isolated}" if isolated else ", none isolated")
        remedy = "" if usable > 1 else "give the container or machine two cores, one for each end"
        return Finding("cores", found, usable > 1, remedy)

    def quota(self) -> Finding:
        """A container's quota of processor time: when it is used up, every process in it is stopped for a while."""
        words = self._read("sys/fs/cgroup/cpu.max").split()
        if len(words) != 2 or not words[0].isdigit() or not words[1].isdigit():
            return Finding("processor quota", "none", True)
        cores = int(words[0]) / int(words[1])
        return Finding("processor quota", f"{cores:g} cores", False, "start the container without --cpus")

    def governor(self) -> Finding:
        """Whether the cores may change their frequency."""
        policies = sorted(self._root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"))
        names = sorted({self._read(str(path.relative_to(self._root))) for path in policies} - {""})
        if not names:
            return Finding("frequency governor", _NOT_TOLD, None)
        good = names == ["performance"]
        return Finding(
            "frequency governor", ", ".join(names), good, "" if good else "sudo cpupower frequency-set -g performance"
        )

    def timer_slack(self) -> Finding:
        """By how much the system may stretch a sleep; `--realtime` sets it to 1 ns for itself."""
        slack = self._read("proc/self/timerslack_ns")
        return Finding("timer slack", f"{slack} ns (--realtime: 1 ns)" if slack else _NOT_TOLD, None)

    def clock_source(self) -> Finding:
        """The kernel's clock source: some take microseconds to read."""
        folder = "sys/devices/system/clocksource/clocksource0"
        current = self._read(f"{folder}/current_clocksource")
        if not current:
            return Finding("clock source", _NOT_TOLD, None)
        if current in _GOOD_CLOCKS:
            return Finding("clock source", current, True)
        others = self._read(f"{folder}/available_clocksource").split()
        better = next((name for name in _GOOD_CLOCKS if name in others), "")
        remedy = f"echo {better} | sudo tee /{folder}/current_clocksource" if better else "boot with tsc=reliable"
        return Finding("clock source", f"{current}, which is slow to read", False, remedy)

    def socket_buffers(self) -> Iterator[Finding]:
        """Whether a socket gets the buffer that a link requests."""
        for name, what in (("rmem_max", "receive"), ("wmem_max", "send")):
            allowed = self._read(f"proc/sys/net/core/{name}")
            if not allowed.isdigit():
                yield Finding(f"{what} buffer", _NOT_TOLD, None)
                continue
            good = int(allowed) >= WANTED_BUFFER_BYTES
            remedy = "" if good else f"sudo sysctl -w net.core.{name}={WANTED_BUFFER_BYTES}"
            yield Finding(f"{what} buffer", f"up to {int(allowed) // 1024} KiB", good, remedy)

    def load(self) -> Finding:
        """The present load of the machine."""
        words = self._read("proc/loadavg").split()
        if not words:
            return Finding("load", _NOT_TOLD, None)
        count = os.cpu_count() or 1
        good = float(words[0]) < 0.5 * count
        remedy = "" if good else "stop other programs on this machine: see `top`"
        return Finding("load", f"{float(words[0]):g} on {count} cores in the last minute", good, remedy)

    def virtualisation(self) -> Finding:
        """Whether this is a virtual machine, and how much processor time its host has taken away since the start."""
        if not re.search(r"^flags.*\bhypervisor\b", self._read("proc/cpuinfo"), re.MULTILINE):
            return Finding("virtual machine", "no sign of one", True)
        words = self._read("proc/stat").splitlines()[:1]
        times = [int(word) for word in words[0].split()[1:9]] if words else []
        stolen = f", {100 * times[7] / max(1, sum(times)):.2g} % stolen since it started" if len(times) == 8 else ""
        return Finding(
            "virtual machine", f"yes{stolen}", None, "no setting stops the host from taking time: use real hardware"
        )
