# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Clock offsets of seconds, from the motion that IMU, odometer and fixes all measure.

Sensors of two computers may have clocks that are seconds apart although stamps and arrivals agree.
The odometer's acceleration is compared with the specific force at all offsets, and the speed of
the fixes with that of the odometer. Offsets up to OFFSET_REACH are delays, which the smoother
estimates.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.inputs import INPUTS
from odocal_ros.data.leg import Leg
from odocal_ros.data.pieces import bin_means
from odocal_ros.data.samples import ImuSamples, SomeSamples
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.clocks import OFFSET_REACH
from odocal_ros.screening.inputs import Inputs, place, Placed
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config

OFFSET_CELL = 0.25          # s, judgement: of means; an acceleration of the vehicle takes longer
FARTHEST_OFFSET = 90.0      # s, judgement: largest offset that is found
# s, judgement: slower changes are slopes in the force, and traffic in the speed
SLOW_FORCE, SLOW_SPEED = 20.0, 60.0
# s, judgement: duration of one acceleration, which counts as one sample
EVENT = 4.0
# statistical: log likelihood of the best offset less that of small ones and of all farther than
# EVENT from it; the margin above 10 (once in 20,000) is for signals that repeat themselves
LEAST_LOG_ODDS = 20.0


def screen_aligned(leg: Leg, config: Config) -> tuple[Leg, Inputs, tuple[Reason, ...]]:
    """Return a leg with all stamps on the clock of the IMU, its inputs, and reasons of both."""
    inputs, reasons = screen(leg, config)
    found, late_by = [], dict(_offsets(inputs, place(inputs, config)))
    for clock, late in late_by.items():
        slots = [slot for slot, one in INPUTS.items() if one.clock == clock]
        by_ns = -round(late * 1e9)
        leg = leg.with_rows(**{slot: _moved(leg.rows(slot), by_ns, leg.imu) for slot in slots})
        found.append(Reason(
            Code.DELAY_SEEN, f'{INPUTS[slots[0]].label} stamps are about {abs(late):.1f} s '
            f'{"late" if late > 0 else "early"} relative to the IMU (estimated from the '
            'motion); the stamps were corrected',
            'Synchronise the clocks (PTP, PPS, chrony), or stamp all sensors with one clock.'))
    if found:
        inputs, reasons = screen(leg, config)
        inputs = replace(inputs, aligned=late_by)
    return leg, inputs, (*found, *reasons)


def _offsets(inputs: Inputs, placed: Placed) -> Iterator[tuple[str, float]]:
    """Yield the clocks that are late relative to the IMU, and by how much, s; < 0: early."""
    t, travel, t_fix = inputs.t_imu, inputs.travel, inputs.t_fix
    if not inputs.has_accelerometer or min(len(t), len(travel.t), len(t_fix)) < 2:
        return
    edges = np.arange(min(t[0], travel.t[0]), max(t[-1], travel.t[-1]), OFFSET_CELL)
    if len(edges) < 3:      # no change of speed between two cells
        return
    count, (force,) = bin_means(t, edges, inputs.f_b)
    force[count == 0] = inputs.usual_f_b
    moved = np.diff(travel.at(edges))
    odometer = _late(_quick(np.gradient(moved)[:, None], SLOW_FORCE), _quick(force, SLOW_FORCE))
    if odometer:
        yield 'odometer', odometer
    place = np.stack([np.interp(edges, t_fix, axis) for axis in placed.fixes_n[:, :2].T], -1)
    fix = _late(_quick(_chords(place), SLOW_SPEED),
                _quick(_chords(travel.at(edges)[:, None]), SLOW_SPEED), odometer)
    if fix:
        yield 'gnss', fix


def _chords(place: Floats) -> Floats:
    """Return the distances between the means of adjacent EVENTs: (n, 1)."""
    cells = round(EVENT / OFFSET_CELL)
    total = np.cumsum(np.pad(place, ((cells, cells), (0, 0)), mode='edge'), axis=0)
    mean = total[cells:] - total[:-cells]
    out: Floats = np.linalg.norm(mean[cells:] - mean[:-cells], axis=1)[:, None]
    return out


def _quick(x: Floats, slow: float) -> Floats:
    """Return columns without their changes slower than some seconds: (n, k)."""
    half = min(round(slow / OFFSET_CELL / 2), (len(x) - 1) // 2)
    total = np.cumsum(np.pad(x, ((half + 1, half), (0, 0)), mode='edge'), axis=0)
    return x - (total[2 * half + 1:] - total[:-2 * half - 1]) / (2 * half + 1)


def _late(y: Floats, x: Floats, x_late: float = 0.0) -> float:
    """Return the delay, s, of y (n, 1) by its fit with x (n, k); 0: not above OFFSET_REACH."""
    reach = round(FARTHEST_OFFSET / OFFSET_CELL)
    size = 2 * max(len(x), reach)
    both = np.fft.irfft(np.fft.rfft(y, size, axis=0) * np.fft.rfft(x, size, axis=0).conj(), axis=0)
    at = np.arange(-reach, reach + 1)
    seen = both[at]
    share = np.einsum('li,ij,lj->l', seen, np.linalg.pinv(x.T @ x), seen) / max(
        float((y**2).sum()), 1e-12)
    best = 1 + int(np.argmax(share[1:-1]))
    before, here, after = share[best - 1:best + 2]      # their parabola has its maximum there:
    top = (after - before) / max(2 * (2 * here - before - after), 1e-12)
    late = OFFSET_CELL * (at[best] + np.clip(top, -0.5, 0.5))
    small = np.abs(OFFSET_CELL * at + x_late) <= OFFSET_REACH
    others = share[(np.abs(OFFSET_CELL * at - late) > EVENT) | small].max()
    events = len(y) * OFFSET_CELL / EVENT
    left = np.maximum(1.0 - np.array([others, here]), 1e-6)      # of the variance
    log_odds = events / 2 * np.log(left[0] / left[1])
    return float(late + x_late) if log_odds > LEAST_LOG_ODDS else 0.0


def _moved(samples: SomeSamples, by_ns: int, imu: ImuSamples) -> SomeSamples:
    """Return samples with moved stamps; arrivals too, unless stamps then lag like the IMU's."""
    lag, usual = (float(np.median(one.received_ns - one.stamp_ns)) if len(one.stamp_ns) else 0.0
                  for one in (samples, imu))
    by_stamps = abs(lag - by_ns - usual) < abs(lag - usual)
    return replace(samples, received_ns=samples.received_ns + (0 if by_stamps else by_ns),
                   stamp_ns=samples.stamp_ns + by_ns * (samples.stamp_ns > 0))
