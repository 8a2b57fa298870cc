"""A few damaged logs of each format, always the same; `make fuzz` tries 100 000 of each."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import fuzz


@pytest.mark.parametrize("kind", ["tlog", "raw", "bin", "ulg", "log"])
def test_damaged_logs_give_tables_or_a_sentence(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fuzz, "MOST_S", 60.0)  # the first input waits for the compiler, and the others for other tests
    said: list[str] = []
    assert fuzz.fuzz(kind, 100, seed=2026, tell=said.append) == 0, said
    assert ", 0 faults;" in said[-1]
    assert not list(tmp_path.iterdir())


def test_a_fault_is_found_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(path: Path, *, out: Path | None) -> str:
        raise ValueError(path.name)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fuzz, "read_all", broken)
    said: list[str] = []
    assert fuzz.fuzz("ulg", 2, seed=1, tell=said.append) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fuzz-ulg-1-0.ulg", "fuzz-ulg-1-1.ulg"]
    assert said[0] == "fuzz-ulg-1-0.ulg: ValueError: in.ulg"
