"""A library that is not there: one sentence with the command that installs it, and a flight that goes on without plots."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bridge.command_line import run_command
from bridge.extras import EXTRAS, remedy, require
from fwav_hil.cli import cli
from fwav_hil.compile import compile_kernels
from protocol.errors import UsageError
from tests.loop import scenario_of

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 90.0


@pytest.fixture
def bare(tmp_path: Path) -> dict[str, str]:
    """The environment of a process in which no module of any extra can be imported, nor in those it starts."""
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    for module in (module for modules in EXTRAS.values() for module in modules):
        (hidden / f"{module}.py").write_text(f"raise ModuleNotFoundError('hidden', name={module!r})\n")
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(hidden), str(ROOT)])}


def call(arguments: list[str], environment: dict[str, str], cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fwav_hil", *arguments],
        env=environment, cwd=cwd, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip


@pytest.mark.processes
def test_a_first_run_needs_none(bare: dict[str, str], tmp_path: Path) -> None:
    compile_kernels(scenario_of("flapper"))
    arguments = ["run", "--duration", "0.2", "--link", "udpin://127.0.0.1:0", "--out", "run", "--json", "-"]
    done = call(arguments, bare, tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["ticks"] == 50
    assert (
        "no plots: this needs the library matplotlib, which is not installed: `pip install 'fwav-hil[plots]'`\n"
        in done.stderr
    )


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["run", "--motor", "can", "--out", "run"], "can"),
        (["motor"], "can"),
        (["design", "--out", "mine.toml"], "studies"),
        (["margin"], "studies"),
        (["latency", "--out", "run"], "studies"),
        (["paper", "--out", "study"], "plots"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_a_command_that_needs_one_says_so_before_it_begins(
    arguments: list[str], extra: str, bare: dict[str, str], tmp_path: Path
) -> None:
    done = call(arguments, bare, tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("fwav-hil: this needs the library ")
    assert done.stderr.endswith(f"which is not installed: `pip install 'fwav-hil[{extra}]'`\n")
    assert [path.name for path in tmp_path.iterdir()] == ["hidden"]


def test_a_long_run_asks_first(monkeypatch: pytest.MonkeyPatch) -> None:
    require(*EXTRAS)
    monkeypatch.setitem(sys.modules, "hdrh", None)
    require("plots", "logs", "can")
    with pytest.raises(UsageError, match=r"library hdrh, .*fwav-hil\[studies\]"):
        require("plots", "studies")


def test_a_module_of_no_extra_is_a_mistake_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    assert remedy(ModuleNotFoundError(name="fwav_hil.nowhere")) is None
    monkeypatch.setitem(sys.modules, "fwav_hil.compile", None)
    with pytest.raises(ModuleNotFoundError):
        run_command(cli, "fwav-hil", ["run", "--no-plots"])
