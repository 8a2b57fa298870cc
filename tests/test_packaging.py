"""What pyproject.toml declares is what the packages import, and constraints.txt pins all of it."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from bridge.extras import EXTRAS
from protocol.kernel_cache import PACKAGES

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OF_ANOTHER_ENVIRONMENT = {ROOT / "tests" / "mutants.py"}
"""cosmic-ray is not part of what `make test` installs."""
OURS = {*PACKAGES, "tests", "benchmarks"}


def distribution(requirement: str) -> str:
    """The name in a requirement as pip compares it: "tomli-w" of "tomli_w[extra]>=1"."""
    name = re.match(r"[\w.-]+", requirement)
    assert name, requirement
    return re.sub(r"[-_.]+", "-", name[0]).lower()


BASE = {distribution(requirement) for requirement in PROJECT["dependencies"]}
OF_EXTRA = {
    extra: {distribution(requirement) for requirement in requirements}
    for extra, requirements in PROJECT["optional-dependencies"].items()
}
DECLARED = BASE.union(*OF_EXTRA.values())
BROUGHT_BY = {
    module: {distribution(name) for name in names} for module, names in metadata.packages_distributions().items()
}


def modules_imported(folder: str) -> set[str]:
    """The top-level modules of others that the files of a folder import, wherever in them."""
    found: set[str] = set()
    for source in {*(ROOT / folder).rglob("*.py")} - OF_ANOTHER_ENVIRONMENT:
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                found.add((node.module or "").partition(".")[0])
    return found - OURS - sys.stdlib_module_names


def distributions_imported(*folders: str) -> set[str]:
    """What is imported, by the name it is installed by: of several that share a module, the one declared."""
    modules = set().union(*map(modules_imported, folders))
    return {
        name
        for module in modules
        for name in BROUGHT_BY.get(module, {module}) & DECLARED or BROUGHT_BY.get(module, {module})
    }


def test_the_packages_import_what_is_declared_and_nothing_else() -> None:
    assert distributions_imported(*PACKAGES) == BASE.union(*(OF_EXTRA[extra] for extra in EXTRAS))


def test_tests_and_benchmarks_import_nothing_that_the_makefile_does_not_install() -> None:
    assert distributions_imported("tests", "benchmarks") <= DECLARED
    installed = re.search(r"^EXTRAS := (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert installed
    assert set(installed[1].split(",")) == set(OF_EXTRA) - {"mutants"}  # which `make mutants` installs by itself


@pytest.mark.parametrize("extra", EXTRAS)
def test_an_extra_brings_the_modules_that_are_said_to_be_missing_without_it(extra: str) -> None:
    assert OF_EXTRA[extra] == {name for module in EXTRAS[extra] for name in BROUGHT_BY[module]}
    assert not OF_EXTRA[extra] & BASE


def test_every_library_that_is_installed_is_pinned() -> None:
    """What is declared, and what that needs in turn, at the version installed here."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))
    pinned = {distribution(name): version for name, version in pinned.items()}
    installed = {distribution(found.metadata["Name"]): found.version for found in metadata.distributions()}
    ours_and_pip_itself = {"fwav-hil", "pip", "setuptools", "wheel"}
    assert pinned == {name: version for name, version in installed.items() if name not in ours_and_pip_itself}
