# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg whose IMU was silent for a while: cut there, its parts are legs of the same vehicle."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from odocal_ros.calib.result import LegResult
from odocal_ros.data.arrays import Ints
from odocal_ros.data.leg import Leg, part_of
from odocal_ros.data.pieces import by_step
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.pipeline.method_run import Stage
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.settings.config import Config


def parts_of(leg: Leg, limit_s: float) -> list[Leg]:
    """Return a leg cut where its IMU is silent for longer; itself without gaps, or of many."""
    gaps = _gaps(leg, limit_s)
    most_parts = 20    # an IMU with more gaps stutters: its leg is rejected
    if not 0 < len(gaps) < most_parts:
        return [leg]
    begins = [None, *gaps[:, 1].tolist()]
    ends = [*gaps[:, 0].tolist(), leg.stop_ns]
    spans = [(max(first or leg.start_ns, leg.start_ns), last, first)
             for first, last in zip(begins, ends, strict=True)]
    shortest_ns = 10**9    # of a part: less is lost with the gap
    return [part_of(leg, *span) for span in spans if span[1] - span[0] >= shortest_ns] or [leg]


def _gaps(leg: Leg, limit_s: float) -> Ints:
    """Return begin and end of the gaps of the IMU, ns: (k, 2); one up to a mark is one, too."""
    near_start_ns = 60 * 10**9    # what lies nearer to the start mark belongs to the leg
    near = _near(leg.imu.stamp_ns, leg.start_ns - near_start_ns, leg.stop_ns)
    if len(near) < 2:
        return np.empty((0, 2), np.int64)
    gap_margin_ns = 1000    # below the limit: more than seconds in floating point are off
    least_ns = round(limit_s * 1e9) - gap_margin_ns
    k = np.flatnonzero(by_step(lambda stamps: np.diff(stamps) > least_ns, near))
    begin, end = np.append(near[k], near[-1]), np.append(near[k + 1], leg.stop_ns)
    if ((begin < leg.start_ns) & (leg.start_ns < end)).any():
        begin, end = (np.sort(np.append(stamps, leg.start_ns)) for stamps in (begin, end))
    t = (np.stack([begin, end], -1) - leg.start_ns) * 1e-9
    return np.stack([begin, end], -1)[t[:, 1] - t[:, 0] > limit_s]


def _near(stamps: Ints, first_ns: int, stop_ns: int) -> Ints:
    """Return the stamps between two, rising: a view where they rise as they came."""
    if by_step(lambda stamps: np.diff(stamps) > 0, stamps).all():
        return stamps[slice(*np.searchsorted(stamps, [first_ns, stop_ns + 1]))]
    return np.unique(stamps[(stamps >= first_ns) & (stamps <= stop_ns)])


def calibrate_parts(leg: Leg, config: Config, notes: tuple[Reason, ...] = (),
                    holdout: bool = False,
                    progress: Callable[[Stage], None] | None = None) -> list[LegResult]:
    """
    Take a leg from samples to results: one, or one of each part that carries.

    Arguments as for ``calibrate``. Where no part carries, or a gap is not what rejects the leg,
    the result is that of the whole.
    """
    parts = parts_of(leg, config.leg.max_gap)
    results = []
    for k, part in enumerate(parts if len(parts) > 1 or parts[0] is not leg else ()):
        def report(stage: Stage, k: int = k) -> None:
            if progress is not None:
                progress(replace(stage, done=(k + stage.done) / len(parts)))
        results.append(calibrate(part, config, notes=notes, holdout=holdout, progress=report))
    good = [one for one in results if one.verdict is not Verdict.REJECTED]
    if not good:
        return [calibrate(leg, config, notes=notes, holdout=holdout, progress=progress)]
    if len(good) == 1 and good[0].start_ns == leg.start_ns and good[0].stop_ns == leg.stop_ns:
        return good      # the gap lay before the mark
    return [replace(one, reasons=(*one.reasons, _cut(leg, one, len(good))),
                    cut_from_ns=leg.start_ns) for one in good]


def _cut(leg: Leg, one: LegResult, count: int) -> Reason:
    begin, end = ((t - leg.start_ns) * 1e-9 for t in (one.start_ns, one.stop_ns))
    return Reason(Code.LEG_CUT, f'this section covers {begin:.1f} to {end:.1f} s of the '
                  f'{(leg.stop_ns - leg.start_ns) * 1e-9:.1f} s leg'
                  + (f', one of {count} '
                     'sections' if count > 1 else ', the only section long enough '
                     'to calibrate'))
