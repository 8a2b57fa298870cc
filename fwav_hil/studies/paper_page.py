"""The results of the paper study as files: Markdown, CSV, JSON."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from fwav_hil.axis_names import AXIS_NAMES
from fwav_hil.studies.lyapunov import Bound
from fwav_hil.studies.paper import MEASURES, ORDERINGS, Claim, Row
from protocol.messages import AXES

TITLES = {
    "II": "Table II: controllers",
    "III": "Table III: compensation of the hysteresis",
    "IV": "Table IV: filter time",
    "-": "Not in the paper",
}

INTRODUCTION = """\
# The paper, reproduced

Made by `fwav-hil paper`; do not edit. Errors are in the paper's units (cm, rad), over the whole 10 s, at 1 kHz, without noise.
Each cell reads: paper / ours (ratio ours to paper). `paper` is the paper's run as far as it is stated; `paper_disturbed` adds
a body torque that is not in the paper, a hypothesis made after seeing its tables. `docs/mathematics.md` explains how the
paper was interpreted.

## Why our results differ

- **Units.** The paper names none; CGS is the only reading in which one b = 2 suits all channels.
- **Lambda.** The paper gives no value; we chose 1/s, and the extra pole N = 1000/s, without which (21) cannot be run.
- **Start of the reference.** Not given; we chose 0 in position, q(0) in attitude. Most position error is in the first second.
- **The hysteresis is too small to see.** With chi = 1 per dyn its width is 2.8 of about 1700 units of tau: it cannot explain
  the gap between the columns of Table III. In ours that gap comes from other effects that the estimate removes, mainly gravity.
- **Attitude.** The equations as stated contain hardly any disturbance of it, so our errors are far smaller; the torque of
  `paper_disturbed` brings PD and T = 1 near the paper's.
- **"UDE smallest in all" fails in the paper's own Table II**: the DOB wins five position cells.
- **A DOB with equal gains and feed-forward is the UDE**, digit for digit except for the rounding of its gains (last table and
  the UDE of Table II); the gap in Table II is one of gains and feed-forward.
"""


def markdown_page(
    rows: Sequence[Row], claims: Sequence[Claim], bounds: dict[str, dict[str, dict[str, float]]], figures: Iterable[str]
) -> str:
    """The page: claims, tables, bounds, figures. `bounds`: share of samples at which each held, by scenario, bound and axis."""
    parts = [INTRODUCTION]
    for scenario in dict.fromkeys(row.scenario for row in rows):
        parts.append(f"## `{scenario}`\n")
        parts.append(_claims_table([claim for claim in claims if claim.scenario == scenario]))
        parts += [
            _table(title, [r for r in rows if (r.scenario, r.table) == (scenario, table)])
            for table, title in TITLES.items()
        ]
        parts.append(
            "Lyapunov quantities of the UDE run, u~ from the run itself: share of the samples at which V1 was within its "
            f"bound. (30): {_shares(bounds[scenario]['bound'])}. By comparison with y' = -rho y + C1(t): "
            f"{_shares(bounds[scenario]['comparison'])}. Sample by sample they are in `lyapunov_{scenario}.csv`, which the "
            "command writes beside this page.\n"
        )
    parts.append("## Figures\n")
    parts += [f"![{Path(figure).stem.replace('_', ' ')}]({figure})\n" for figure in figures]
    return "\n".join(parts)


def _shares(held: dict[str, float]) -> str:
    return ", ".join(f"{AXIS_NAMES[axis]} {100.0 * share:.1f} %" for axis, share in held.items())


def lyapunov_csv(t_ns: np.typing.NDArray[np.int64], bound: Bound) -> str:
    """V1, its bound (30), the comparison's, and whether each held, per sample (a line each) and axis."""
    columns = {"V1": bound.v1, "bound": bound.bound, "held": bound.held, "comparison": bound.comparison}
    columns["comparison_held"] = bound.comparison_held
    out = io.StringIO()
    names = ",".join(f"{name}_{axis}" for name in columns for axis in AXES)
    table = np.hstack([(t_ns * 1e-9)[:, None], *columns.values()])
    formats = ["%.6f"] + ["%d" if "held" in name else "%.6g" for name in columns for _ in AXES]
    np.savetxt(out, table, fmt=formats, delimiter=",", header=f"t,{names}", comments="")
    return out.getvalue()


def _claims_table(claims: Sequence[Claim]) -> str:
    lines = [
        "| claim, cells in which it holds (RMSE and MAE of 6 channels) | paper's own numbers | ours | fails in ours |"
    ]
    lines.append("| --- | --- | --- | --- |")
    for name, *_ in ORDERINGS:
        cells = [claim for claim in claims if claim.claim == name]
        failed = (
            ", ".join(f"{AXIS_NAMES[claim.channel]} {claim.measure.upper()}" for claim in cells if not claim.ours)
            or "-"
        )
        held = [sum(getattr(claim, whose) for claim in cells) for whose in ("paper", "ours")]
        lines.append(f"| {name} | {held[0]} of {len(cells)} | {held[1]} of {len(cells)} | {failed} |")
    return "\n".join(lines) + "\n"


def _table(title: str, rows: Sequence[Row]) -> str:
    names = list(dict.fromkeys(row.condition for row in rows))
    head = [f"{name.replace('_', ' ')} {measure.upper()}" for name in names for measure in MEASURES]
    lines = [f"### {title}\n", "| channel | " + " | ".join(head) + " |", "| --- |" + " --- |" * len(head)]
    for axis in AXES:
        cells = []
        for name in names:
            row = next(row for row in rows if (row.condition, row.channel) == (name, axis))
            cells += [_cell(getattr(row, f"paper_{measure}"), getattr(row, measure)) for measure in MEASURES]
        lines.append(f"| {AXIS_NAMES[axis]} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _cell(printed: float | None, ours: float) -> str:
    if printed is None:
        return f"{ours:.4g}"
    return f"{printed:.4f} / {ours:.4g} ({ours / printed:.2g})"


def csv_text(rows: Sequence[Row]) -> str:
    """All rows, one cell pair a line."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(Row.__struct_fields__)
    writer.writerows([getattr(row, field) for field in Row.__struct_fields__] for row in rows)
    return out.getvalue()
