"""The README is true: its message table is the code's, its files exist, its commands are commands."""

from __future__ import annotations

import re
from pathlib import Path

import click
import pytest

from fwav_hil.cli import COMMANDS, cli
from protocol.scenario import find_scenario
from protocol.wire.streams import markdown_table

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_the_message_table_is_the_one_of_the_code() -> None:
    assert "\n".join(markdown_table()) in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_a_page_exists(page: Path) -> None:
    for name, scenario in re.findall(
        r"^ {4}fwav-hil (\w+) +([^\s#]\S*)?", page.read_text(encoding="utf-8"), re.MULTILINE
    ):
        assert name in COMMANDS
        command = cli.get_command(click.Context(cli), name)
        if isinstance(command, click.Group):
            assert scenario in command.commands
        elif scenario and not scenario.startswith(("-", "runs/")):
            assert find_scenario(scenario).exists()
