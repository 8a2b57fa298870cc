"""The tree of errors is the one drawn at the top of its file."""

from __future__ import annotations

import inspect
import re

import pytest

from protocol import errors
from protocol.errors import FwavHilError


def drawn_tree() -> dict[str, tuple[str | None, int]]:
    """Name -> (name of its parent, exit code), from the drawing."""
    tree: dict[str, tuple[str | None, int]] = {}
    above: list[tuple[int, str]] = []  # (column, name) of the branch that leads to the line
    for line in inspect.cleandoc(errors.__doc__ or "").splitlines():
        row = re.fullmatch(r"(?P<lead>[ |\-]*)(?P<name>[A-Z][A-Za-z]+) +(?P<code>\d+)(?: .*)?", line)
        if row:
            column = len(row["lead"])
            above = [(at, name) for at, name in above if at < column]
            tree[row["name"]] = (above[-1][1] if above else None, int(row["code"]))
            above.append((column, row["name"]))
    return tree


def classes() -> dict[str, type[FwavHilError]]:
    return {
        name: member
        for name, member in vars(errors).items()
        if inspect.isclass(member) and issubclass(member, FwavHilError)
    }


DRAWN = drawn_tree()


def test_every_error_is_drawn_and_every_drawn_error_is_there() -> None:
    assert len(DRAWN) >= 2
    assert set(DRAWN) == set(classes())


@pytest.mark.parametrize("name", DRAWN)
def test_parent_and_exit_code_are_as_drawn(name: str) -> None:
    parent, code = DRAWN[name]
    error = classes()[name]
    assert [base.__name__ for base in error.__bases__] == [parent or "Exception"]
    assert error.exit_code == code
    assert error("the place: the remedy").exit_code == code


def test_one_except_clause_catches_them_all() -> None:
    exceptions = {
        name for name, member in vars(errors).items() if isinstance(member, type) and issubclass(member, Exception)
    }
    assert exceptions == set(classes())


def test_no_exit_code_says_success_or_is_one_the_shell_uses_for_itself() -> None:
    codes = {error.exit_code for error in classes().values()} - {130}  # 128 + SIGINT, as of any stopped command
    assert all(0 < code < 126 for code in codes)


def test_each_has_a_purpose_of_its_own() -> None:
    purposes = [error.__dict__.get("__doc__") for error in classes().values()]
    assert all(purposes)
    assert len(set(purposes)) == len(purposes)


@pytest.mark.parametrize("name", DRAWN)
def test_the_message_is_printed_as_it_is(name: str) -> None:
    assert str(classes()[name]("--rate 0: choose a rate above 0")) == "--rate 0: choose a rate above 0"
