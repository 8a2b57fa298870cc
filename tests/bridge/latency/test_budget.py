"""What fits a link: sizes of real frames, sums, and the refusal that says what does fit."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.command_line import refuse_rate_that_cannot_fit
from bridge.latency.budget import frame_bytes, link_budget
from bridge.links.memory import memory_pair
from controller.parameters import parameters_of
from protocol.errors import LinkUriError, UsageError
from protocol.wire.streams import STREAMS
from tests.loop import fly_both, scenario_of

SERIAL = "serial:///dev/ttyUSB0:921600"


def test_a_tick_is_126_bytes_one_way_and_93_the_other() -> None:
    """The contract's own figures."""
    there, back = link_budget(SERIAL, 500.0).ways
    assert (there.tick_bytes, back.tick_bytes) == (126, 93)


def test_every_message_of_the_contract_has_a_size() -> None:
    for row in STREAMS:
        assert 12 < frame_bytes(row.message) <= 280


def test_500_hz_fit_921600_baud_and_1_khz_do_not() -> None:
    fits = link_budget(SERIAL, 500.0)
    assert fits.fits
    assert [way.capacity_bytes_per_s for way in fits.ways] == [92160.0] * 2
    assert fits.ways[0].share == pytest.approx((500 * 126 + 21 + 28 + 10 * 48) / 92160)
    assert fits.ways[1].share == pytest.approx((500 * 93 + 21 + 28 + 50 * (63 + 49)) / 92160)
    assert not link_budget(SERIAL, 1000.0).fits
    assert link_budget(SERIAL, 1000.0).highest_rate_hz == (92160 - 529) // 126


def test_the_delay_is_the_bytes_of_the_tick_and_of_the_command() -> None:
    budget = link_budget("serial:///dev/ttyS0:921600", 500.0)
    assert [hop.delay_s for hop in budget.hops] == pytest.approx([126 * 10 / 921600, 93 * 10 / 921600])
    assert budget.delay_s == pytest.approx(219 * 10 / 921600)
    assert budget.delay_periods == pytest.approx(500 * budget.delay_s)
    assert len(link_budget(SERIAL, 500.0).hops) == 4, "a USB adapter holds bytes at each end"


@given(st.integers(300, 5_000_000), st.integers(1, 4000))
def test_the_highest_rate_fits_and_the_next_does_not(baud: int, rate_hz: int) -> None:
    uri = f"serial:///dev/ttyS0:{baud}"
    highest = link_budget(uri, rate_hz).highest_rate_hz
    assert link_budget(uri, rate_hz).fits == (rate_hz <= highest)
    assert not link_budget(uri, highest + 1).fits
    if highest > 0:
        assert link_budget(uri, highest).fits


@pytest.mark.parametrize("uri", ["udpin://127.0.0.1:1", "tcpout://localhost:1", "mem://x", "udpout://10.0.0.1:1"])
def test_a_network_refuses_nothing_sane(uri: str) -> None:
    assert link_budget(uri, 2000.0).fits
    refuse_rate_that_cannot_fit(uri, 1e9)


def test_datagrams_cost_their_headers_and_memory_none() -> None:
    assert link_budget("udpin://10.0.0.1:1", 100.0).ways[0].overhead_bytes_per_s == 100 * (38 + 28)
    assert link_budget("mem://x", 100.0).ways[0].overhead_bytes_per_s == 0


@pytest.mark.parametrize(
    ("uri", "rate_hz", "words"),
    [
        (SERIAL, 1000.0, "1000 Hz does not fit .* up to 727 Hz fit, so choose --rate 625, or 1500000 baud or more"),
        ("serial:///dev/ttyS0:9600", 250.0, "up to 4 Hz fit, so choose --rate 4"),
        ("serial:///dev/ttyS0:600", 250.0, "no rate fits, so choose a faster link"),
    ],
)
def test_a_refusal_says_what_does_fit(uri: str, rate_hz: float, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        refuse_rate_that_cannot_fit(uri, rate_hz)


def test_what_is_no_link_is_said() -> None:
    with pytest.raises(LinkUriError):
        link_budget("smoke://signals", 1.0)


def test_a_run_sends_what_the_budget_says() -> None:
    """Two seconds in lockstep; what is said once, at the start and at the end, is the rest."""
    scenario = scenario_of("flapper", duration_s=2.0)
    near, far = memory_pair()
    with near, far:
        fly_both(scenario, near, far)
        sent = near.stats.sent_bytes, far.stats.sent_bytes
    parameters = len(parameters_of(scenario)) * frame_bytes("PARAM_VALUE")
    for way, total, once in zip(link_budget("mem://x", scenario.rate_hz).ways, sent, (0, parameters), strict=True):
        assert 0 <= total - 2.0 * way.bytes_per_s - once < 1500, way.name
