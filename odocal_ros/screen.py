"""
Screening: a raw leg to clean arrays on one time axis, with a sentence for each thing found.

Rows that cannot be used are dropped and counted, the rest is used. Times are seconds since the
start mark; the mark is an Imu stamp, so the Imu's time offset moves the others against it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from odocal_ros.config import Config
from odocal_ros.leg import Leg
from odocal_ros.nav.odometer import mean_travel, Travel, travel
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.reasons import Code, Reason
from odocal_ros.samples import take

CLOCK_LIMIT = 0.5        # s, between topics (design.md, Stamps)
GAP_FACTOR = 5.0         # a gap in odometer or fixes, in median intervals
LABEL = {'imu': 'Imu', 'odometer': 'odometer', 'odometer_right': 'right odometer', 'fix': 'fix',
         'fix_velocity': 'fix velocity', 'heading': 'heading'}


@dataclass(frozen=True, eq=False)
class Inputs:
    """A leg made usable: rising times since the start mark, SI, body frame."""

    t_stop: float                      # s, the stop mark
    t_imu: NDArray[np.float64]         # (n,)
    w_b: NDArray[np.float64]           # (n, 3) rad/s
    f_b: NDArray[np.float64]           # (n, 3) m/s^2
    q_ni: NDArray[np.float64]          # (n, 4) orientation as sent, of frame i
    yaw_variance: NDArray[np.float64]  # (n,) rad^2, NaN: no orientation
    C_bi: NDArray[np.float64]          # (3, 3) nominal mounting rotation
    travel: Travel                     # mean of the wheels
    travel_left: Travel | None
    travel_right: Travel | None
    t_fix: NDArray[np.float64]         # (k,)
    geodetic: NDArray[np.float64]      # (k, 3) latitude, longitude rad, height m (NaN: none)
    covariance_n: NDArray[np.float64]  # (k, 3, 3) m^2
    t_heading: NDArray[np.float64]     # (h,)
    q_heading: NDArray[np.float64]     # (h, 4)
    heading_variance: NDArray[np.float64]  # (h,) rad^2
    fixes_rejected: int
    scale_unit: str


def screen(leg: Leg, config: Config) -> tuple[Inputs, tuple[Reason, ...]]:
    """
    Clean a leg.

    Returns
    -------
    The usable arrays (empty where nothing is left) and the findings.

    """
    found: list[Reason] = []
    for slot in ('imu', 'odometer', 'fix'):
        if not len(getattr(leg, slot).stamp_ns):
            code = {'imu': Code.NO_IMU, 'odometer': Code.NO_ODOMETER, 'fix': Code.NO_FIX}[slot]
            found.append(Reason(code, f'no {LABEL[slot]} message between the marks'))
    found += _clocks(leg, config)
    offset = {'imu': 0.0, 'odometer': config.odometer.time_offset - config.imu.time_offset,
              'fix': config.gnss.time_offset - config.imu.time_offset}
    offset['odometer_right'] = offset['odometer']

    def rows(slot):
        clean = _rising(_finite(getattr(leg, slot), slot, leg, found), slot, leg, found)
        return clean, (clean.stamp_ns - leg.start_ns) * 1e-9 + offset.get(slot, 0.0)

    imu, t_imu = rows('imu')
    heading, t_heading = rows('heading')
    whole, left, right = _travels(leg, config, rows, found)
    t_fix, geodetic, covariance, rejected = _fixes(leg, config, rows, found)
    _gaps('odometer', whole.t, found)
    _gaps('fix', t_fix, found)
    C_bi = matrix_from_rpy(config.imu.mounting_rpy)
    return Inputs(
        t_stop=(leg.stop_ns - leg.start_ns) * 1e-9, t_imu=t_imu,
        w_b=_turned(imu.w_i, config.imu.gyro_scale, C_bi),
        f_b=_turned(imu.f_i, config.imu.accel_scale, C_bi),
        q_ni=imu.q_ni, yaw_variance=imu.yaw_variance, C_bi=C_bi, travel=whole, travel_left=left,
        travel_right=right, t_fix=t_fix, geodetic=geodetic, covariance_n=covariance,
        t_heading=t_heading, q_heading=heading.q_ni, heading_variance=heading.yaw_variance,
        fixes_rejected=rejected, scale_unit=leg.form.scale_unit), tuple(found)


def _turned(vector_i, scale, C_bi):
    """Return scale * C_bi @ vector_i by row; a matrix product of (n, 3) costs 40 ns a row."""
    if np.array_equal(C_bi, np.eye(3)):
        return vector_i if scale == 1.0 else vector_i * scale
    x, y, z = vector_i.T
    return np.stack([x * a + y * b + z * c for a, b, c in scale * C_bi], -1)


def _travels(leg, config, rows, found):
    def one(slot):
        samples, t = rows(slot)
        result, reasons = travel(t, samples.value, leg.form, config.odometer.reversed)
        found.extend(reasons)
        return result

    left = one('odometer')
    if not len(leg.odometer_right.stamp_ns):
        return left, None, None
    right = one('odometer_right')
    if not len(left.t) or not len(right.t):
        return left, left, right
    return mean_travel(left, right), left, right


def _where(samples, index, leg) -> str:
    """Say where a row is, in seconds from the start mark (by arrival where it has no stamp)."""
    stamp = samples.stamp_ns[index] if samples.stamp_ns[index] > 0 else samples.received_ns[index]
    return f't = {(stamp - leg.start_ns) * 1e-9:.2f} s'


def _finite(samples, slot, leg, found):
    """Drop rows without a stamp or with NaN or Inf in what a row needs."""
    needed = {'imu': ('w_i', 'f_i'), 'fix': ('latitude', 'longitude')}.get(slot, ('value',))
    if slot in ('fix_velocity', 'heading'):
        needed = ('velocity_n',) if slot == 'fix_velocity' else ('q_ni',)
    stamped = samples.stamp_ns > 0
    finite = np.ones(len(stamped), bool)
    for name in needed:
        column = np.asarray(getattr(samples, name))
        finite &= np.isfinite(column).all(axis=tuple(range(1, column.ndim)))
    if slot == 'fix':
        finite |= samples.status < 0       # a receiver without a fix says NaN: not a fault
    for bad, what in ((~stamped, 'have no stamp (zero or negative)'),
                      (stamped & ~finite, 'hold NaN or Inf')):
        if bad.any():
            first = int(np.argmax(bad))
            found.append(Reason(Code.BAD_ROWS_DROPPED, f'{int(bad.sum())} of {len(bad)} '
                                f'{LABEL[slot]} messages {what}, first at '
                                f'{_where(samples, first, leg)}; dropped'))
    good = stamped & finite
    return samples if good.all() else take(samples, good)


def _rising(samples, slot, leg, found):
    """Drop the fewest rows that leave the stamps strictly rising."""
    stamp = samples.stamp_ns
    step = np.diff(stamp)
    if (step > 0).all():
        return samples
    keep = _longest_rising(stamp)
    same, back = int((step == 0).sum()), int((step < 0).sum())
    first = int(np.argmax(step <= 0)) + 1
    what = [f'{same} repeat the stamp before them'] * (same > 0)
    what += [f'{back} time{"s" * (back > 1)} the stamps step back (by up to '
             f'{-step.min() * 1e-9:.3g} s)'] * (back > 0)
    found.append(Reason(Code.STAMPS_NOT_RISING, f'{LABEL[slot]} stamps do not rise: '
                        f'{" and ".join(what)}, first at {_where(samples, first, leg)}; '
                        f'{len(stamp) - len(keep)} of {len(stamp)} messages dropped'))
    return take(samples, keep)


def _longest_rising(stamp):
    """
    Return the indices of a longest strictly rising subsequence (patience sorting).

    Every row loses its place only to a larger number of others: one glitch into the future costs
    one row, a clock stepped back costs the shorter side.
    """
    from bisect import bisect_left
    tails: list[int] = []
    ends: list[int] = []
    before = np.full(len(stamp), -1)
    for i, value in enumerate(stamp.tolist()):
        k = bisect_left(tails, value)
        if k:
            before[i] = ends[k - 1]
        if k == len(tails):
            tails.append(value)
            ends.append(i)
        else:
            tails[k], ends[k] = value, i
    keep, i = [], ends[-1]
    while i >= 0:
        keep.append(i)
        i = int(before[i])
    return np.array(keep[::-1])


def _clocks(leg, config):
    """Compare each topic's clock with the Imu's, at equal times of arrival."""
    imu = leg.imu
    if len(imu.stamp_ns) < 2:
        return []
    base = imu.received_ns[0]
    arrival = (imu.received_ns - base) * 1e-9
    order = np.argsort(arrival, kind='stable')
    lag = (imu.received_ns - imu.stamp_ns) * 1e-9
    asked = {'odometer': config.odometer.time_offset - config.imu.time_offset,
             'odometer_right': config.odometer.time_offset - config.imu.time_offset,
             'fix': config.gnss.time_offset - config.imu.time_offset}
    found = []
    for slot in ('odometer', 'odometer_right', 'fix', 'heading'):
        samples = getattr(leg, slot)
        ok = samples.stamp_ns > 0
        if not ok.any():
            continue
        own = (samples.received_ns[ok] - samples.stamp_ns[ok]) * 1e-9
        there = np.interp((samples.received_ns[ok] - base) * 1e-9, arrival[order], lag[order])
        ahead = float(np.median(there - own)) + asked.get(slot, 0.0)
        if abs(ahead) > CLOCK_LIMIT:
            found.append(Reason(Code.CLOCKS_DIFFER, f'the {LABEL[slot]} stamps are {ahead:+.3f} s '
                                'against the Imu stamps of the same moment'))
    return found


def _fixes(leg, config, rows, found):
    """Return times, positions and covariances of the usable fixes, and how many are not."""
    fix, t = rows('fix')
    gnss = config.gnss
    n = len(leg.fix.stamp_ns)
    no_fix = fix.status < gnss.min_status
    nowhere = (fix.latitude == 0) & (fix.longitude == 0)
    beyond = (abs(fix.latitude) > np.pi / 2) | (abs(fix.longitude) > 2 * np.pi)
    covariance, unknown = _covariances(fix, gnss)
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]))
    poor = (sigma > gnss.max_sigma) & (gnss.max_sigma > 0) & ~unknown
    use = ~(no_fix | nowhere | beyond | poor)
    if unknown.any():
        found.append(Reason(Code.COVARIANCE_UNKNOWN, f'{int(unknown.sum())} of '
                            f'{len(fix.stamp_ns)} fixes come without a usable covariance; taken '
                            f'as {gnss.default_sigma:g} m (gnss.default_sigma)'))
    bad = [f'{int(m.sum())} {what}' for m, what in (
        (no_fix, f'with status below {gnss.min_status}'),
        (nowhere | beyond, 'at no real position'),
        (poor & ~no_fix, f'with sigma above {gnss.max_sigma:g} m')) if m.any()]
    if bad and n:
        code = Code.BAD_ROWS_DROPPED if use.any() else Code.FIXES_UNUSABLE
        found.append(Reason(code, f'of {n} fixes are not used: {", ".join(bad)}'))
    geodetic = np.stack([fix.latitude, fix.longitude, fix.height], -1)[use]
    geodetic[~np.isfinite(geodetic)] = np.nan
    return t[use], geodetic, covariance[use], n - int(use.sum())


def _covariances(fix, gnss):
    """Return covariances with the unknown ones (type 0, zero, not finite) replaced, and which."""
    covariance = fix.covariance_n.copy()
    diagonal = np.diagonal(covariance, axis1=1, axis2=2)
    sound = np.isfinite(covariance).all(axis=(1, 2)) & (diagonal[:, :2] > 0).all(axis=1)
    unknown = ~sound | (fix.covariance_type == 0)
    vertical = 2 * gnss.default_sigma      # satellites are above only: height is about twice worse
    covariance[unknown] = np.diag([gnss.default_sigma**2, gnss.default_sigma**2, vertical**2])
    flat = covariance[:, 2, 2] <= 0
    covariance[flat, 2, 2] = 4 * np.maximum(covariance[flat, 0, 0], covariance[flat, 1, 1])
    return covariance, unknown


def _gaps(slot, t, found):
    """Name the longest gap of odometer or fixes where it is far beyond their own rhythm."""
    if len(t) < 10:
        return
    step = np.diff(t)
    worst = int(np.argmax(step))
    if step[worst] > max(GAP_FACTOR * np.median(step), 0.2):
        found.append(Reason(Code.TOPIC_GAP, f'{LABEL[slot]} gap of {step[worst]:.2f} s at '
                            f't = {t[worst]:.2f} s (median interval {np.median(step):.3f} s)'))


def imu_gap(inputs: Inputs, t_from: float, limit: float) -> tuple[Reason, ...]:
    """Return IMU_GAP where the Imu misses more than ``limit`` s between t_from and the stop."""
    t = inputs.t_imu
    t = t[(t >= t_from - 1e-9) & (t <= inputs.t_stop + 1e-9)]
    edges = np.concatenate([[t_from], t, [inputs.t_stop]])
    gaps = [(b - a, a) for a, b in pairwise(edges.tolist()) if b - a > limit] \
        if np.diff(edges).max() > limit else []
    if not gaps:
        return ()
    length, at = max(gaps)
    return (Reason(Code.IMU_GAP, f'the Imu is missing for {length:.2f} s at t = {at:.2f} s '
                   f'({len(gaps)} gap{"s" * (len(gaps) > 1)} above {limit:g} s)'),)
