"""Kernels as plain Python: a pytest plugin (`-p tests.interpreted`) for the mutation run, which has no time to compile.

numba itself can be told so (NUMBA_DISABLE_JIT), but its structures have fields as attributes and NumPy's do not: here each
kernel's arguments are seen as records, which have.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import Phase, settings

import protocol.compiled


def interpreted(function: Callable[..., Any]) -> Callable[..., Any]:
    """In place of `protocol.compiled.compiled`."""

    @functools.wraps(function)
    def kernel(*arguments: Any) -> Any:
        return function(*[_as_records(one) for one in arguments])

    return kernel


def _as_records(argument: Any) -> Any:
    if type(argument) is np.ndarray and argument.dtype.names:
        return argument.view(np.recarray)
    if type(argument) is np.void and argument.dtype.names:
        return argument.view((np.record, argument.dtype))
    return argument


# Before any module with kernels is loaded, numba's place is taken.
_module: Any = protocol.compiled
_module.compiled = interpreted
_module.inlined = lambda function: function

# One example that fails is enough, the same in each run.
settings.register_profile(
    "mutants", deadline=None, database=None, derandomize=True, phases=(Phase.explicit, Phase.generate)
)
