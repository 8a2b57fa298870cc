"""Where exports and plots go: files whose names are safe, which replace nothing and appear only once they are whole."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from protocol.errors import RunFolderError
from protocol.logs.names import distinct

_UNSAFE = re.compile(r"[^A-Za-z0-9_.-]|^[.-]")
_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_LONGEST = 120


def file_names(names: Collection[str], taken: Collection[str] = ()) -> dict[str, str]:
    """A file name (without its suffix) for each message of a log, whatever the message is called: safe, and no two
    alike, not even where upper and lower case are the same.

    Letters, digits, `_`, `-` and `.` stay, so that a name never leads out of a folder; the rest becomes `_`.
    """
    safe = (_UNSAFE.sub("_", name)[:_LONGEST] or "_" for name in names)
    usable = (f"_{name}" if _DEVICE.fullmatch(name) else name for name in safe)
    return dict(zip(names, distinct(usable, taken, str.casefold), strict=True))


@contextmanager
def whole(out: Path) -> Iterator[Path]:
    """A name to write to, a file or a folder; it becomes `out` at the end, or is removed.

    Raises RunFolderError where `out` is there already, even if it came meanwhile, or cannot be written.
    """
    if os.path.lexists(out):
        raise RunFolderError(f"{out} is there already and stays: choose another place with --out")
    try:
        with tempfile.TemporaryDirectory(prefix=".fwav-hil-", dir=out.parent, ignore_cleanup_errors=True) as folder:
            partial = Path(folder) / "whole"
            yield partial
            _move(partial, out)
    except OSError as error:
        raise RunFolderError(f"cannot write {out}: {error.strerror or error}") from None


def _move(partial: Path, out: Path) -> None:
    """Give `partial` its final name. Raises OSError where something has that name by now."""
    if partial.is_dir():
        out.mkdir()
        partial.replace(out)  # which the system does for an empty folder only
        return
    try:
        os.link(partial, out)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        out.open("xb").close()
        partial.replace(out)
