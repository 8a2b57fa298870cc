"""Runs whose drives are a third process on a CAN bus: equal to the direct path, and mended when that process is killed."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import can
import numpy as np
import pytest

from fwav_hil.compile import compile_kernels
from fwav_hil.simulate import simulate
from plant_emulator.drives.motor_node import is_of_drives
from plant_emulator.plant.truth import load_truth
from protocol.can_frame import CanFrame
from protocol.motors import simulation_sync
from protocol.scenario import find_scenario
from tests.bridge.motor_bus.test_can_bus import free_group
from tests.dbc import published_odrive_dbc
from tests.fwav_hil.test_run import FREE, PATIENCE_S, assert_one_line, call, flying, processes_of, started, wait_until
from tests.loop import scenario_of

pytestmark = [pytest.mark.processes, pytest.mark.timeout(150)]
FLAPPER = "flapper"


@pytest.fixture(scope="module", autouse=True)
def compiled_kernels() -> None:
    """Compile once, so that no bound of a test is spent on it."""
    compile_kernels(scenario_of("flapper"))


def test_three_processes_fly_as_the_simulation_does(tmp_path: Path) -> None:
    """Lag zero, ODrive: the same bits; and python-can and cantools' own command read the record."""
    bus = free_group()
    ended = call("run", "flapper", "--motor", "can", "--can", bus, "--lag", "0", "--duration", "0.4", "--link", FREE,
                     "--out", "run", "--no-plots", "--json", "r.json", "--can-log", "bus.log", cwd=tmp_path)  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    truth, simulated = (
        load_truth(tmp_path / "run" / "ground_truth.npy"),
        simulate(scenario_of("flapper", duration_s=0.4)),
    )
    for name in ("q", "command", "tau", "u"):
        assert np.array_equal(truth[name], getattr(simulated, name)), name
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["can"]["protocol"] == "odrive"
    assert result["counters"]["motor"]["syncs"] == 100
    assert "motor" not in processes_of(tmp_path)
    messages = [CanFrame(m.arbitration_id, bytes(m.data)) for m in can.LogReader(tmp_path / "bus.log")]
    assert len(messages) > 13 * 100
    assert any(is_of_drives(frame) for frame in messages)
    lockstep = Path(simulation_sync.__file__).with_suffix(".dbc")
    decoded = subprocess.run(
        [sys.executable, "-m", "cantools", "decode", "--single-line", str(lockstep)],
        input=(tmp_path / "bus.log").read_text(), capture_output=True, text=True, check=True, timeout=PATIENCE_S,
    ).stdout  # fmt: skip
    assert len(re.findall(r":: Sync\(", decoded)) == 100
    # At 100 Hz over 0.4 s; whether the last one still gets into the record is a race between the ends of two processes.
    assert len(re.findall(r":: Encoders_gamma\(", decoded)) in (39, 40)


def test_a_killed_motor_process_is_started_again_and_met_again(tmp_path: Path) -> None:
    """Simulation time stands still: up to the kill the flight is the simulation's, then it has one tick without torque."""
    folder = tmp_path / "run"
    with started("run", "flapper", "--motor", "can", "--can", free_group(), "--duration", "5", "--lag", "0", "--link", FREE,
                 "--out", folder, "--no-plots", cwd=tmp_path) as run:  # fmt: skip
        wait_until(lambda: flying(folder))
        first = processes_of(tmp_path)["motor"]
        os.kill(first, signal.SIGKILL)
        wait_until(lambda: processes_of(tmp_path).get("motor", first) != first)
        _, errors = run.communicate(timeout=2 * PATIENCE_S)
    assert run.returncode == 0, errors
    assert "the motor process was ended by signal 9: restarted (1 of 3)" in errors
    assert "the drives answer again" in errors
    counters = json.loads((folder / "emulator.json").read_text())["counters"]
    truth = load_truth(folder / "ground_truth.npy")
    assert len(truth) == 1250
    assert counters["motor_resent"] > 0
    names = ("motor_outages", "motor_outage_ticks", "motor_safe_ticks", "motor_recoveries", "motor_enables")
    assert [counters[name] for name in names] == [1, 0, 1, 1, 2]
    (lost,) = np.flatnonzero(np.all(truth["u"] == 0.0, axis=1))
    simulated = simulate(scenario_of("flapper"))
    assert np.array_equal(truth["u"][:lost], simulated.u[:lost])
    assert "motor" not in processes_of(tmp_path)


def test_processes_that_stand_still_change_nothing(tmp_path: Path) -> None:
    """The drives longer than the controller waits for an emulator; this longer than drives in real time wait for a host."""
    folder = tmp_path / "run"
    with started("run", "flapper", "--motor", "can", "--can", free_group(), "--duration", "3", "--lag", "0", "--link", FREE,
                 "--out", folder, "--no-plots", cwd=tmp_path) as run:  # fmt: skip
        wait_until(lambda: flying(folder))
        for process, time_s in (
            (processes_of(tmp_path).get("motor"), 3.5),
            (processes_of(tmp_path)["plant_emulator"], 2.2),
        ):
            assert process is not None
            os.kill(process, signal.SIGSTOP)
            with pytest.raises(subprocess.TimeoutExpired):
                run.wait(time_s)
            os.kill(process, signal.SIGCONT)
            size = (folder / "run.tlog").stat().st_size
            wait_until(lambda size=size: (folder / "run.tlog").stat().st_size > size)
        _, errors = run.communicate(timeout=2 * PATIENCE_S)
    assert run.returncode == 0, errors
    truth, simulated = load_truth(folder / "ground_truth.npy"), simulate(scenario_of("flapper", duration_s=3.0))
    for name in ("q", "command", "tau", "u"):
        assert np.array_equal(truth[name], getattr(simulated, name)), name
    counters = json.loads((folder / "emulator.json").read_text())["counters"]
    assert (counters["motor_outages"], counters["motor_safe_ticks"]) == (0, 0)
    assert json.loads((folder / "motor.json").read_text())["counters"]["lost_hosts"] == 0


def test_drives_that_end_before_the_run_does_end_it_at_once(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with started("run", "flapper", "--motor", "can", "--can", free_group(), "--duration", "60", "--link", FREE,
                 "--out", folder, "--no-plots", cwd=tmp_path) as run:  # fmt: skip
        wait_until(lambda: flying(folder))
        drives = processes_of(tmp_path).get("motor")
        assert drives is not None
        os.kill(drives, signal.SIGTERM)
        _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 4
    assert_one_line(errors, "the process of the drives ended, which ended the run")
    truth = load_truth(folder / "ground_truth.npy")
    assert 0 < len(truth) < 15_000
    assert json.loads((folder / "emulator.json").read_text())["counters"]["motor_outage_ticks"] == 0


def test_a_rate_that_does_not_fit_is_refused_before_anything_starts(tmp_path: Path) -> None:
    ended = call("run", "flapper", "--motor", "can", "--protocol", "mit", "--rate", "1000", cwd=tmp_path)
    assert ended.returncode == 2
    assert_one_line(ended.stderr, "162 %", "does not fit", "500 Hz fits")
    assert not (tmp_path / "runs").exists()


def test_drives_that_nobody_started_are_one_sentence(tmp_path: Path) -> None:
    ended = call("emulator", "flapper", "--motor", "can", "--can", free_group(), "--link", FREE, "--wait", "0.5",
                     cwd=tmp_path)  # fmt: skip
    assert ended.returncode == 4
    assert_one_line(ended.stderr, "no drives", "start them with `fwav-hil motor")


def test_drives_alone_obey_a_controller_that_knows_only_the_published_dbc(tmp_path: Path) -> None:
    """`fwav-hil motor` as a simulated drive: python-can and cantools on the other side, killed in the end."""
    uri = free_group()
    dbc = published_odrive_dbc()
    (tmp_path / "two.toml").write_text(
        f'extends = "{find_scenario(FLAPPER)}"\n[motor]\nfirst_node_id = 1\nlag_s = 0.0\nwatchdog_s = 2.0\n'
    )

    def say(bus: can.BusABC, name: str, **values: object) -> None:
        message = dbc.get_message_by_name(name)
        bus.send(can.Message(arbitration_id=message.frame_id, data=message.encode(values, strict=False),
                             is_extended_id=False))  # fmt: skip

    def hear(bus: can.BusABC, name: str) -> dict[str, object]:
        message = dbc.get_message_by_name(name)
        while received := bus.recv(PATIENCE_S):
            if received.arbitration_id == message.frame_id:
                return dict(message.decode(bytes(received.data)))
        raise AssertionError(f"no {name} came")

    port = int(uri.rpartition(":")[2])
    with (
        can.Bus(interface="udp_multicast", channel="239.74.163.2", port=port, hop_limit=0) as bus,
        started("motor", "two.toml", "--can", uri, "--protocol", "odrive", "--json", "m.json", cwd=tmp_path) as drives,
    ):
        assert hear(bus, "Axis1_Heartbeat")["Axis_State"] == "IDLE"
        say(bus, "Axis1_Set_Controller_Mode", Control_Mode="TORQUE_CONTROL", Input_Mode="PASSTHROUGH")
        say(bus, "Axis1_Set_Axis_State", Axis_Requested_State="CLOSED_LOOP_CONTROL")
        for _ in range(200):  # its watchdog wants a command each 2 s, which a busy machine can keep
            say(bus, "Axis1_Set_Input_Torque", Input_Torque=4.0)
            iq = float(str(hear(bus, "Axis1_Get_Encoder_Estimates")["Pos_Estimate"]))
            if iq > 0.03:
                break
        assert iq == pytest.approx((0.25 - 0.05) / (2 * np.pi), rel=0.02)  # turns: tau less the width of its gear
        while hear(bus, "Axis1_Heartbeat")["Axis_Error"] != "WATCHDOG_TIMER_EXPIRED":
            pass  # the commands have ended
        second = call("motor", "two.toml", "--can", uri, "--protocol", "odrive", cwd=tmp_path)
        assert second.returncode == 3
        assert_one_line(second.stderr, "the CAN bus", "already has drives")
        drives.send_signal(signal.SIGINT)
        _, errors = drives.communicate(timeout=PATIENCE_S)
    assert drives.returncode == 0, errors
    assert json.loads((tmp_path / "m.json").read_text())["counters"]["watchdog_trips"] == 1


@pytest.mark.parametrize(
    ("option", "value", "words", "code"),
    [
        ("--can-log", "bus.txt", "choose a name that ends in .blf", 2),
        ("--can-log", "there.log", "there.log exists already and is not overwritten", 6),
        ("--tap", "carrier-pigeon://x", "carrier-pigeon", 2),
    ],
)
def test_what_cannot_be_recorded_or_tapped_leaves_no_folder(
    option: str, value: str, words: str, code: int, tmp_path: Path
) -> None:
    (tmp_path / "there.log").touch()
    ended = call("run", "flapper", "--motor", "can", "--can", "virtual:a", option, value, "--out", "run", cwd=tmp_path)
    assert_one_line(ended.stderr, words)
    assert ended.returncode == code
    assert not (tmp_path / "run").exists()
