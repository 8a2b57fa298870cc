"""The MAVLink parameter protocol for one peer: list, read, set. Source: the MAVLink guide on it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from protocol.wire import parameter_mapping
from protocol.wire.codec import Frame
from protocol.wire.parameter_mapping import Refusal, Wanted
from protocol.wire.schedule import Saying

BURST = 16
"""Values of a list that are sent at once."""


class ParameterTable(Protocol):
    """The parameters of a component by index; implemented by `controller.parameters.Parameters`."""

    @property
    def table(self) -> Sequence[Any]:
        """One item per parameter."""

    @property
    def counters(self) -> dict[str, int]:
        """Counters, with parameters_set and parameters_refused."""

    def index(self, name: str) -> int | None:
        """The index of a name, or None."""

    def saying(self, index: int) -> Saying:
        """PARAM_VALUE with a parameter's present value."""

    def set(self, index: int, kind: int, value: float, *, armed: bool) -> Refusal | None:
        """Set a parameter; None where it now has the value, else the reason for the refusal."""


class ParameterServer:
    """Answers a peer's PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET to `who`, our (system, component).

    is_armed: whether sets must be refused. on_change: called with the index of a changed parameter.
    """

    def __init__(
        self,
        parameters: ParameterTable,
        who: tuple[int, int],
        is_armed: Callable[[], bool],
        on_change: Callable[[int], None],
    ) -> None:
        self._parameters = parameters
        self._who = who
        self._is_armed = is_armed
        self._on_change = on_change
        self._listing: deque[int] = deque()
        self._answers: list[Saying] = []
        self._handlers = {
            parameter_mapping.LIST.message_id: (parameter_mapping.decode_list, self._list),
            parameter_mapping.READ.message_id: (parameter_mapping.decode_read, self._read),
            parameter_mapping.SET.message_id: (parameter_mapping.decode_set, self._set),
        }

    def handle(self, frame: Frame) -> bool:
        """Handle a frame of the protocol; whether it was one for this vehicle."""
        if frame.message_id not in self._handlers:
            return False
        decode, handler = self._handlers[frame.message_id]
        wanted = decode(frame.payload)
        system, component = wanted.target
        if system not in (0, self._who[0]) or component not in (0, self._who[1]):
            return False
        handler(wanted, (frame.system, frame.component))
        return True

    def due(self) -> list[Saying]:
        """Messages to send now: answers, and the next values of a list."""
        sayings, self._answers = self._answers, []
        for _ in range(min(BURST, len(self._listing))):
            sayings.append(self._parameters.saying(self._listing.popleft()))
        return sayings

    def _list(self, _wanted: Wanted, _asker: tuple[int, int]) -> None:
        self._listing = deque(range(len(self._parameters.table)))

    def _read(self, wanted: Wanted, asker: tuple[int, int]) -> None:
        index = self._find(wanted)
        if index is None:
            self._refuse(wanted, asker, Refusal.UNKNOWN)
        else:
            self._answers.append(self._parameters.saying(index))

    def _set(self, wanted: Wanted, asker: tuple[int, int]) -> None:
        index = self._find(wanted)
        if index is None:
            self._refuse(wanted, asker, Refusal.UNKNOWN)
            return
        before = self._parameters.counters["parameters_set"]
        refusal: Refusal | None = Refusal.OUT_OF_RANGE
        if wanted.value is not None:
            refusal = self._parameters.set(index, wanted.kind, wanted.value, armed=self._is_armed())
        if refusal:
            # Sent before the value: a station that supports PARAM_ERROR then need not retry because of the old value.
            self._refuse(wanted, asker, refusal)
        self._answers.append(self._parameters.saying(index))
        if not refusal and self._parameters.counters["parameters_set"] > before:
            self._on_change(index)

    def _find(self, wanted: Wanted) -> int | None:
        if wanted.name:
            return self._parameters.index(wanted.name)
        return wanted.number if 0 <= wanted.number < len(self._parameters.table) else None

    def _refuse(self, wanted: Wanted, asker: tuple[int, int], refusal: Refusal) -> None:
        self._parameters.counters["parameters_refused"] += 1
        payload = parameter_mapping.encode_error(asker, wanted.name, wanted.number, refusal)
        self._answers.append((parameter_mapping.ERROR, payload))
