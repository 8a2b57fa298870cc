"""Small logs that once were read wrong, each in a folder of its own, for the tests of the readers."""

from pathlib import Path

FOLDER = Path(__file__).parent


def case(name: str) -> Path:
    """The file of a case: `folder/file`."""
    return FOLDER / name
