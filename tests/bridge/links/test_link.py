"""Link URIs, the registry and the counters."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.links.link import LINKS, LinkStats, LinkUri, Medium, counterpart, open_link, parse_link_uri
from protocol.errors import LinkUriError

GOOD = {
    "udpin://127.0.0.1:14560": {"host": "127.0.0.1", "port": 14560},
    "udpout://sim.local:1": {"host": "sim.local", "port": 1},
    "udpin://:14560": {"host": "127.0.0.1", "port": 14560},
    "udpin://127.0.0.1:0": {"host": "127.0.0.1", "port": 0},
    "udpin://0.0.0.0:65535": {"host": "0.0.0.0", "port": 65535},
    "tcpin://:0": {"host": "127.0.0.1", "port": 0},
    "tcpin://[::1]:4560": {"host": "::1", "port": 4560},
    "tcpout://[fe80::1%eth0]:4560": {"host": "fe80::1%eth0", "port": 4560},
    "serial:///dev/ttyUSB0:921600": {"path": "/dev/ttyUSB0", "baud": 921600},
    "serial:///dev/serial/by-path/pci-0000:00:14.0-usb-0:1:57600": {
        "path": "/dev/serial/by-path/pci-0000:00:14.0-usb-0:1",
        "baud": 57600,
    },
    "mem://loop": {"name": "loop"},
    "mem://run-1.a_b": {"name": "run-1.a_b"},
}

BAD = {  # URI -> (what the message says is wrong, a URI it proposes)
    "": ("must begin with", "udpin://127.0.0.1:14560"),
    "udpin": ("must begin with", "udpin://127.0.0.1:14560"),
    "127.0.0.1:14560": ("must begin with", "udpin://127.0.0.1:14560"),
    "udp://127.0.0.1:14560": ("must begin with", "udpin://127.0.0.1:14560"),
    "UDPIN://127.0.0.1:14560": ("must begin with", "udpin://127.0.0.1:14560"),
    "udpin:/127.0.0.1:14560": ("must begin with", "udpin://127.0.0.1:14560"),
    "udpin://": ("port is missing", "udpin://127.0.0.1:14560"),
    "udpout://10.0.0.7": ("port is missing", "udpout://10.0.0.7:14560"),
    "udpout://10.0.0.7:": ("port is missing", "udpout://10.0.0.7:14560"),
    "tcpin://127.0.0.1": ("port is missing", "tcpin://127.0.0.1:4560"),
    "tcpout://[::1]": ("port is missing", "tcpout://[::1]:4560"),
    "udpin://127.0.0.1:http": ("'http'", "udpin://127.0.0.1:14560"),
    "udpin://127.0.0.1:65536": ("'65536'", "udpin://127.0.0.1:14560"),
    "udpin://127.0.0.1:-1": ("'-1'", "udpin://127.0.0.1:14560"),
    "udpin://127.0.0.1:1456²": ("whole number", "udpin://127.0.0.1:14560"),
    "udpin://127.0.0.1:" + "9" * 5000: ("whole number", "udpin://127.0.0.1:14560"),
    "udpin://127.0.0.1:14560/": ("'14560/'", "udpin://127.0.0.1:14560"),
    "udpin://127.0.0.1:14560 ": ("'14560 '", "udpin://127.0.0.1:14560"),
    "udpout://127.0.0.1:0": ("port 0", "udpout://127.0.0.1:14560"),
    "tcpout://127.0.0.1:0": ("port 0", "tcpout://127.0.0.1:4560"),
    "udpout://::1:14560": ("brackets", "udpout://[::1]:14560"),
    "udpout://[::1:14560": ("brackets", "udpout://[::1]:14560"),
    "udpout://me@host:14560": ("a host", "udpout://127.0.0.1:14560"),
    "udpout://a b:14560": ("a host", "udpout://127.0.0.1:14560"),
    "serial://": ("full path", "serial:///dev/ttyUSB0:921600"),
    "serial:///dev/ttyUSB0": ("full path", "serial:///dev/ttyUSB0:921600"),
    "serial://dev/ttyUSB0:57600": ("full path", "serial:///dev/ttyUSB0:921600"),
    "serial:///dev/ttyUSB0:": ("baud rate ''", "serial:///dev/ttyUSB0:921600"),
    "serial:///dev/ttyUSB0:fast": ("baud rate 'fast'", "serial:///dev/ttyUSB0:921600"),
    "serial:///dev/ttyUSB0:0": ("baud rate '0'", "serial:///dev/ttyUSB0:921600"),
    "mem://": ("the name", "mem://loop"),
    "mem://a/b": ("the name", "mem://loop"),
}


@pytest.mark.parametrize("text", GOOD)
def test_a_good_uri_comes_apart(text: str) -> None:
    expected = LinkUri(text, text.partition(":")[0], **GOOD[text])  # type: ignore[arg-type]
    assert parse_link_uri(text) == expected


@pytest.mark.parametrize("text", BAD, ids=lambda text: text[:40] or "empty")
def test_a_bad_uri_is_named_with_the_reason_and_a_right_one(text: str) -> None:
    reason, proposal = BAD[text]
    with pytest.raises(LinkUriError) as caught:
        open_link(text)
    message = str(caught.value)
    assert repr(text) in message
    assert reason in message
    assert proposal in message
    assert "\n" not in message


@pytest.mark.parametrize("proposal", sorted({proposal for _, proposal in BAD.values()}))
def test_what_a_message_proposes_is_right(proposal: str) -> None:
    assert parse_link_uri(proposal).text == proposal


@given(st.sampled_from([*LINKS, "", "http"]), st.sampled_from(["://", ":", ""]), st.text())
def test_any_text_parses_or_is_a_bad_uri(scheme: str, separator: str, rest: str) -> None:
    text = scheme + separator + rest
    try:
        parsed = parse_link_uri(text)
    except LinkUriError as error:
        assert repr(text) in str(error)
    else:
        assert parsed.text == text
        assert parsed.scheme == scheme


class TestRegistry:
    def test_it_names_what_is_there(self) -> None:
        for scheme in LINKS.values():
            module, _, name = scheme.opener.partition(":")
            assert callable(getattr(importlib.import_module(module), name))

    def test_the_counterpart_of_a_counterpart_is_the_scheme_itself(self) -> None:
        for name, scheme in LINKS.items():
            other = LINKS[scheme.counterpart]
            assert other.counterpart == name
            assert (other.medium, other.is_datagram, other.header_bytes) == (
                scheme.medium, scheme.is_datagram, scheme.header_bytes
            )  # fmt: skip
            assert not (scheme.waits and other.waits), "nobody would come"

    @pytest.mark.parametrize(
        ("uri", "other"),
        [
            ("udpin://[::1]:14560", "udpout://[::1]:14560"),
            ("tcpout://127.0.0.1:4560", "tcpin://127.0.0.1:4560"),
            ("mem://loop", "mem://loop"),
            ("serial:///dev/ttyUSB0:921600", "serial:///dev/ttyUSB0:921600"),
        ],
    )
    def test_the_other_end_of_a_link(self, uri: str, other: str) -> None:
        assert counterpart(uri) == other

    def test_only_who_waits_may_leave_the_port_to_the_system(self) -> None:
        for name, scheme in LINKS.items():
            if scheme.medium is Medium.NETWORK:
                uri = f"{name}://127.0.0.1:0"
                if scheme.waits:
                    assert parse_link_uri(uri).port == 0
                else:
                    with pytest.raises(LinkUriError, match="port 0"):
                        parse_link_uri(uri)

    def test_no_link_has_no_counterpart(self) -> None:
        with pytest.raises(LinkUriError, match="must begin with"):
            counterpart("smoke://signals")


def test_no_transport_is_imported_before_it_is_opened() -> None:
    late = "{'serial', 'bridge.links.udp', 'bridge.links.serial_port'}"
    program = f"import sys, bridge.links.link; sys.exit(bool({late} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_counters_by_name() -> None:
    counters = LinkStats(sent=2, sent_bytes=9).as_dict()
    assert {name: count for name, count in counters.items() if count} == {"sent": 2, "sent_bytes": 9}
    assert len(counters) == 8
