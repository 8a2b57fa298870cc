"""The cache of compiled kernels: what an edit changes, on small trees of sources and on our own, and whom it trusts."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import kernel_cache as ours
from tests.protocol.source_tree import KERNEL, SOURCES, make_tree, source_of
from tests.protocol.source_tree import load_kernel_cache as load

ROOT = Path(str(ours.__file__)).parents[1]
MODULE = "plant_emulator.plant.body"


def folders(tree: Path, modules: dict[str, str] = SOURCES) -> dict[str, Path]:
    """The folder of each module, in a new process so to speak."""
    cache = load(tree)
    return {module: cache.kernel_folder(module) for module in modules}


def changed_by(tree: Path, edited: str, modules: dict[str, str] = SOURCES) -> set[str]:
    """The modules whose folder is another one after a line was added to `edited`."""
    before = folders(tree, modules)
    source = source_of(tree, edited)
    source.write_text(source.read_text() + "# an edit\n")
    after = folders(tree, modules)
    return {module for module in modules if before[module] != after[module]}


class TestKey:
    def test_equal_sources_share_a_folder_in_the_users_cache(self, tree: Path, places: Path) -> None:
        found = folders(tree)
        assert all(
            folder.is_dir() and folder.is_relative_to(places / "cache" / "fwav-hil") for folder in found.values()
        )
        for source in tree.rglob("*.py"):
            os.utime(source, (1, 1))  # a fresh checkout: other times, same bytes
        assert folders(tree) == found
        shutil.copytree(tree, places / "elsewhere")
        assert folders(places / "elsewhere") == found

    def test_an_edit_of_the_command_line_changes_nothing(self, tree: Path) -> None:
        assert changed_by(tree, "fwav_hil.cli") == {"fwav_hil.cli"}

    def test_an_edit_changes_exactly_what_imports_it_directly_or_not(self, tree: Path) -> None:
        assert changed_by(tree, "protocol.rotations") == {"protocol.rotations", MODULE, "plant_emulator.tick"}
        assert changed_by(tree, MODULE) == {MODULE, "plant_emulator.tick"}
        assert changed_by(tree, "controller.laws.law") == {"controller.laws.law", "controller.process", "fwav_hil.cli"}

    def test_an_edit_undone_finds_the_old_folder_again(self, tree: Path) -> None:
        before = folders(tree)
        source_of(tree, "protocol.rotations").write_text(f"{KERNEL}ANSWER = 42\n")
        assert folders(tree) != before
        source_of(tree, "protocol.rotations").write_text(SOURCES["protocol.rotations"])
        assert folders(tree) == before

    def test_a_source_that_comes_goes_or_moves_counts(self, tree: Path) -> None:
        body = source_of(tree, MODULE)
        body.write_text("from protocol import rotations, more\n")
        keys = [folders(tree)[MODULE]]
        (tree / "protocol" / "more.py").touch()
        keys.append(folders(tree)[MODULE])
        (tree / "protocol" / "rotations.py").unlink()
        keys.append(load(tree).kernel_folder(MODULE))
        (tree / "plant_emulator" / "plant" / "__init__.py").write_text("import protocol.compiled\n")
        keys.append(load(tree).kernel_folder(MODULE))
        assert len(set(keys)) == len(keys)

    @pytest.mark.parametrize(
        "imports",
        [
            "import protocol.rotations\n",
            "import protocol.rotations as turning\n",
            "from protocol import rotations\n",
            "from protocol import (  # an aside (in brackets)\n    compiled,\n    rotations as turning,\n)\n",
            "from protocol.rotations import turn\n",
            "from ..body import turn\n",
            "from .. import body\n",
            "try:\n    import protocol.rotations\nexcept ImportError:\n    pass\n",
            "if 1 > 0:\n    import protocol.rotations\n",
            "class Turning:\n    from protocol.rotations import turn\n",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    pass\nelse:\n    import protocol.rotations\n",
        ],
    )
    def test_every_way_to_import_counts(self, tree: Path, imports: str) -> None:
        source_of(tree, "plant_emulator.body").write_text("from protocol.rotations import turn\n")
        source_of(tree, MODULE).write_text(imports)
        assert MODULE in changed_by(tree, "protocol.rotations")

    @pytest.mark.parametrize(
        "imports",
        [
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import protocol.rotations\n",
            "import typing\nif typing.TYPE_CHECKING:\n    import protocol.rotations\n",
            "def later() -> None:\n    import protocol.rotations\n",
            '"""\nimport protocol.rotations\n"""\n',
            "import protocol.rotations of a source half written\n",
        ],
    )
    def test_what_loading_a_module_does_not_import_does_not_count(self, tree: Path, imports: str) -> None:
        source_of(tree, MODULE).write_text(imports)
        assert MODULE not in changed_by(tree, "protocol.rotations")

    def test_equal_sources_in_two_packages_import_what_lies_beside_each(self, tree: Path) -> None:
        for package in ("controller", "plant_emulator"):
            source_of(tree, f"{package}.near").write_text("from . import beside\n")
            source_of(tree, f"{package}.beside").write_text("")
        near = dict.fromkeys(("controller.near", "plant_emulator.near"), "")
        assert changed_by(tree, "controller.beside", near) == {"controller.near"}
        assert changed_by(tree, "plant_emulator.beside", near) == {"plant_emulator.near"}

    @settings(max_examples=25)
    @given(
        edges=st.sets(st.tuples(st.integers(0, 7), st.integers(0, 7)), max_size=16),
        edited=st.integers(0, 7),
    )
    def test_of_any_graph_of_imports(self, edges: set[tuple[int, int]], edited: int) -> None:
        """Circles too: the modules that change are those from which the edited one is reached."""
        packages = ours.PACKAGES
        names = [f"{packages[k % len(packages)]}.inner.module{k}" for k in range(8)]
        sources = {
            name: "".join(f"import {names[there]}\n" for here, there in sorted(edges) if here == k)
            for k, name in enumerate(names)
        }
        reach = {edited}
        for _ in names:
            reach |= {here for here, there in edges if there in reach}
        with tempfile.TemporaryDirectory() as root, pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_CACHE_HOME", f"{root}/cache")
            tree = make_tree(Path(root) / "tree", sources)
            assert changed_by(tree, names[edited], sources) == {names[k] for k in reach}

    @pytest.mark.parametrize("library", ["numba", "llvmlite", "numpy"])
    def test_another_compiler_gives_another_folder(
        self, tree: Path, library: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        before = load(tree).kernel_folder(MODULE)
        cache = load(tree)
        monkeypatch.setattr(cache, "version", lambda name: "0.0.0" if name == library else version(name))
        assert cache.kernel_folder(MODULE) != before

    def test_another_processor_or_setting_of_numba_gives_another_folder(
        self, tree: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        found = [load(tree).kernel_folder(MODULE)]
        cache = load(tree)
        monkeypatch.setattr(cache, "_processor", lambda: ["model name : another"])
        found.append(cache.kernel_folder(MODULE))
        monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
        found.append(load(tree).kernel_folder(MODULE))
        assert len(set(found)) == 3

    def test_a_module_outside_the_project_counts_its_neighbours(self, tree: Path, tmp_path: Path) -> None:
        package, alone = tmp_path / "plugin", tmp_path / "scripts"
        for folder in (package / "deep", alone):
            folder.mkdir(parents=True)
        (package / "__init__.py").write_text("from plugin import helper\n")
        (package / "deep" / "law.py").write_text("from plugin import helper\n")
        (package / "helper.py").touch()
        (alone / "fly.py").write_text("import helper\nfrom protocol.rotations import turn\n")
        (alone / "helper.py").touch()

        def key(module: str, file: Path) -> Path:
            return Path(load(tree).kernel_folder(module, str(file)))

        for module, file, edited in (
            ("plugin.deep.law", package / "deep" / "law.py", package / "helper.py"),
            ("plugin", package / "__init__.py", package / "helper.py"),
            ("fly", alone / "fly.py", alone / "helper.py"),
            ("__main__", alone / "fly.py", alone / "helper.py"),
            ("__main__", alone / "fly.py", alone / "fly.py"),
            ("fly", alone / "fly.py", source_of(tree, "protocol.rotations")),
        ):
            before = key(module, file)
            edited.write_text(edited.read_text() + "# an edit\n")
            assert key(module, file) != before, (module, edited)


KERNEL_MODULES = sorted(
    ".".join(source.relative_to(ROOT).with_suffix("").parts)
    for package in ours.PACKAGES
    for source in (ROOT / package).rglob("*.py")
    if "\n@compiled" in source.read_text(encoding="utf-8")
)


@pytest.fixture(scope="module")
def loaded() -> dict[str, set[str]]:
    """For each of our modules with kernels, the modules of the project that importing it loads, as Python sees it."""
    program = """
import importlib, json, sys
loaded = {}
for module in sys.argv[1:]:
    for name in [name for name in sys.modules if name.startswith(("protocol", "bridge", "controller", "plant_", "fwav_"))]:
        del sys.modules[name]
    importlib.import_module(module)
    loaded[module] = list(sys.modules)
print(json.dumps(loaded))
"""
    said = subprocess.run([sys.executable, "-c", program, *KERNEL_MODULES], check=True, capture_output=True, cwd=ROOT)
    return {module: set(names) for module, names in json.loads(said.stdout).items()}


@pytest.mark.parametrize(
    "edited", ["fwav_hil.cli", "protocol.rotations", "protocol.errors", "plant_emulator.plant.backlash"]
)
def test_an_edit_of_ours_recompiles_what_python_would_load_it_for(
    edited: str, loaded: dict[str, set[str]], places: Path
) -> None:
    for package in ours.PACKAGES:
        shutil.copytree(ROOT / package, places / "tree" / package, ignore=shutil.ignore_patterns("__pycache__"))
    expected = {module for module, names in loaded.items() if edited in names}
    assert changed_by(places / "tree", edited, dict.fromkeys(KERNEL_MODULES, "")) == expected
    assert expected or edited == "fwav_hil.cli"


class TestPlace:
    # A file where a folder must be: that stops root, too, under whom tests may run.
    def test_where_the_users_cache_cannot_be_written_the_temporary_place_serves(self, tree: Path, places: Path) -> None:
        (places / "cache").write_text("in the way")
        folder = load(tree).kernel_folder(MODULE)
        assert folder.is_dir()
        assert folder.is_relative_to(places / "temporary" / f"fwav-hil-{os.geteuid()}")
        assert load(tree).kernel_folder(MODULE) == folder

    def test_a_cache_that_may_be_read_only_is_passed_over(
        self, tree: Path, places: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def allows(path: Path, mode: int) -> bool:
            return not (mode & os.W_OK and path.is_relative_to(places / "cache"))

        monkeypatch.setattr(os, "access", allows)
        assert load(tree).kernel_folder(MODULE).is_relative_to(places / "temporary")

    def test_where_nothing_lasts_a_folder_serves_that_ends_with_the_process(self, tree: Path, places: Path) -> None:
        (places / "cache").write_text("in the way")
        (places / "temporary" / f"fwav-hil-{os.geteuid()}").write_text("in the way")
        program = "from protocol.kernel_cache import *; print(kernel_folder('protocol.rotations').is_dir(), end=' ')"
        program += "; mark_warm('protocol'); print(kernels_are_warm('protocol'), kernel_folder('protocol.rotations'))"
        said = subprocess.run(
            [sys.executable, "-c", program], cwd=tree, env=os.environ | {"TMPDIR": str(places / "temporary")},
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        is_dir, is_warm, folder = said.stdout.split()
        assert (is_dir, is_warm) == ("True", "True")
        assert Path(folder).is_relative_to(places / "temporary")
        assert not Path(folder).exists()
        assert len(list((places / "temporary").iterdir())) == 1


class TestTrust:
    """What lies in the cache is run: a folder into which somebody else can have put something is not used."""

    @pytest.mark.parametrize("place", ["cache", "temporary"])
    @pytest.mark.parametrize("level", [0, 1, 2])
    @pytest.mark.parametrize("mode", [0o777, 0o775])
    def test_a_folder_that_others_may_write_to_is_refused(
        self, tree: Path, places: Path, place: str, level: int, mode: int
    ) -> None:
        if place == "temporary":
            (places / "cache").write_text("in the way")
        folder = load(tree).kernel_folder(MODULE)
        [folder, *folder.parents][level].chmod(mode)
        (folder / "planted.nbi").touch()
        assert not (load(tree).kernel_folder(MODULE) / "planted.nbi").exists()

    @pytest.mark.parametrize("level", [0, 1, 2])
    def test_a_folder_of_another_user_is_refused(
        self, tree: Path, places: Path, level: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """In the temporary place anyone can make a folder of the name that ours would have."""
        (places / "cache").write_text("in the way")
        folder = load(tree).kernel_folder(MODULE)
        (folder / "planted.nbi").touch()
        theirs = [folder, *folder.parents][level]
        true_owner = Path.lstat

        def lstat(path: Path) -> os.stat_result:
            status = list(true_owner(path))
            if path == theirs:
                status[4] += 1
            return os.stat_result(status)

        monkeypatch.setattr(Path, "lstat", lstat)
        found = load(tree).kernel_folder(MODULE)
        assert found.is_dir()
        assert not (found / "planted.nbi").exists()

    def test_a_link_is_refused(self, tree: Path, places: Path) -> None:
        (places / "cache").mkdir()
        (places / "elsewhere").mkdir()
        (places / "cache" / "fwav-hil").symlink_to(places / "elsewhere")
        assert load(tree).kernel_folder(MODULE).is_relative_to(places / "temporary")

    def test_what_it_makes_nobody_else_can_write_to(self, tree: Path, places: Path) -> None:
        before = os.umask(0)
        try:
            load(tree).kernel_folder(MODULE)
        finally:
            os.umask(before)
        made = [folder for folder in (places / "cache" / "fwav-hil").rglob("*") if folder.is_dir()]
        assert len(made) == 2
        assert all(folder.stat().st_mode & 0o777 == 0o700 for folder in made)


class TestTidying:
    def test_of_each_module_the_folders_used_last_are_kept_and_the_older_ones_go(self, tree: Path) -> None:
        compiled = load(tree).kernel_folder("plant_emulator.tick").parent
        ages = range(1, 2 * ours._KEPT_FOLDERS)
        for age in ages:
            for module in (MODULE, "protocol.rotations"):
                old = compiled / f"{module}-used-{age}-days-ago"
                old.mkdir()
                (old / "kernel.nbi").touch()
                os.utime(old, (10**9 - 86400 * age,) * 2)
        current = load(tree).kernel_folder(MODULE)
        assert {folder.name for folder in compiled.glob(f"{MODULE}-*")} == {
            current.name,
            *(f"{MODULE}-used-{age}-days-ago" for age in ages[: ours._KEPT_FOLDERS - 1]),
        }
        assert len(list(compiled.glob("protocol.rotations-*"))) == len(ages), "nobody has asked for a folder of theirs"

    def test_using_a_folder_makes_it_young_again(self, tree: Path) -> None:
        folder = load(tree).kernel_folder(MODULE)
        os.utime(folder, (1, 1))
        assert load(tree).kernel_folder(MODULE) == folder
        assert folder.stat().st_mtime > 10**9

    def test_a_folder_that_vanishes_meanwhile_is_no_error(self, tree: Path) -> None:
        # The process at the other end starts at the same moment and tidies up as well: what was listed is not there.
        compiled = load(tree).kernel_folder("plant_emulator.tick").parent
        (compiled / f"{MODULE}-gone").symlink_to(compiled / "nowhere")
        assert load(tree).kernel_folder(MODULE).is_dir()


class TestWarmth:
    def test_it_is_lost_by_an_edit_of_what_the_packages_import_and_by_no_other(self, tree: Path) -> None:
        def edit(module: str) -> None:
            source_of(tree, module).write_text(source_of(tree, module).read_text() + "# an edit\n")

        ends = ("controller", "plant_emulator")
        assert not load(tree).kernels_are_warm(*ends)
        load(tree).mark_warm(*ends)
        assert load(tree).kernels_are_warm(*ends)
        assert not load(tree).kernels_are_warm("protocol"), "each start needs kernels of its own"
        for module in ("fwav_hil.cli", "controller.process"):
            edit(module)
            assert load(tree).kernels_are_warm(*ends), "no kernel is in it, and none imports it"
        edit("protocol.rotations")
        assert not load(tree).kernels_are_warm(*ends)

    def test_it_goes_with_the_kernels(self, tree: Path) -> None:
        load(tree).mark_warm("controller")
        shutil.rmtree(load(tree).kernel_folder("controller.laws.law"))
        assert not load(tree).kernels_are_warm("controller")

    def test_a_full_disk_is_no_error(self, tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(*_: object, **__: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(Path, "touch", full)
        monkeypatch.setattr(Path, "write_bytes", full)
        load(tree).mark_warm("controller")
        assert not load(tree).kernels_are_warm("controller")

    @pytest.mark.usefixtures("places")
    def test_all_modules_with_kernels_of_ours_are_known(self) -> None:
        marked = {mark.parent.name.rpartition("-")[0] for mark in load(ROOT)._marks(ours.PACKAGES)}
        assert set(KERNEL_MODULES) <= marked


@pytest.mark.parametrize("damage", [b"", b"{", b"[1]", b'{"a": 1}', b"\xff"])
def test_what_is_remembered_of_imports_may_be_damaged(tree: Path, damage: bytes) -> None:
    before = folders(tree)
    (remembered,) = next(iter(before.values())).parent.glob("*.json")
    remembered.write_bytes(damage)
    assert folders(tree) == before
    assert json.loads(remembered.read_bytes())


def test_a_source_is_parsed_once(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parsing all of ours costs a third of a second: at a start nothing is parsed, after an edit what was edited."""
    parsed: list[str] = []

    def noted(cache: object) -> Callable[[str, bytes], list[str]]:
        imported = cache._imported  # type: ignore[attr-defined]

        def note(package: str, source: bytes) -> list[str]:
            parsed.append(package)
            return list(imported(package, source))

        return note

    for expected in (None, [], ["fwav_hil"]):
        cache = load(tree)
        monkeypatch.setattr(cache, "_imported", noted(cache))
        parsed.clear()
        cache.kernel_folder(MODULE)
        assert expected is None or parsed == expected
        if expected == []:
            source_of(tree, "fwav_hil.cli").write_text("import protocol\n")


def test_to_know_whether_the_kernels_are_there_loads_neither_numba_nor_numpy() -> None:
    program = "import sys; from protocol.kernel_cache import kernels_are_warm as warm; warm('controller'); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout.split()
    assert "protocol.kernel_cache" in loaded
    assert not {"numba", "numpy"} & set(loaded)
