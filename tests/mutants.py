"""The mutation run (`make mutants`): small faults are put into the safety-critical rooms one by one; the tests must find each.

cosmic-ray makes the faults and keeps the account; each room is run in a copy of the sources of its own, with the tests that
mirror it and kernels as plain Python (`tests.interpreted`). What no test finds is printed; docs/testing.md has each with its
reason. A run that was stopped goes on where it was, as long as neither the room nor its tests have changed.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import WorkerOutcome, WorkResult

ROOT = Path(__file__).resolve().parent.parent
PLACE = ROOT / "build" / "mutants"
TIMEOUT_S = 60.0
PYTEST = (
    "-m pytest -x -q -p tests.interpreted -p no:cacheprovider -p no:xdist -W ignore::RuntimeWarning "
    "--hypothesis-profile=mutants"
)

_PACING = "tests/plant_emulator/pacing"
_LOCKSTEP = f"{_PACING}/test_lockstep.py::TestAnswers {_PACING}/test_lockstep.py::TestSilence"
_REAL_TIME = f'{_PACING}/test_real_time.py -k "not three_seconds"'
_CODEC = "tests/protocol/wire/test_codec.py"
_TOLERANT = f"{_PACING}/test_tolerant.py::TestScript"
ROOMS = {
    "controller/sources/hil.py": "tests/controller/sources",
    "controller/tick.py": "tests/controller/test_tick.py",
    "controller/session.py": "tests/controller/test_session.py",
    "controller/sinks/hil.py": "tests/controller/sinks",
    "plant_emulator/command_source.py": "tests/plant_emulator/test_command_source.py",
    "plant_emulator/tick.py": "tests/plant_emulator/test_tick.py",
    "plant_emulator/plant/safety.py": "tests/plant_emulator/plant/test_safety.py",
    "plant_emulator/pacing/lockstep.py": _LOCKSTEP,
    "plant_emulator/pacing/meeting.py": f"{_PACING}/test_meeting.py",
    "plant_emulator/pacing/pacing.py": f"{_LOCKSTEP} {_TOLERANT} {_PACING}/test_real_time.py::TestTimes",
    "plant_emulator/pacing/real_time.py": _REAL_TIME,
    "plant_emulator/pacing/tolerant.py": _TOLERANT,
    "protocol/wire/framing.py": f"tests/protocol/wire/test_framing.py {_CODEC}::TestForeignFrames {_CODEC}::TestSequence",
    "protocol/wire/signing.py": "tests/protocol/wire/test_signing.py",
    "bridge/links/signed_link.py": 'tests/bridge/links/test_signed_link.py -k "not flight"',
}
"""Each room and the tests that must find what is wrong in it."""

KEPT = (
    "ReplaceComparisonOperator_(Eq_NotEq|NotEq_Eq|Lt_LtE|LtE_Lt|Gt_GtE|GtE_Gt|Lt_Gt|Gt_Lt|Is_IsNot|IsNot_Is)",
    "ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|FloorDiv_Mul|Mod_FloorDiv|RShift_LShift|LShift_RShift)",
    "ReplaceBinaryOperator_(BitAnd_BitOr|BitOr_BitAnd|BitXor_BitOr)",
    "ReplaceUnaryOperator_(Delete_Not|Delete_USub|Delete_Invert)",
    "Replace(TrueWithFalse|FalseWithTrue|AndWithOr|OrWithAnd|BreakWithContinue|ContinueWithBreak)",
    "AddNot|NumberReplacer|ZeroIterationForLoop|ExceptionReplacer",
)
"""Kinds of faults. Those left out swap an operator for one that nobody would write by mistake."""


def main() -> int:
    """Run the rooms named, or all; 1 where a fault was not found, 2 where the tests fail without any."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="*", metavar="ROOM", help=f"any of {', '.join(ROOMS)}")
    parser.add_argument("--jobs", type=int, default=2, help="rooms at work at once (2)")
    chosen = parser.parse_args()
    unknown = set(chosen.rooms) - set(ROOMS)
    if unknown:
        parser.error(f"no room {', '.join(sorted(unknown))}")
    with ThreadPoolExecutor(chosen.jobs) as threads:
        left = sum(threads.map(run_room, chosen.rooms or ROOMS))
    return 1 if left else 0


def run_room(room: str) -> int:
    """Put each fault into a copy of the room and test it; the number of those that no test found."""
    folder = PLACE / room.replace("/", "_").removesuffix(".py")
    session, config, tree = folder / "session.sqlite", folder / "config.toml", folder / "tree"
    stamp, digest = folder / "digest", _digest(room)
    if not stamp.exists() or stamp.read_text() != digest:
        shutil.rmtree(folder, ignore_errors=True)
        _copy(tree)
        config.write_text(_config(room))
        _cosmic_ray(tree, "init", config, session)
        subprocess.run([_tool("cr-filter-operators"), session, config], check=True, cwd=tree)
        _leave_out(session, tree / room)
        stamp.write_text(digest)
    shutil.copy2(ROOT / room, tree / room)  # a run that was stopped may have left a fault in it
    command = [sys.executable, *PYTEST.split(), *shlex.split(ROOMS[room])]
    clean = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    if clean.returncode:
        sys.stderr.write(f"{room}: the tests fail without any fault:\n{clean.stdout[-3000:]}")
        raise SystemExit(2)
    _cosmic_ray(tree, "exec", config, session)
    found = list(_results(session))
    survivors = [text for outcome, text in found if outcome == "survived"]
    sys.stdout.write(f"{room}: {len(found)} faults, {len(survivors)} not found\n" + "".join(survivors))
    sys.stdout.flush()
    return len(survivors)


def _config(room: str) -> str:
    command = f"{sys.executable} {PYTEST} {ROOMS[room]}"
    return (
        f"[cosmic-ray]\nmodule-path = '{room}'\ntimeout = {TIMEOUT_S}\nexcluded-modules = []\n"
        f"test-command = '{command}'\n[cosmic-ray.distributor]\nname = 'local'\n"
        f"[cosmic-ray.filters.operators-filter]\nexclude-operators = ['core/(?!({'|'.join(KEPT)})$)']\n"
    )


def _copy(tree: Path) -> None:
    """A copy of the sources: the room is changed in there."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in names.split("\0"):
        source = ROOT / name
        if name and source.is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, tree / name)


def _digest(room: str) -> str:
    """Of the room, its tests, and the faults to make."""
    digest = hashlib.sha256(_config(room).encode())
    for name in (room, *(part.split("::")[0] for part in ROOMS[room].split() if part.startswith("tests/"))):
        path = ROOT / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _leave_out(session: Path, source: Path) -> None:
    """Leave out what cannot be a fault: types, which are never evaluated, and the `strict` of `zip`, a check of our own."""
    places: list[tuple[int, int, int]] = []
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        parts = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        if isinstance(node, ast.keyword) and node.arg == "strict":
            parts = [node.value]
        places += [
            (part.lineno, part.col_offset, part.end_col_offset or 0) for part in parts if isinstance(part, ast.expr)
        ]
    with use_db(session, WorkDB.Mode.open) as work:
        for item in list(work.pending_work_items):
            (line, column) = item.mutations[0].start_pos
            if any(line == at and first <= column < last for at, first, last in places):
                work.set_result(item.job_id, WorkResult(worker_outcome=WorkerOutcome.SKIPPED))


def _results(session: Path) -> Iterator[tuple[str, str]]:
    """(outcome, what was changed) of each fault that was tried."""
    dump = subprocess.run([_tool("cosmic-ray"), "dump", session], capture_output=True, text=True, check=True).stdout
    for item, result in map(json.loads, dump.splitlines()):
        if result and result["worker_outcome"] == "normal":
            mutation = item["mutations"][0]
            changed = [line for line in result["diff"].splitlines()[3:] if line[:1] in "+-"]
            place = f"  {mutation['module_path']}:{mutation['start_pos'][0]}"
            yield result["test_outcome"], "".join(f"{place}: {line[0]} {line[1:].strip()}\n" for line in changed)


def _cosmic_ray(tree: Path, *words: object) -> None:
    subprocess.run([_tool("cosmic-ray"), *map(str, words)], cwd=tree, check=True)


def _tool(name: str) -> str:
    """A program of this environment."""
    return str(Path(sys.executable).with_name(name))


if __name__ == "__main__":
    sys.exit(main())
