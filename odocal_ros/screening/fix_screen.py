# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Selection of usable fixes and GNSS velocities, and the uncertainty of each fix.

Some receivers dead-reckon without satellites, and their position jumps when satellites return.
Such fixes are smooth: the change of their displacement from second to second agrees with odometer
and IMU far better than elsewhere. The jump at the end is the sum of their errors, so these fixes
contain no information on the scale.
"""

import numpy as np

from odocal_ros.data.arrays import Bools, Complexes, Floats, Ints, running_sum
from odocal_ros.data.samples import FixSamples, LOCAL_STATUS
from odocal_ros.nav.geodesy import ecef_from_geodetic, radii
from odocal_ros.nav.time_series import MISSING_INTERVALS, running_integral
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import GnssConfig
from odocal_ros.settings.levels import REMARK_SIGMAS

# m, judgement. Measured on eight zoo drives with blocks of fixes of 7 m among fixes of 0.01 to
# 1.5 m: without a limit the sigma of the scale is 1.2 to 24 times as large, as correlated errors
# have one level; error over sigma is the same. A drive with fixes of 3 to 7 m fails with it
DEFAULT_SIGMA_LIMIT = 3.0
# s, length of compared displacements: judgement, longer than delays of receivers
DISPLACEMENT_WINDOW = 10.0
VELOCITY_GAP = 2.0    # s, judgement: a longer one hides a change of speed
# of |z - 1| in velocity_reasons. Judgement: velocities and fixes differ by a few per cent, by
# far more with wrong axes, units and frames
VELOCITY_RATIO_LIMIT = 0.1
COMPARISON_INTERVAL = 1.0     # s between the fixes that are compared: judgement
MIN_DISPLACEMENT = 1.0      # m in this time, judgement: displacements then have a direction
# judgement: a displacement is smooth if its deviation from odometer and gyro is below a quarter of
# the median deviation, or below half of it and 3 cm, the noise of odometer and gyro
SMOOTH_LIMIT, FINE_SHARE, FINE_LIMIT = 0.25, 0.5, 0.03
# judgement: compared fixes of a smooth section, and smooth share of them; white noise reaches it
# three times in 10^8 (a quarter), or in 10^4 (half)
SMOOTH_ROWS, SMOOTH_SHARE = 10, 0.7
# least deviation of a jump, in medians and m. Judgement: white noise exceeds three medians once in
# 500 seconds, after a smooth section
JUMP_SIZE, SHORTEST_JUMP = 3.0, 0.5
# s, physical: in 0.1 s a change of acceleration by 5 m/s^2 (hard braking) gives SHORTEST_JUMP
JUMP_DELAY = 0.1
SPANS_LISTED = 3           # judgement: number of spans in a reason


def usable_fixes(fix: FixSamples, received: int, gnss: GnssConfig,
                 origin: str = '') -> tuple[Bools, Floats, tuple[Reason, ...]]:
    """
    Return usable fixes, (n,) bool, covariances, (n, 3, 3) m^2, and reasons.

    received : number of received fixes.   origin : text that follows this number.
    """
    no_fix = fix.status < gnss.min_status
    max_height = 1e4    # m, physical: no ground is higher; 10 km make the scale 0.16 % larger
    invalid = ~has_position(fix) | (abs(fix.height) > max_height)
    invalid = invalid | _far_from_median(fix, ~(invalid | no_fix))
    covariance, unknown = covariances(fix, gnss.default_sigma)
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]))
    limit = sigma_limit(sigma[~unknown & ~no_fix & ~invalid], gnss.max_sigma)
    inaccurate = (sigma > limit) & ~unknown
    use = ~(no_fix | invalid | inaccurate)
    reasons: tuple[Reason, ...] = ()
    if (unknown & ~no_fix).any():
        local = bool((fix.status == LOCAL_STATUS).any())
        name = 'reference.default_sigma' if local else 'gnss.default_sigma'
        reasons += (Reason(
            Code.COVARIANCE_UNKNOWN, f'{int((unknown & ~no_fix).sum())} of {received} fixes have '
            f'no usable covariance; {gnss.default_sigma:g} m ({name}) is used',
            f'Set {name} to the real horizontal accuracy of the positions.' if local else ''),)
    rejected = [(f'{int(mask.sum())} {cause}', remedy) for mask, cause, remedy in (
        (no_fix, f'with status below {gnss.min_status}', 'Drive under open sky, or lower '
         'gnss.min_status if these fixes are good.'),
        (invalid & ~no_fix, _invalid_text(fix, invalid & ~no_fix), 'Check the driver: latitude '
         'and longitude in degrees (swapped?), altitude in m, no 0, 0 in place of a missing '
         'position.'),
        (inaccurate & ~no_fix & ~invalid, f'with sigma above {limit:.3g} m', 'If these '
         'uncertainties are correct, raise gnss.max_sigma (0: no limit): each fix is weighted by '
         'its own uncertainty.')) if mask.any()]
    if rejected:
        code = Code.BAD_ROWS_DROPPED if use.any() else Code.FIXES_UNUSABLE
        causes, remedies = zip(*rejected, strict=True)
        reasons += (Reason(code, f'{int((~use).sum())} of {received} fixes{origin} are not used: '
                           f'{", ".join(causes)}', ' '.join(remedies)),)
    return use, covariance, reasons


def _invalid_text(fix: FixSamples, invalid: Bools) -> str:
    """Return a phrase for the invalid positions of a mask, with the first one as an example."""
    if not invalid.any():
        return ''
    first = int(np.argmax(invalid))
    latitude, longitude = np.degrees([fix.latitude[first], fix.longitude[first]])
    return (f'at an invalid position (the first: latitude {latitude:.6g}, longitude '
            f'{longitude:.6g} deg, altitude {fix.height[first]:.6g} m)')


def sigma_limit(sigma: Floats, max_sigma: float) -> float:
    """Return the limit of the horizontal sigmas of fixes, (n,) m; inf: none."""
    if not np.isnan(max_sigma):
        return max_sigma or np.inf
    return max(DEFAULT_SIGMA_LIMIT, 2 * float(np.median(sigma)) if len(sigma) else 0.0)


def has_position(fix: FixSamples) -> Bools:
    """Return a mask of fixes on the Earth, not NaN, whose angles are not both zero: (n,) bool."""
    both_zero = (fix.latitude == 0) & (fix.longitude == 0)
    inside = (abs(fix.latitude) <= np.pi / 2) & (abs(fix.longitude) <= 2 * np.pi)
    return np.asarray(inside & ~both_zero)


def _far_from_median(fix: FixSamples, good: Bools) -> Bools:
    """Return a mask of good fixes far from the median of the good ones: (n,) bool."""
    is_far = np.zeros(len(good), bool)
    if good.any():
        r_e = ecef_from_geodetic(fix.latitude[good], fix.longitude[good], 0.0)
        max_distance = 1e6    # m: a fix farther away is not a real position
        is_far[good] = np.linalg.norm(r_e - np.median(r_e, axis=0), axis=1) > max_distance
    return is_far


def covariances(fix: FixSamples, default_sigma: float) -> tuple[Floats, Bools]:
    """
    Return covariances with the unknown ones replaced, and a mask of these, (n,).

    Unknown: type 0, zero or less, not finite, or not a covariance (a correlation of one or more).
    If only the height's part is unknown, it is derived from the horizontal part.
    """
    covariance = fix.covariance_n.copy()
    unknown = ~_is_covariance(covariance[:, :2, :2]) | (fix.covariance_type == 0)
    no_height = unknown | ~_is_covariance(covariance)
    covariance[unknown] = np.eye(3) * default_sigma**2
    covariance[no_height, 2, :] = covariance[no_height, :, 2] = 0.0
    # satellites are only above: the sigma of a height is about twice as large
    covariance[no_height, 2, 2] = 4 * np.maximum(covariance[no_height, 0, 0],
                                                 covariance[no_height, 1, 1])
    return covariance, unknown


def _is_covariance(matrices: Floats) -> Bools:
    """Return a mask of invertible covariance matrices: (n, k, k) to (n,) bool."""
    variance = np.diagonal(matrices, axis1=1, axis2=2)
    largest_sigma = 1e8    # m, larger ones are invalid: products and roots would overflow
    small = np.abs(matrices) < largest_sigma**2
    valid: Bools = np.all(np.isfinite(matrices) & small, axis=(1, 2))
    smallest_sigma = 1e-6    # m, smaller ones are invalid
    valid &= (variance > smallest_sigma**2).all(axis=1)
    with np.errstate(all='ignore'):
        sigma = np.sqrt(variance)
        correlation = matrices / (sigma[:, :, None] * sigma[:, None, :])
    correlation[~valid] = np.eye(matrices.shape[1])
    asymmetry = 1e-3    # an asymmetric matrix is damaged: the correct half is unknown
    valid &= (np.abs(correlation - np.swapaxes(correlation, 1, 2)) < asymmetry).all(axis=(1, 2))
    min_eigenvalue = 1e-6    # of the correlations: below it the matrix is singular
    valid &= np.linalg.eigvalsh(correlation)[:, 0] > min_eigenvalue
    return valid


def velocity_reasons(t: Floats, velocity_n: Floats, t_fix: Floats, geodetic: Floats,
                     covariance_n: Floats) -> tuple[Reason, ...]:
    """
    Return VELOCITY_UNUSABLE if the velocity contradicts the fixes, otherwise ().

    Displacements between fixes, complex numbers D, are z times those from the velocity, V, with
    z = sum(conj(V) D) / sum(|V|^2), 1 for a correct velocity. Swapped axes, vehicle axes, a speed
    without direction, and km/h have another z.

    t, velocity_n : (m,) s, (m, 3) m/s.   t_fix, geodetic, covariance_n : (k,) s, (k, 3) rad and m,
    (k, 3, 3) m^2.
    """
    inside = (t_fix >= t[0]) & (t_fix <= t[-1]) if len(t) else np.zeros(len(t_fix), bool)
    t_fix, geodetic, covariance = t_fix[inside], geodetic[inside], covariance_n[inside]
    if len(t_fix) < 2:
        return ()
    rows = np.unique(np.searchsorted(t_fix[:-1], np.arange(t_fix[0], t_fix[-1],
                                                           DISPLACEMENT_WINDOW)))
    meridian, normal = radii(geodetic[0, 0])
    D = np.diff(geodetic[rows, 1] * normal * np.cos(geodetic[0, 0])
                + 1j * geodetic[rows, 0] * meridian)
    path = running_integral(t, velocity_n[:, :2]) @ [1, 1j]
    ends = t_fix[rows]
    V = np.diff(np.interp(ends, t, path))
    # motion in a gap of the velocity, or of the fixes, is not measured
    gaps_before = running_sum(np.diff(t) > VELOCITY_GAP)
    begin, end = np.searchsorted(t, ends[:-1], side='right') - 1, np.searchsorted(t, ends[1:])
    complete = (gaps_before[begin] == gaps_before[end]) & (np.diff(ends) < 2 * DISPLACEMENT_WINDOW)
    V, D = V[complete], D[complete]
    power = float((abs(V)**2).sum())
    if not power:
        return ()
    z = complex((V.conj() * D).sum() / power)
    sigma = float(np.sqrt(2 * np.median(covariance[:, 0, 0]) / power))
    limit = VELOCITY_RATIO_LIMIT + REMARK_SIGMAS * sigma
    if abs(z - 1) < limit:
        return ()
    return (Reason(Code.VELOCITY_UNUSABLE, 'GNSS velocity contradicts the fixes and is not '
                   f'used: displacements between fixes are {abs(z):.2f} times those from the '
                   f'velocity, rotated by {np.degrees(np.angle(z)):+z.0f} deg: a difference of '
                   f'{100 * abs(z - 1):.0f} % (limit {100 * limit:.0f} %). Likely cause: another '
                   'unit, swapped axes, or vehicle axes'),)


def dead_reckoned_fixes(t_fix: Floats, fixes_n: Floats, sigma: Floats,
                        track: Complexes) -> tuple[Bools, tuple[Reason, ...]]:
    """
    Return a mask of fixes that a receiver has dead-reckoned, and FIXES_DEAD_RECKONED.

    t_fix : (k,) s.   fixes_n : (k, 3) m.   sigma : (k,) stated, of an axis, m.   track : (k,)
    positions of the antenna by odometer and gyro, m, with any first heading, scale within 30 %.
    """
    spans = _dead_reckoned_spans(t_fix, fixes_n[:, 0] + 1j * fixes_n[:, 1], sigma, track)
    is_reckoned = np.zeros(len(t_fix), bool)
    for begin, end, _ in spans:
        is_reckoned |= (t_fix >= begin) & (t_fix < end)
    if not spans:
        return is_reckoned, ()
    listed = ', '.join(f't = {begin:.0f} to {t_fix[t_fix < end][-1]:.0f} s (jump of {jump:.1f} m)'
                       for begin, end, jump in spans[:SPANS_LISTED])
    more = f' and {len(spans) - SPANS_LISTED} more' * (len(spans) > SPANS_LISTED)
    return is_reckoned, (Reason(
        Code.FIXES_DEAD_RECKONED, f'fixes were dead-reckoned at {listed}{more}: '
        f'{int(is_reckoned.sum())} of {len(t_fix)} fixes not used'),)


def _dead_reckoned_spans(t: Floats, positions: Complexes, sigma: Floats,
                         track: Complexes) -> list[tuple[float, float, float]]:
    """Return for each span its first fix and the first after it, s, and the jump there, m."""
    if len(t) <= SMOOTH_ROWS:
        return []
    step = min(max(1, round(COMPARISON_INTERVAL / float(np.median(np.diff(t))))), len(t) - 1)
    t, positions, sigma, track = t[::step], positions[::step], sigma[::step], track[::step]
    rows, deviation, in_motion = _deviations(t, np.diff(positions), np.diff(track))
    if not len(rows):
        return []
    usual, driven_rows = float(np.median(deviation[in_motion])), rows[in_motion]
    smooth = deviation[in_motion] < max(SMOOTH_LIMIT * usual, min(FINE_LIMIT, FINE_SHARE * usual))
    spans: list[tuple[float, float, float]] = []
    # jumps below the stated error are caused by changes of satellites
    jump_limit = np.maximum(max(JUMP_SIZE * usual, SHORTEST_JUMP), sigma[rows])
    for k in np.flatnonzero(deviation > jump_limit):
        last = int(np.searchsorted(driven_rows, rows[k]))
        first = _smooth_begin(smooth[:last])
        if first == last:
            continue
        # fixes since the previous compared one may be dead-reckoned too
        begin = float(t[max(driven_rows[first] - 2, 0)])
        # the row after a jump has the same deviation
        if not spans or begin > spans[-1][1]:
            spans.append((begin, float(t[rows[k] + 1]), float(deviation[k])))
    return spans


def _deviations(t: Floats, fix_steps: Complexes,
                track_steps: Complexes) -> tuple[Ints, Floats, Bools]:
    """
    Return rows of fix_steps, their deviations, m, and True if they and the rows before are moving.

    t : (k,) s.   fix_steps, track_steps : (k - 1,) displacements by fixes and by the track, m. The
    ratio of the two, a scale and a rotation, should be that of the last row in motion before,
    which may not be adjacent: a jump may come at a standstill. Empty with too few rows in motion.
    """
    dt = np.diff(t)
    complete = dt < MISSING_INTERVALS * np.median(dt)
    moving = complete & (np.abs(track_steps) > MIN_DISPLACEMENT)
    before = np.maximum.accumulate(np.where(moving, np.arange(len(track_steps)), -1))[:-1]
    rows = np.flatnonzero(complete[1:] & (before >= 0)) + 1
    before = before[rows - 1]
    in_motion = moving[rows] & (before == rows - 1)
    if in_motion.sum() <= SMOOTH_ROWS:
        return rows[:0], np.empty(0), in_motion[:0]
    ratio = fix_steps[before] / track_steps[before]
    acceleration = np.gradient(track_steps) / np.median(dt)
    change = acceleration[rows] - acceleration[before] * track_steps[rows] / track_steps[before]
    deviation = _without_delay(fix_steps[rows] - ratio * track_steps[rows], ratio * change)
    return rows, deviation, in_motion


def _without_delay(deviation: Complexes, delay_rate: Complexes) -> Floats:
    """Return sizes of deviations, (n,) m, without the part by a common delay; delay_rate: m/s."""
    size = np.maximum(np.abs(delay_rate), 1e-9)
    delays = (deviation * delay_rate.conj()).real / size**2
    order = np.argsort(delays)
    weight = np.cumsum(size[order])
    delay = delays[order[np.searchsorted(weight, weight[-1] / 2)]]    # weighted median
    return np.asarray(np.abs(deviation - delay * delay_rate * (abs(delay) > JUMP_DELAY)))


def _smooth_begin(smooth: Bools) -> int:
    """Return the first row of the smooth section at the end, or the length if there is none."""
    begin = len(smooth)
    while begin >= SMOOTH_ROWS and smooth[begin - SMOOTH_ROWS:begin].mean() >= SMOOTH_SHARE:
        begin -= 1
    return begin if begin == len(smooth) else begin - SMOOTH_ROWS + 1 + int(
        np.argmax(smooth[begin - SMOOTH_ROWS + 1:]))
