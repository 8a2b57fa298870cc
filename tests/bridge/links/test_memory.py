"""Links inside one process: the contract, and what is their own: meeting by name, the end of the other end."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from itertools import count

import pytest

from bridge.links.link import NOBODY, Link, open_link
from bridge.links.memory import QUEUE_LIMIT, memory_pair
from protocol.errors import LinkClosedError, LinkInUseError
from tests.contracts.link_contract import PATIENCE_S, LinkContract, Pair, receive

_numbers = count()


@pytest.fixture
def uri() -> str:
    """A name no other test has."""
    return f"mem://test-{next(_numbers)}"


@pytest.fixture
def pair() -> Iterator[tuple[Link, Link]]:
    first, second = memory_pair()
    with first, second:
        yield first, second


class TestPairContract(LinkContract):
    @pytest.fixture
    def pair(self) -> Iterator[Pair]:
        first, second = memory_pair()
        with first, second:
            yield first, second


class TestNameContract(LinkContract):
    @pytest.fixture
    def pair(self, uri: str) -> Iterator[Pair]:
        with open_link(uri) as first, open_link(uri) as second:
            yield first, second


def test_a_third_end_is_refused(uri: str) -> None:
    with open_link(uri), open_link(uri), pytest.raises(LinkInUseError, match=f"{uri}: both ends .* are taken.*--link"):
        open_link(uri)


def test_a_name_is_free_once_both_ends_are_closed(uri: str) -> None:
    with open_link(uri) as second:
        with open_link(uri):
            pass
        with pytest.raises(LinkInUseError):
            open_link(uri)
    with open_link(uri) as first, open_link(uri) as second:
        first.send(b"afresh")
        assert receive(second) == b"afresh"


def test_a_name_is_free_when_its_only_end_is_closed(uri: str) -> None:
    open_link(uri).close()
    with open_link(uri) as first, open_link(uri) as second:
        first.send(b"afresh")
        assert receive(second) == b"afresh"


def test_before_the_other_end_opens_sends_are_dropped_and_counted(uri: str) -> None:
    with open_link(uri) as first:
        assert first.peer == NOBODY
        first.send(b"anyone?")
        assert first.stats.no_peer == 1
        assert first.recv(0) is None
        with open_link(uri) as second:
            assert first.peer == f"{uri} end B"
            assert second.peer == f"{uri} end A"
            assert second.recv(0) is None


def test_pairs_do_not_meet_each_other(pair: Pair) -> None:
    other_first, other_second = memory_pair()
    with other_first, other_second:
        pair[0].send(b"for my own")
        assert other_second.recv(0) is None
        assert receive(pair[1]) == b"for my own"


def test_the_other_end_closed_ends_recv_once_all_is_read(pair: Pair) -> None:
    first, second = pair
    first.send(b"one")
    first.send(b"two")
    first.close()
    assert [receive(second), receive(second)] == [b"one", b"two"]
    for timeout_s in (PATIENCE_S, 0):
        with pytest.raises(LinkClosedError, match="closed by end A"):
            second.recv(timeout_s)
    second.send(b"hello?")
    assert (second.stats.sent, second.stats.send_failed) == (0, 1)


@pytest.mark.parametrize("closer", [0, 1])
def test_closing_either_end_wakes_a_wait(pair: Pair, closer: int) -> None:
    timer = threading.Timer(0.03, pair[closer].close)
    timer.start()
    try:
        with pytest.raises(LinkClosedError):
            pair[0].recv(PATIENCE_S)
    finally:
        timer.join()


def test_a_full_queue_drops_and_counts(pair: Pair) -> None:
    first, second = pair
    for number in range(QUEUE_LIMIT + 2):
        first.send(number.to_bytes(4, "little"))
    assert (first.stats.sent, first.stats.send_failed) == (QUEUE_LIMIT, 2)
    came = [int.from_bytes(receive(second), "little") for _ in range(QUEUE_LIMIT)]
    assert came == list(range(QUEUE_LIMIT))
    assert second.recv(0) is None


def test_many_threads_meet_in_pairs(uri: str) -> None:
    """However opens of one name interleave, exactly two succeed."""
    opened: list[Link] = []
    refused: list[LinkInUseError] = []
    start = threading.Barrier(8)

    def open_one() -> None:
        start.wait(PATIENCE_S)
        try:
            opened.append(open_link(uri))
        except LinkInUseError as error:
            refused.append(error)

    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=open_one) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE_S)
    finally:
        sys.setswitchinterval(interval_s)
    try:
        assert (len(opened), len(refused)) == (2, 6)
        opened[0].send(b"met")
        assert receive(opened[1]) == b"met"
    finally:
        for link in opened:
            link.close()
