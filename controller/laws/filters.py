"""The table [gains.filters], common to the laws that estimate u_d and differentiate the error: see `discretise`."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from controller.laws.gains import LinkParameter
from protocol.scenario import Positive6, Table


class StateFeedbackFilters(Table, frozen=True):
    """Time T and order of G_f (18), a Butterworth filter, and the pole N of the derivative D(s) = N s/(s + N)."""

    T: Annotated[Positive6, LinkParameter("LAW_T", "time of the filter G_f, s")]
    N: Annotated[Positive6, LinkParameter("LAW_N", "pole of the derivative, rad/s")]
    order: Annotated[int, Meta(ge=1, le=6), LinkParameter("LAW_ORDER", "order of the filter G_f", settable=False)]


class Filters(StateFeedbackFilters, frozen=True):
    """The same for output feedback, which differentiates G_f twice (see the paper, below (21))."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.order < 2:
            raise ValueError(
                f"output feedback needs a filter of order 2 or more, but order is {self.order}: set order = 2"
            )
