"""Names of exported files are safe and unique, and nothing that is there is ever replaced."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fwav_hil.logs.outputs import file_names, whole
from protocol.errors import RunFolderError
from tests.cases import case
from tests.fwav_hil.logs.conftest import Shell


@given(st.lists(st.text() | st.sampled_from(["a", "A", "a_2", "..", "../a", "/a", "con", "COM1.x", "", "a/b", "a\\b"])))
def test_any_names_become_safe_names_of_which_no_two_are_alike(names: list[str]) -> None:
    names = list(dict.fromkeys(names))
    made = file_names(names)
    assert list(made) == names
    assert len({name.lower() for name in made.values()}) == len(names)
    for name in made.values():
        assert name
        assert not set(name) & set('/\\:*?"<>|\0\n')
        assert name[0] not in ".-"
        assert len(name) < 140
        assert name.partition(".")[0].lower() not in ("con", "prn", "aux", "nul", "com1", "lpt1")


def test_usual_names_stay_as_they_are() -> None:
    assert file_names(["HIL_SENSOR", "imu_1", "esc.rpm"]) == {n: n for n in ("HIL_SENSOR", "imu_1", "esc.rpm")}
    assert file_names(["GPS", "units"], taken=["units"]) == {"GPS": "GPS", "units": "units_2"}


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize("log", ["in.ulg", "absolute.ulg", "in.bin"])
def test_every_exported_file_is_inside(
    shell: Shell, tmp_path: Path, kind: str, log: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fwav_hil.logs.working.Working.__call__", lambda *_: None)
    (tmp_path / "q").mkdir()
    (tmp_path / f"keep_me.{kind}").write_text("mine")
    (tmp_path / "q" / f"a.{kind}").write_text("mine")
    before = set(tmp_path.rglob("*"))
    ended = shell("export", case(f"export-path-escape/{log}"), "--to", kind, "--out", "q/x")
    assert ended.code == 0
    new = set(tmp_path.rglob("*")) - before
    assert all(path.is_relative_to(tmp_path / "q" / "x") for path in new)
    assert any(path.suffix == f".{kind}" for path in new)
    assert (tmp_path / f"keep_me.{kind}").read_text() == (tmp_path / "q" / f"a.{kind}").read_text() == "mine"
    assert not list(Path("/var/tmp").glob(f"*keep_me*.{kind}"))


class TestWhole:
    @pytest.mark.parametrize("is_folder", [True, False])
    def test_what_came_meanwhile_is_not_replaced(self, tmp_path: Path, is_folder: bool) -> None:
        out = tmp_path / "out"
        with pytest.raises(RunFolderError, match=r"cannot write .*out: File exists"), whole(out) as partial:
            if is_folder:
                partial.mkdir()
            partial.joinpath("a" if is_folder else "").write_text("ours")
            out.write_text("mine")
        assert out.read_text() == "mine"
        assert list(tmp_path.iterdir()) == [out]

    def test_a_link_that_leads_nowhere_stays(self, tmp_path: Path) -> None:
        (tmp_path / "out").symlink_to(tmp_path / "elsewhere")
        with pytest.raises(RunFolderError, match="is there already"), whole(tmp_path / "out"):
            pytest.fail("it must not begin")
        assert not (tmp_path / "elsewhere").exists()

    def test_a_file_of_somebody_else_with_a_name_like_ours_stays(self, tmp_path: Path) -> None:
        (tmp_path / "out.part").write_text("mine")
        with whole(tmp_path / "out") as partial:
            partial.write_text("ours")
        assert (tmp_path / "out").read_text() == "ours"
        assert (tmp_path / "out.part").read_text() == "mine"

    def test_a_file_system_without_links(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object) -> None:
            raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr("os.link", refuse)
        with whole(tmp_path / "out") as partial:
            partial.write_text("ours")
        assert (tmp_path / "out").read_text() == "ours"
        with pytest.raises(RunFolderError), whole(tmp_path / "other") as partial:
            partial.write_text("ours")
            (tmp_path / "other").write_text("mine")
        assert (tmp_path / "other").read_text() == "mine"
