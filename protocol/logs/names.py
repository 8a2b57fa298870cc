"""Names that a log brings along, made fit for use: without control characters, none empty, no two alike."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable


def readable(text: bytes | str, instead: str = "unnamed") -> str:
    """The text up to its first zero byte, what cannot be shown replaced by `_`; `instead` where nothing is left."""
    decoded = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
    shown = "".join(letter if letter.isprintable() else "_" for letter in decoded.partition("\0")[0])
    return shown.strip() or instead


def distinct(names: Iterable[str], taken: Collection[str] = (), key: Callable[[str], str] = str) -> list[str]:
    """The names in their order; one that is taken, or came before, gets _2, _3 ... Alike are two of the same `key`.

    A name with such a number never takes that of another which has it from the beginning.
    """
    asked = list(names)
    used = {key(name) for name in taken}
    own = used | {key(name) for name in asked}
    last: dict[str, int] = {}
    made = []
    for name in asked:
        free = name
        while key(free) in used or (free != name and key(free) in own):
            last[key(name)] = last.get(key(name), 1) + 1
            free = f"{name}_{last[key(name)]}"
        used.add(key(free))
        made.append(free)
    return made
