# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Selection of usable fixes and GNSS velocities, and the uncertainty of each fix.

In: fixes and velocities as received. Out: masks, covariances, and reasons for unused ones.
"""

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, running_sum
from odocal_ros.data.samples import FixSamples, LOCAL_STATUS
from odocal_ros.nav.geodesy import ecef_from_geodetic, radii
from odocal_ros.nav.time_series import running_integral
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import GnssConfig
from odocal_ros.settings.levels import FIX_NOISE_LIMIT, REMARK_SIGMAS

# m, judgement. Measured on eight zoo drives with blocks of fixes of 7 m among fixes of 0.01 to
# 1.5 m: without a limit the sigma of the scale is 1.2 to 24 times as large, as correlated errors
# have one level; error over sigma is the same. A drive with fixes of 3 to 7 m fails with it
DEFAULT_SIGMA_LIMIT = 3.0
# m, physical: no receiver with a position is less accurate; some drivers state more for unknown
LARGEST_SIGMA = 1000.0
# s, length of compared displacements: judgement, longer than delays of receivers
DISPLACEMENT_WINDOW = 10.0
VELOCITY_GAP = 2.0    # s, judgement: a longer one hides a change of speed
# of |z - 1| in velocity_reasons. Judgement: velocities and fixes differ by a few per cent, by
# far more with wrong axes, units and frames
VELOCITY_RATIO_LIMIT = 0.1
FINEST_ANGLE = 1e-10    # rad, physical: 0.6 mm: finer steps have no effect
# statistical: least number of differences of coordinates; those of unrounded values are all
# multiples of one step once in 10^9
MIN_DIFFERENCES = 10
OFF_GRID = 0.02         # judgement: limit of the deviation from a multiple of a step, in steps


def usable_fixes(fix: FixSamples, received_count: int, gnss: GnssConfig,
                 scope_text: str = '') -> tuple[Bools, Floats, tuple[Reason, ...]]:
    """
    Return a mask of usable fixes, (n,) bool, covariances, (n, 3, 3) m^2, and reasons.

    scope_text : which fixes ``received_count`` includes, in the reason.
    """
    no_fix = fix.status < gnss.min_status
    max_height = 1e4    # m, physical: no ground is higher; 10 km make the scale 0.16 % larger
    invalid = ~has_position(fix) | (abs(fix.height) > max_height)
    invalid = invalid | _far_from_median(fix, ~(invalid | no_fix))
    covariance, unknown = covariances(fix, gnss.default_sigma)
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]))
    limit = sigma_limit(sigma[~unknown & ~no_fix & ~invalid], gnss.max_sigma)
    inaccurate = (sigma > limit) & ~unknown
    usable = ~(no_fix | invalid | inaccurate)
    reasons: tuple[Reason, ...] = ()
    if (unknown & ~no_fix).any():
        local = bool((fix.status == LOCAL_STATUS).any())
        name = 'reference.default_sigma' if local else 'gnss.default_sigma'
        reasons += (Reason(
            Code.COVARIANCE_UNKNOWN, f'{int((unknown & ~no_fix).sum())} of {received_count} fixes '
            f'have no usable covariance; {gnss.default_sigma:g} m ({name}) is used',
            f'Set {name} to the real horizontal accuracy of the positions.' if local else ''),)
    rejected = [(f'{int(mask.sum())} {cause}', remedy) for mask, cause, remedy in (
        (no_fix, f'with status below {gnss.min_status}', 'Drive under open sky, or lower '
         'gnss.min_status if these fixes are good.'),
        (invalid & ~no_fix, _invalid_text(fix, invalid & ~no_fix), 'Check the driver: latitude '
         'and longitude in degrees (swapped?), altitude in m, no 0, 0 in place of a missing '
         'position.'),
        (inaccurate & ~no_fix & ~invalid, f'with sigma above {limit:.4g} m', 'If these '
         'uncertainties are correct, raise gnss.max_sigma (0: no limit): each fix is weighted by '
         'its own uncertainty.' if limit < LARGEST_SIGMA else 'Correct the driver: a sigma that '
         'is not known has position_covariance_type 0, not a large number.')) if mask.any()]
    if rejected:
        code = Code.BAD_ROWS_DROPPED if usable.any() else Code.FIXES_UNUSABLE
        causes, remedies = zip(*rejected, strict=True)
        reasons += (Reason(code, f'{int((~usable).sum())} of {received_count} '
                           f'fixes{scope_text} are not used: {", ".join(causes)}',
                           ' '.join(remedies)),)
    return usable, covariance, reasons


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
    median_sigma = float(np.median(sigma)) if len(sigma) else 0.0
    return min(max(DEFAULT_SIGMA_LIMIT, 2 * median_sigma), LARGEST_SIGMA)


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
    times = np.arange(t_fix[0], t_fix[-1], DISPLACEMENT_WINDOW)
    rows = np.unique(np.searchsorted(t_fix[:-1], times))      # the next fix after each time
    meridian, normal = radii(geodetic[0, 0])
    D = np.diff(geodetic[rows, 1] * normal * np.cos(geodetic[0, 0])
                + 1j * geodetic[rows, 0] * meridian)
    path = running_integral(t, velocity_n[:, :2]) @ [1, 1j]
    ends = t_fix[rows]
    V = np.diff(np.interp(ends, t, path))
    # motion in a gap of the velocity, or of the fixes, is not measured
    gaps_before = running_sum(np.diff(t) > VELOCITY_GAP)      # their number before each row
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


def rounding_variance(geodetic: Floats, covariance_n: Floats) -> tuple[Floats, tuple[Reason, ...]]:
    """
    Return the variances by rounding, (n, 3) m^2, and FIXES_NOISIER_THAN_SAID if they are large.

    A coordinate that is equal in m consecutive fixes has one error, uniform in its step, which
    their mean does not reduce: each has m times its variance.

    geodetic : (n, 3) latitude and longitude, rad, height, in order of time.   covariance_n : (n,
    3, 3) stated, m^2.
    """
    n = len(geodetic)
    variance = np.zeros((n, 3))
    angles = geodetic[:, 1::-1]     # along east and north
    steps = np.array([common_step(angle) for angle in angles.T])
    if not steps.any():
        return variance, ()
    # a coordinate that hardly changes has too few differences
    steps[steps == 0] = steps.max()
    latitude = float(np.median(geodetic[:, 0]))
    meridian, normal = radii(latitude)
    sizes = steps * (normal * np.cos(latitude), meridian)
    for axis, coordinate in enumerate(np.rint((angles - angles[0]) / steps).T):     # in steps
        first_equal = np.flatnonzero(np.diff(coordinate, prepend=np.nan))
        count = np.diff(first_equal, append=n)      # of consecutive fixes with equal coordinates
        variance[:, axis] = np.repeat(count, count) * sizes[axis]**2 / 12
    stated = np.sqrt(np.median(covariance_n.diagonal(axis1=1, axis2=2), axis=0)[:2])
    factor = float(np.hypot(1.0, sizes / np.sqrt(12) / stated).max())
    if factor <= FIX_NOISE_LIMIT:
        return variance, ()
    east, north = sizes
    return variance, (Reason(
        Code.FIXES_NOISIER_THAN_SAID, f'positions are rounded to {east:.2g} m east and '
        f'{north:.2g} m north: fix errors are {factor:.1f} times as large as their covariance '
        f'states (limit {FIX_NOISE_LIMIT:g}); accounted for', 'Publish latitude and longitude '
        'as double, unrounded or with at least 8 decimals of a degree (NMEA: 6 of a minute).'),)


def common_step(angle: Floats) -> float:
    """Return the greatest common divisor of differences of angles, (n,) rad; 0: none (Euclid)."""
    differences = np.diff(np.unique(angle))
    differences = differences[differences > FINEST_ANGLE]
    if len(differences) < MIN_DIFFERENCES:
        return 0.0
    step = float(differences.min())
    while step > FINEST_ANGLE:
        remainder = abs(differences - step * np.rint(differences / step))
        remainder = remainder[remainder > OFF_GRID * step]
        if not len(remainder):
            return step
        step = float(remainder.min())
    return 0.0
