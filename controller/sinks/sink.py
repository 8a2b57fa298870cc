"""Where commands go: the interface of every sink."""

from __future__ import annotations

import abc

from controller.laws.law import Law, LawState
from protocol.messages import FloatArray


class CommandSink(abc.ABC):
    """Sends a law's command to the actuators, and advances the law with the part of it that will really act.

    A sink that limits in Python calls `Law.output`, applies its own limits, and passes the limited command to `Law.advance`.
    """

    @abc.abstractmethod
    def answer(self, law: Law, state: LawState, t_ns: int, q: FloatArray, *, armed: bool) -> bytes:
        """Step the law on the sample q (6,) of time t_ns; returns the frames of the command."""
