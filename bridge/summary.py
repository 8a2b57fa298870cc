"""Results of a run: folders, JSON files, percentiles."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from protocol.errors import RunFolderError


def make_folder(path: Path) -> None:
    """Create a folder for results. Raises RunFolderError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"cannot create the folder {path}: {error.strerror}; choose another with --out") from None


def refuse_existing_run(folder: Path) -> None:
    """Raise RunFolderError where the folder holds a run already: recorded data is never overwritten."""
    if (folder / "run.tlog").exists() or (folder / "ground_truth.npy").exists():
        raise RunFolderError(
            f"{folder} holds a run already, which is not overwritten: choose another folder with --out, or remove it"
        )


def write_text(path: Path, text: str) -> None:
    """Write a text file. Raises RunFolderError."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise RunFolderError(f"cannot write {path}: {error.strerror}; choose another folder with --out") from None


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write an indented JSON file atomically: a reader sees the old file or the complete new one. Raises RunFolderError."""
    data = msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"
    partial = path.with_name(path.name + ".part")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise RunFolderError(f"cannot write {path}: {error.strerror}") from None


def is_stdout(path: Path | None) -> bool:
    """Whether `--json` selects standard output, which then must hold nothing else."""
    return str(path) == "-"


def show_json(path: Path | None, content: dict[str, Any]) -> None:
    """Write the result of a command to the destination of its `--json`: a file, `-` for standard output, or none (None)."""
    if path is None:
        return
    if is_stdout(path):
        sys.stdout.write(msgspec.json.format(msgspec.json.encode(content), indent=2).decode() + "\n")
        sys.stdout.flush()  # here, so that a closed pipe is noticed now
    else:
        write_json(path, content)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file; empty where the file is missing. Raises RunFolderError where it is damaged."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:  # not JSON, not an object, not UTF-8
        raise RunFolderError(f"cannot read {path}: {error}") from None


def percentiles_us(durations_ns: Sequence[int]) -> dict[str, float | None]:
    """p50, p99, p999 and max in microseconds; all None without durations."""
    if not durations_ns:
        return dict.fromkeys(("p50", "p99", "p999", "max"))
    import numpy as np  # here: see `protocol.messages`

    p50, p99, p999, most = np.percentile(np.asarray(durations_ns), (50, 99, 99.9, 100)) / 1e3
    return {"p50": float(p50), "p99": float(p99), "p999": float(p999), "max": float(most)}
