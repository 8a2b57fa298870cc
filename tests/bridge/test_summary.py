"""Folders, JSON files and percentiles: what a run leaves in words and numbers."""

from __future__ import annotations

import errno
import json
import random
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.summary import is_stdout, make_folder, percentiles_us, read_json, show_json, write_json
from protocol.errors import RunFolderError

CONTENT: dict[str, Any] = {"name": "µ", "deep": {"list": [1, 2.5, None], "true": True}}


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


class TestFolder:
    def test_it_is_made_with_all_above_it_and_may_be_there(self, tmp_path: Path) -> None:
        for _ in range(2):
            make_folder(tmp_path / "a" / "b" / "c")
        assert (tmp_path / "a" / "b" / "c").is_dir()

    @pytest.mark.parametrize("below", ["", "deeper"])
    def test_a_file_in_its_place_is_named_with_the_remedy(self, tmp_path: Path, below: str) -> None:
        (tmp_path / "taken").write_text("mine")
        with pytest.raises(RunFolderError, match=r"cannot create the folder .*taken.*: .*choose another with --out"):
            make_folder(tmp_path / "taken" / below)
        assert (tmp_path / "taken").read_text() == "mine"


class TestWriteJson:
    def test_what_is_written_can_be_read(self, tmp_path: Path) -> None:
        path = tmp_path / "x.json"
        write_json(path, CONTENT)
        assert json.loads(path.read_text(encoding="utf-8")) == CONTENT
        assert read_json(path) == CONTENT
        assert path.read_text(encoding="utf-8").endswith("\n")

    def test_only_the_file_stays(self, tmp_path: Path) -> None:
        for number in range(2):
            write_json(tmp_path / "x.json", {"number": number})
        assert names(tmp_path) == ["x.json"]
        assert read_json(tmp_path / "x.json") == {"number": 1}

    def test_no_number_is_null(self, tmp_path: Path) -> None:
        write_json(tmp_path / "x.json", {"a": float("nan"), "b": float("inf")})
        assert read_json(tmp_path / "x.json") == {"a": None, "b": None}

    def test_a_folder_that_is_not_there_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(RunFolderError, match=r"cannot write .*nowhere/x\.json: No such file"):
            write_json(tmp_path / "nowhere" / "x.json", CONTENT)

    def test_a_folder_in_its_place_is_an_error_and_no_part_stays(self, tmp_path: Path) -> None:
        (tmp_path / "x.json").mkdir()
        with pytest.raises(RunFolderError, match=r"cannot write .*x\.json"):
            write_json(tmp_path / "x.json", CONTENT)
        assert names(tmp_path) == ["x.json"]

    def test_a_full_disk_leaves_the_old_file_whole_and_no_part(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fill_up(path: Path, data: bytes) -> int:
            with path.open("wb") as file:
                file.write(data[: len(data) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")

        path = tmp_path / "x.json"
        write_json(path, CONTENT)
        monkeypatch.setattr(Path, "write_bytes", fill_up)
        with pytest.raises(RunFolderError, match=r"cannot write .*x\.json: No space left on device"):
            write_json(path, {"new": 1})
        assert read_json(path) == CONTENT
        assert names(tmp_path) == ["x.json"]


class TestShowJson:
    def test_to_standard_output(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert is_stdout(Path("-"))
        show_json(Path("-"), CONTENT)
        assert json.loads(capsys.readouterr().out) == CONTENT

    def test_to_a_file(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert not is_stdout(tmp_path / "x.json")
        show_json(tmp_path / "x.json", CONTENT)
        assert read_json(tmp_path / "x.json") == CONTENT
        assert capsys.readouterr().out == ""

    def test_nowhere(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert not is_stdout(None)
        show_json(None, CONTENT)
        assert capsys.readouterr().out == ""


class TestReadJson:
    def test_no_file_is_empty(self, tmp_path: Path) -> None:
        assert read_json(tmp_path / "x.json") == {}

    @pytest.mark.parametrize("data", [b"", b"{", b'{"a": 1} x', b"[1]", b"1", b"null", b'{"a": "\xff"}', b"\x80"])
    def test_a_damaged_file_is_named(self, tmp_path: Path, data: bytes) -> None:
        (tmp_path / "x.json").write_bytes(data)
        with pytest.raises(RunFolderError, match=r"cannot read .*x\.json: "):
            read_json(tmp_path / "x.json")

    def test_a_folder_in_its_place_is_an_error(self, tmp_path: Path) -> None:
        (tmp_path / "x.json").mkdir()
        with pytest.raises(RunFolderError, match=r"cannot read .*x\.json"):
            read_json(tmp_path / "x.json")


class TestPercentiles:
    def test_nothing_to_count(self) -> None:
        assert percentiles_us([]) == {"p50": None, "p99": None, "p999": None, "max": None}

    def test_one_duration_is_all_of_them(self) -> None:
        assert percentiles_us([2500]) == {"p50": 2.5, "p99": 2.5, "p999": 2.5, "max": 2.5}

    def test_a_thousand_steps(self) -> None:
        """0, 1 .. 1000 us, in any order: the percentile p is 10 p us."""
        durations = [1000 * us for us in range(1001)]
        random.Random(1).shuffle(durations)
        assert percentiles_us(durations) == pytest.approx({"p50": 500.0, "p99": 990.0, "p999": 999.0, "max": 1000.0})

    def test_one_outlier_shows_in_the_worst_only(self) -> None:
        shown = percentiles_us([1000] * 9999 + [10**9])
        assert shown == pytest.approx({"p50": 1.0, "p99": 1.0, "p999": 1.0, "max": 1e6})

    @given(st.lists(st.integers(0, 10**12), min_size=1, max_size=60))
    def test_they_are_what_their_definition_says_and_numpy_too(self, durations: list[int]) -> None:
        ordered = sorted(durations)

        def between_ranks(part: Fraction) -> float:
            place = part * (len(ordered) - 1)
            low = int(place)
            high = min(low + 1, len(ordered) - 1)
            return float((ordered[low] + (place - low) * (ordered[high] - ordered[low])) / 1000)

        parts = {"p50": Fraction(1, 2), "p99": Fraction(99, 100), "p999": Fraction(999, 1000), "max": Fraction(1)}
        shown = percentiles_us(durations)
        assert shown == pytest.approx({name: between_ranks(part) for name, part in parts.items()}, rel=1e-9)
        by_numpy = [float(np.percentile(durations, 100 * float(part))) / 1e3 for part in parts.values()]
        assert list(shown.values()) == pytest.approx(by_numpy)
