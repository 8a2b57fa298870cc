"""Where commands go: what every sink does, whatever it speaks."""

from __future__ import annotations

import abc

from controller.laws.law import Law, LawState
from protocol.messages import FloatArray


class CommandSink(abc.ABC):
    """Carries what a law asks for to the actuators, and has the law advance with what will really act of it.

    A sink that limits in Python calls `Law.output`, puts its own limits on that, and gives what is left to `Law.advance`.
    """

    @abc.abstractmethod
    def answer(self, law: Law, state: LawState, t_ns: int, q: FloatArray, *, armed: bool) -> bytes:
        """Step the law on the sample q (6,) of time t_ns; returns the frames of the command."""
