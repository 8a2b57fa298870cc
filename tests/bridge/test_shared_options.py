"""Which scenario a command gets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from bridge.shared_options import ScenarioChoice as choice
from protocol.errors import ScenarioError
from protocol.scenario import find_scenario, load_scenario


class TestScenarioChoice:
    def test_by_name_and_by_path_it_is_the_same(self) -> None:
        path = find_scenario("flapper")
        assert choice().load() == choice(scenario=str(path)).load() == load_scenario(path)

    def test_what_the_command_line_says_replaces_and_none_does_not(self) -> None:
        plain = choice().load()
        chosen = choice(rate_hz=500.0, seed=7).load()
        assert (chosen.rate_hz, chosen.seed) == (500.0, 7)
        assert (chosen.law, chosen.duration_s, chosen.body) == (plain.law, plain.duration_s, plain.body)

    def test_an_unknown_name_is_refused_with_those_there_are(self) -> None:
        with pytest.raises(ScenarioError, match="there is no scenario flaper: give a file, or one of flapper, paper"):
            choice(scenario="flaper").load()

    @pytest.mark.parametrize(
        ("overrides", "place"),
        [
            ({"rate_hz": -1.0}, "the command line, rate_hz: "),
            ({"rate_hz": float("nan")}, "the command line, rate_hz: "),
            ({"rate_hz": 333.0}, "the command line: rate_hz 333 "),
            ({"duration_s": 0.0}, "the command line, duration_s: "),
            ({"duration_s": 1e-6}, "the command line: duration_s 1e-06 "),
            ({"seed": -1}, "the command line, seed: "),
        ],
    )
    def test_what_makes_no_sense_is_blamed_on_the_command_line(self, overrides: dict[str, Any], place: str) -> None:
        with pytest.raises(ScenarioError) as caught:
            choice(**overrides).load()
        assert str(caught.value).startswith(place)

    def test_a_mistake_in_a_file_is_blamed_on_the_file(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.toml"
        path.write_text(find_scenario("flapper").read_text(encoding="utf-8").replace("mass =", "mas ="))
        with pytest.raises(ScenarioError) as caught:
            choice(scenario=str(path)).load()
        assert str(caught.value) == f"{path}: unknown key 'body.mas': did you mean 'mass'?"
