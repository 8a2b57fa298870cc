"""A log replayed to a link: true to time, or faster or slower, to whoever listens there."""

from __future__ import annotations

import sys
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar

from bridge.links.link import NOBODY, Link
from bridge.process import StopFlag, open_patiently
from bridge.recording.replay import Player, log_times_ns
from bridge.reporting import Report
from bridge.summary import percentiles_us
from bridge.timing.clock import Clock, PunctualClock, unix_time_us
from bridge.timing.realtime import Settings, maybe_real_time, own_core, report_settings
from fwav_hil.logs.choice import duration, time_of_day
from fwav_hil.progress import StatusLine
from fwav_hil.replay.keyboard import HELP, Keyboard
from fwav_hil.replay.options import ReplayOptions
from protocol.errors import PeerMissingError, UsageError
from protocol.logs.dialect import layouts
from protocol.logs.retime import TimeMover
from protocol.logs.scan import Scan
from protocol.wire.signing import Signatures

_DRAIN_LIMIT = 100
_DRAW_PERIOD_NS = 200_000_000
_LONG_WAIT_S = 10.0
"""A silence that makes the replay wait longer than this is told of before it begins."""
_STEP_BACK_US = 60_000_000
_DRAW_ROOM_NS = 3_000_000
"""Drawing the bar takes a millisecond or two: it waits for a moment when nothing is due, at most five periods."""


def replay_to(
    scan: Scan, chosen: npt.NDArray[np.bool_], uri: str, options: ReplayOptions, report: Report, stop: StopFlag
) -> dict[str, Any]:
    """Replay the chosen frames; returns what was sent, and how punctually. Raises LinkError, PeerError and UsageError,
    and Interrupted where the user stopped it before it began.
    """
    with open_patiently(uri, options.wait_s, stop) as link:
        clock = PunctualClock(sleeps_half=options.realtime)
        _await_peer(link, options.wait_s, clock, stop)
        replay = Replay(scan, chosen, link, options, clock, stop)
        with maybe_real_time(own_core(0), wanted=options.realtime) as settings:
            report_settings(report, settings)
            return replay.run(settings)


def _await_peer(link: Link, wait_s: float, clock: Clock, stop: StopFlag) -> None:
    """On a link that waits for its peer: wait until there is one."""
    give_up_ns = clock.now_ns() + round(wait_s * 1e9)
    told = False
    while link.peer == NOBODY:
        stop.check()
        if clock.now_ns() > give_up_ns:
            raise PeerMissingError(
                f"nobody came to {link.uri} within {wait_s:g} s: start the receiver, or wait longer with --wait"
            )
        if not told:
            told = True
            sys.stderr.write(f"waiting on {link.uri}\n")
        link.recv(0.1)


class Replay:
    """One log on its way to one link."""

    def __init__(
        self,
        scan: Scan,
        chosen: npt.NDArray[np.bool_],
        link: Link,
        options: ReplayOptions,
        clock: Clock,
        stop: StopFlag,
    ) -> None:
        self._scan = scan
        self._data = scan.data.data
        # Of what the dialect does not know, or knows as another message, nothing may be changed.
        self._known: list[bool] = ((scan.frames["known"] == 1) & (scan.frames["flags"] & 0xFE == 0))[chosen].tolist()
        self._begins: list[int] = scan.frames["offset"][chosen].tolist()
        self._ends: list[int] = scan.ends()[chosen].tolist()
        self._stamps_us = scan.frames["stamp_us"][chosen]
        self._link = link
        self._options = options
        self._clock = clock
        self._stop = stop
        self._mover = TimeMover(scan, chosen, unix_time_us()) if options.rewrite_time else None
        self._signer = Signatures(options.key, messages=layouts()) if options.key else None
        self._not_signed = 0
        self._told_of_refusal = False
        self._were_signed = int(np.count_nonzero(scan.frames["signed"][chosen]))
        times_ns = log_times_ns(self._stamps_us, options.max_gap_s)
        if options.loop and options.speed and not times_ns[-1]:
            raise UsageError("--loop: all frames chosen are of one moment, which has no length: choose more of the log")
        self._pass_us = int(times_ns[-1]) // 1000 + 1
        self.player = Player(times_ns, self._prepare, link.send, clock, speed=options.speed, look=self._attend)
        self._keyboard = Keyboard()
        self._display = _Display(len(self._begins), clock)

    def run(self, settings: Settings = ()) -> dict[str, Any]:
        """Play it; the result says whether the user stopped it. Raises PeerMissingError where nobody took anything.

        settings: what came of asking for real time, for the result.
        """
        with self._keyboard, self._display:
            if self._keyboard.active:
                self._display.say(HELP)
            if self._were_signed and not self._signer:
                self._display.say(
                    f"{self._were_signed} frames carry the signatures of their day, which a receiver that checks them "
                    "refuses: sign anew with --signing-key FILE"
                )
            for sentence in self.waits():
                self._display.say(sentence)
            begun_ns = self._clock.now_ns()
            self.player.play(loop=self._options.loop)
            wall_ns = self._clock.now_ns() - begun_ns
            self._attend(self.player)
        result = self._result(wall_ns) | {"realtime": [msgspec.to_builtins(setting) for setting in settings]}
        if self._refused > result["frames"] // 2:
            raise PeerMissingError(
                f"nobody listens at {self._link.uri} ({self._refused} of {result['frames']} frames were refused): start the "
                "receiver first, or correct the address"
            )
        return result

    def waits(self) -> list[str]:
        """What is to be said beforehand of the log's clock: silences that the replay will wait through, steps back."""
        said, steps_us = [], np.diff(self._stamps_us)
        back = np.flatnonzero(steps_us < -_STEP_BACK_US)
        if len(back):
            said.append(
                f"the log's clock goes back by {duration(-1e-6 * float(steps_us[back[0]]))} behind frame {back[0] + 1}"
                + (f" (and at {len(back) - 1} more places)" if len(back) > 1 else "")
                + ": the replay goes on there without waiting"
            )
        steps_ns = np.diff(self.player.times_ns)
        silent = np.flatnonzero(steps_ns > _LONG_WAIT_S * 1e9 * (self._options.speed or np.inf))
        if len(silent):
            longest = silent[np.argmax(steps_ns[silent])]
            wait_s = 1e-9 * float(steps_ns[longest]) / (self._options.speed or 1.0)
            said.append(
                f"the log is silent for {duration(1e-9 * float(steps_ns[longest]))} behind frame {longest + 1}"
                + (f" (the longest of {len(silent)} silences)" if len(silent) > 1 else "")
                + f", through which the replay waits for {duration(wait_s)}: --max-gap 1 makes a second of each"
            )
        return said

    @property
    def _refused(self) -> int:
        return self._link.stats.refused + self._link.stats.send_failed

    def _prepare(self, number: int, passes: int) -> bytes:
        frame = bytes(self._data[self._begins[number] : self._ends[number]])
        if self._mover and self._known[number]:
            frame = self._mover.move(frame, passes * self._pass_us)
        if self._signer and self._known[number]:
            return self._signer.sign(frame, unix_time_us())
        self._not_signed += self._signer is not None
        return frame

    def _attend(self, player: Player) -> None:
        """Look after all but the frames: the wish to stop, keys, what the receiver says, the display."""
        if self._stop.requested:
            player.stop()
            return
        self._keyboard.attend(player)
        for _ in range(_DRAIN_LIMIT):
            if not self._link.recv(0.0):
                break
        if self._refused and not self._told_of_refusal:
            self._told_of_refusal = True
            self._display.say(f"nobody listens at {self._link.uri}, or not always: frames are refused")
        self._display.show(player, self._stamps_us)

    def _result(self, wall_ns: int) -> dict[str, Any]:
        player, span_s = self.player, int(self.player.times_ns[-1]) * 1e-9
        log_s = player.passes * span_s + (player.log_ns * 1e-9 if player.at < len(self._begins) else 0.0)
        return {
            "log": str(self._scan.path),
            "interrupted": self._stop.requested,
            "to": self._link.uri,
            "frames": player.sent,
            "passes": player.passes,
            "log_s": log_s,
            "wall_s": wall_ns * 1e-9,
            "speed": self._options.speed,
            "speed_measured": log_s / (wall_ns * 1e-9) if wall_ns and not player.moved else None,
            "lateness_us": percentiles_us(player.lateness_ns),
            "counters": {
                "times_moved": self._mover.moved if self._mover else 0,
                "signed": self._signer.signed if self._signer else 0,
                "not_signed": self._not_signed + (self._signer.unsigned if self._signer else 0),
                **self._link.stats.as_dict(),
            },
        }


class _Display:
    """Log time in a bar on a terminal, a line now and then elsewhere."""

    def __init__(self, frames: int, clock: Clock) -> None:
        self._frames = frames
        self._clock = clock
        self._drawn_ns = clock.now_ns()
        self._line = StatusLine()
        self._bar: Bar | None = None
        if sys.stderr.isatty():
            columns = (TextColumn("replaying"), BarColumn(bar_width=30), TextColumn("{task.description}"))
            # Drawn by hand: the thread that would draw it holds the interpreter when a frame is due.
            self._bar = Bar(*columns, console=Console(stderr=True, markup=False, emoji=False), auto_refresh=False)
            self._task = self._bar.add_task("", total=frames)

    def say(self, text: str) -> None:
        (self._bar.console.print if self._bar else _print)(text)

    def show(self, player: Player, stamps_us: npt.NDArray[np.int64]) -> None:
        at = min(player.at, self._frames - 1)
        text = f"log time {time_of_day(int(stamps_us[at]))}, {player.sent} frames sent" + (
            ", held" if player.held else ""
        )
        if self._bar:
            self._bar.update(self._task, completed=player.at, description=text)
            since_ns = self._clock.now_ns() - self._drawn_ns
            if since_ns > _DRAW_PERIOD_NS and (player.room_ns > _DRAW_ROOM_NS or since_ns > 5 * _DRAW_PERIOD_NS):
                self._bar.refresh()
                self._drawn_ns = self._clock.now_ns()
        else:
            self._line.show(text)

    def __enter__(self) -> _Display:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.refresh()
            self._bar.stop()


def _print(text: str) -> None:
    sys.stderr.write(text + "\n")
