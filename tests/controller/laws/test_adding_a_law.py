"""A law added as docs/architecture.md says: one file, one row of the registry, one test class, and nothing else."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np
import pytest

import controller.laws
from bridge.command_line import run_command
from controller.laws import registry
from controller.laws.law import make_law
from controller.laws.registry import LAWS, LawEntry, check_law, refuse_on_a_link
from controller.parameters import Parameters, markdown_table, parameters_of, value_of
from fwav_hil.cli import cli
from fwav_hil.simulate import simulate
from fwav_hil.studies.margin import linear_margins
from protocol.errors import ScenarioError, UsageError
from protocol.scenario import load_scenario, replace_gains, scenario_folder
from protocol.wire.parameter_mapping import Kind, Refusal
from tests.contracts.law_contract import LawContract

PAGE = (Path(__file__).parents[3] / "docs" / "architecture.md").read_text(encoding="utf-8")
FILE, ROW, TEST = re.findall(r"```python\n(.+?)```", PAGE.partition("## To add a law\n")[2], re.DOTALL)
NAME, ENTRY = next(iter(eval(f"{{{ROW}}}", {"LawEntry": LawEntry}).items()))
SHIPPED = {file.stem: load_scenario(file) for file in sorted(scenario_folder().glob("*.toml"))}
DIGESTS = {name: scenario.digest() for name, scenario in SHIPPED.items()}
PARAMETERS = {name: parameters_of(scenario) for name, scenario in SHIPPED.items()}
MINE = msgspec.structs.replace(SHIPPED["flapper"], law="damped")


@pytest.fixture(autouse=True, scope="module")
def added(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The page's file and row, in place for the tests of this module."""
    folder = tmp_path_factory.mktemp("laws")
    (folder / "damped.py").write_text(FILE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(controller.laws, "__path__", [*controller.laws.__path__, str(folder)])
        patch.setattr(registry, "LAWS", MappingProxyType({**LAWS, NAME: ENTRY}))
        yield
    del sys.modules["controller.laws.damped"]


class TestDamped(LawContract):
    name, number = "damped", 6


def test_the_page_has_this_test_class() -> None:
    assert inspect.getsource(TestDamped) == TEST


def test_no_digest_and_no_parameter_of_any_other_scenario_changes() -> None:
    for file in scenario_folder().glob("*.toml"):
        scenario = load_scenario(file)
        refuse_on_a_link(scenario, file)
        assert scenario.digest() == DIGESTS[file.stem]
        assert parameters_of(scenario) == PARAMETERS[file.stem]


def test_a_scenario_that_says_nothing_of_it_flies_it_with_its_defaults() -> None:
    refuse_on_a_link(MINE)
    assert MINE.digest() == DIGESTS["flapper"], "either end may choose the law"
    flown = simulate(MINE)
    assert flown.divergence is None
    said = replace_gains(MINE, "damped", omega=(7.0,) * 6, ratio=1.5, lead=True)
    assert simulate(said).q.tobytes() == flown.q.tobytes()


def test_its_own_table_is_heeded_checked_and_in_the_digest() -> None:
    other = replace_gains(MINE, "damped", ratio=2.0)
    assert not np.array_equal(make_law("damped", other).realisation.D, make_law("damped", MINE).realisation.D)
    assert other.digest() != MINE.digest()
    with pytest.raises(ScenarioError, match=r"flapper: unknown key 'gains\.damped\.rato': did you mean 'ratio'\?"):
        make_law("damped", replace_gains(MINE, "damped", rato=2.0))
    with pytest.raises(ScenarioError, match=r"flapper: unknown key 'gains\.dampd': did you mean 'damped'\?"):
        check_law(replace_gains(SHIPPED["flapper"], "dampd", ratio=2.0))


def test_its_gains_are_parameters_behind_those_there_are_and_can_be_set() -> None:
    table = parameters_of(MINE)
    assert table[: len(PARAMETERS["flapper"])] == PARAMETERS["flapper"]
    own = {one.name: value_of(MINE, one) for one in table[len(PARAMETERS["flapper"]) :]}
    axes = ("X", "Y", "Z", "ROLL", "PITCH", "YAW")
    assert own == {**{f"DAMP_OMEGA_{axis}": 7.0 for axis in axes}, "DAMP_RATIO": 1.5, "DAMP_LEAD": 1.0}
    (index,) = [one for one in table if one.name == "LAW_INDEX"]
    assert value_of(MINE, index) == ENTRY.number

    law = make_law("damped", MINE)
    parameters = Parameters(MINE, lambda changed: law.adopt(make_law("damped", changed)))
    for name, kind, value, refusal in (
        ("DAMP_RATIO", Kind.REAL32, 1.25, None),
        ("DAMP_RATIO", Kind.REAL32, 0.0, Refusal.OUT_OF_RANGE),
        ("DAMP_OMEGA_YAW", Kind.REAL32, 12.0, None),
        ("DAMP_LEAD", Kind.INT32, 2.0, Refusal.OUT_OF_RANGE),
        ("DAMP_LEAD", Kind.INT32, 0.0, None),
    ):
        place = parameters.index(name)
        assert place is not None
        assert parameters.set(place, kind, value, armed=False) is refusal
    changed = {"omega": [7.0, 7.0, 7.0, 7.0, 7.0, 12.0], "ratio": 1.25, "lead": False}
    assert parameters.scenario.gains["damped"] == changed
    expected = make_law("damped", replace_gains(MINE, "damped", **changed))
    assert law.packed.tobytes() == expected.packed.tobytes()
    assert "`gains.damped.ratio`: damping ratio" in "".join(markdown_table(registry.declared_gains(MINE)))


def test_margins_know_it() -> None:
    assert all(margin.stable for margin in linear_margins(MINE).values())


def test_the_command_line_knows_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, bad = tmp_path / "good.toml", tmp_path / "bad.toml"
    for file, ratio in ((good, 1.25), (bad, -1.0)):
        file.write_text(replace_gains(MINE, "damped", ratio=ratio).to_toml(), encoding="utf-8")
    assert run_command(cli, "fwav-hil", ["simulate", str(good), "--duration", "0.5"]) == 0
    capsys.readouterr()
    assert run_command(cli, "fwav-hil", ["run", str(bad)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"fwav-hil: {bad}, gains.damped.ratio: expected float > 0.0: change this value"


def test_a_law_there_is_not_is_answered_with_it_too() -> None:
    with pytest.raises(UsageError, match=r"choose one of ude, .*, damped"):
        make_law("lqr", MINE)
