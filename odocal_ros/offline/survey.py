# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Facts on each topic for odocal inspect, as dicts, and the path of the fixes.

An odometer is recognised by its travel, which is proportional to the length of that path.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from odocal_ros.calib.drive import find_reachable, fix_white_noise, path_and_chord
from odocal_ros.data.arrays import Floats, Ints, lengths, median, medians, reduce_columns
from odocal_ros.data.samples import FixSamples, ImuSamples, OdometerForm, OdometerSamples, take
from odocal_ros.nav.coarse_speed import MIN_NUMBER
from odocal_ros.screening.fix_screen import has_position, usable_fixes
from odocal_ros.screening.glitches import is_impossible, without_invalid_orientations
from odocal_ros.screening.inputs import Inputs, LocatedFixes, median_origin
from odocal_ros.screening.late_rows import arrival_jitter
from odocal_ros.settings.config import Config, GnssConfig
from odocal_ros.settings.nominal import G

AXES = 'xyz'
# minimum share of the variance of the distances between fixes that an odometer explains; second
# number: if the rest is within the fix errors. Tuned by benchmarks/odometer_fields.py and 3 real
# drives: odometers explain 0.90 or more (0.65 where fix errors are most of the variance: always
# 1 m/s, fixes of 0.8 m), time and temperature 0.48 or less; engine speed, gear and consumed energy
# up to 0.98, so this does not exclude them
EXPLAINED, EXPLAINED_OF_NOISE = 0.9, 0.5
RATE_LIMIT_HZ = 1e5    # judgement: no sensor is faster; almost equal stamps give such rates
MIN_STEPS = 10      # judgement: cells of a path that can be compared
# s, judgement: delays have a standard deviation of 0.24 s if stamps are rounded down to seconds,
# of some ms if a receiver has its epochs at whole seconds
WHOLE_SECONDS_LIMIT = 0.15


def rate_of(count: int, seconds: float) -> float | None:
    """Return a rate, Hz; None if it is unknown because stamps are equal or almost equal."""
    rate = count / seconds if seconds > 0 else 0.0
    return rate if 0 < rate < RATE_LIMIT_HZ else None


def timing_facts(samples: FixSamples | ImuSamples | OdometerSamples, start_ns: int,
                 headerless: bool) -> dict[str, Any]:
    """
    Return rate, gaps and irregular stamps of a topic.

    ``gaps``: the ten longest, ``at`` in seconds from the bag's first message; ``header_to_bag``:
    median delay from header stamp to recording, s, and ``header_to_bag_spread`` its standard
    deviation, None without a header; ``arrival_jitter``: standard deviation of arrivals without a
    header, s; ``whole_seconds``: the stamps are rounded down to seconds.
    """
    stamped = samples.stamp_ns > 0
    stamp, received = samples.stamp_ns[stamped], samples.received_ns[stamped]
    step = np.diff(stamp) * 1e-9
    rising = step[step > 0]
    median_step = median(rising) if len(rising) else 0.0
    gap_factor, min_gap = 5.0, 0.1    # a gap is longer than 5 median intervals, and than 0.1 s
    gaps = np.flatnonzero(step > max(gap_factor * median_step, min_gap))
    longest = gaps[np.argsort(-step[gaps], kind='stable')][:10]
    delay: Floats = np.multiply(received - stamp, 1e-9)
    # 95 % of a normal distribution are within 4 standard deviations
    spread = None if headerless or not len(delay) else float(
        np.subtract(*np.percentile(delay, [97.5, 2.5])) / 4)
    # mean rate outside the gaps; the median interval would be wrong with bursts
    duration = float(rising.sum() - step[gaps].sum())
    return {
        'rate_hz': rate_of(len(rising) - len(gaps), duration),
        'headerless': headerless,
        'header_to_bag': None if headerless or not len(delay) else median(delay),
        'header_to_bag_spread': spread,
        'whole_seconds': bool(len(stamp) and (spread or 0.0) > WHOLE_SECONDS_LIMIT
                              and (stamp % 10**9 == 0).all()),
        'arrival_jitter': arrival_jitter(
            np.maximum.accumulate(stamp - start_ns) * 1e-9) if headerless else None,
        'zero_stamps': int((~stamped).sum()), 'repeated_stamps': int((step == 0).sum()),
        'backward_steps': int((step < 0).sum()), 'gap_count': len(gaps),
        'gaps': [{'at': (int(stamp[k]) - start_ns) * 1e-9, 'length': float(step[k])}
                 for k in np.sort(longest)]}


def imu_facts(samples: ImuSamples) -> dict[str, Any]:
    """
    Return gravity, units and orientation of an IMU topic.

    ``gravity``: median specific force in ``force_unit``; ``gravity_axis``: axis of the IMU next to
    it, and ``tilt_from_axis`` the angle between them, rad; ``fastest_turn``: 99.9 % quantile of
    the turn rate, in its unit; ``orientation_refused``: share of messages that state that they
    have none; ``yaw_sigma``: median stated sigma of the yaw, rad.
    """
    samples = without_invalid_orientations(samples)
    f_i = samples.f_i[~is_impossible('f_i', samples.f_i)]
    w_i = samples.w_i[~is_impossible('w_i', samples.w_i)]
    median_f_i = medians(f_i) if len(f_i) else np.zeros(3)
    size = float(np.linalg.norm(median_f_i))
    axis = int(np.argmax(np.abs(median_f_i)))
    tilt = float(np.arccos(np.clip(abs(median_f_i[axis]) / size, 0, 1))) if size else 0.0
    units = {'m/s^2': 0.85 * G < size < 1.15 * G, 'g': 0.85 < size < 1.15, 'unknown': True}
    fastest = float(np.percentile(lengths(w_i - medians(w_i)), 99.9)) if len(w_i) else 0.0
    has_orientation = ~np.isnan(samples.yaw_variance)
    rotated = has_orientation & (reduce_columns(np.maximum, np.abs(samples.q_ni[:, :3])) > 1e-9)
    variance = samples.yaw_variance[rotated]
    known_variance = variance[variance > 0]
    return {
        'gravity': size, 'gravity_axis': f'{"+" if median_f_i[axis] > 0 else "-"}{AXES[axis]}',
        'tilt_from_axis': tilt, 'up_i': (median_f_i / (size or 1.0)).tolist(),
        'force_unit': next(unit for unit, fits in units.items() if fits),
        'fastest_turn': fastest,
        'not_finite': len(samples.stamp_ns) - min(len(f_i), len(w_i)),
        # an identity that never changes is a default, not an attitude
        'orientation': bool(rotated.mean() > 0.5) if len(rotated) else False,
        'orientation_refused': float((~has_orientation).mean()) if len(has_orientation) else 0.0,
        'yaw_sigma': float(np.sqrt(np.median(known_variance))) if len(known_variance) else None}


def measured_quantities(samples: ImuSamples) -> tuple[bool, bool]:
    """Return two flags of an IMU topic: it has turn rates, it has specific forces."""
    return bool(np.nan_to_num(samples.w_i).any()), bool(np.nan_to_num(samples.f_i).any())


def turn_rate_to_left(samples: ImuSamples) -> tuple[Ints, Floats] | None:
    """Return stamps, ns, and the turn rate about the vertical, rad/s, (n,); None without rows."""
    rows = take(samples, ~(is_impossible('f_i', samples.f_i) | is_impossible('w_i', samples.w_i)))
    if not len(rows.stamp_ns):
        return None
    up_i = medians(rows.f_i)
    return rows.stamp_ns, rows.w_i @ (up_i / max(float(np.linalg.norm(up_i)), 1e-9))


def odometer_facts(samples: OdometerSamples, form: OdometerForm) -> dict[str, Any]:
    """Return quantity, unit and range of an odometer topic."""
    value = samples.value[~is_impossible('value', samples.value)]
    extremes = dict.fromkeys(('first', 'last', 'minimum', 'maximum')) if not len(value) else {
        'first': value[0].item(), 'last': value[-1].item(), 'minimum': value.min().item(),
        'maximum': value.max().item()}
    return {'quantity': form.quantity, 'scale_unit': form.scale_unit, 'modulus': form.modulus,
            **extremes, 'not_finite': len(samples.value) - len(value)}


def fix_facts(samples: FixSamples) -> dict[str, Any]:
    """Return status counts, stated sigmas (m), resolution (m) and heights (m) of a fix topic."""
    covariance = np.diagonal(samples.covariance_n, axis1=1, axis2=2)
    known = (samples.covariance_type > 0) & (covariance[:, :2] > 0).all(axis=1) \
        & ~is_impossible('covariance_n', covariance)
    sigma = np.sqrt(covariance[known, :2].max(axis=1)) if known.any() else np.empty(0)
    positioned = has_position(samples)
    heights = samples.height[positioned & ~is_impossible('height', samples.height)]
    values, counts = np.unique(samples.status, return_counts=True)
    return {
        'status': dict(zip(map(str, values.tolist()), counts.tolist(), strict=True)),
        'positions': int(positioned.sum()), 'covariance_known': int(known.sum()),
        'sigma': {'minimum': float(sigma.min()), 'median': float(np.median(sigma)),
                  'maximum': float(sigma.max())} if len(sigma) else None,
        'position_step': _grid_step(samples.latitude[positioned]),
        'height': {'minimum': float(heights.min()), 'maximum': float(heights.max())}
        if len(heights) else None}


def _grid_step(latitude: Floats) -> float | None:
    """Return the resolution of latitudes, m, if it is coarser than 5 mm, else None."""
    earth_radius = 6.37e6    # m
    steps = np.abs(np.diff(np.unique(latitude))) * earth_radius
    steps = steps[steps > 1e-6]        # smaller ones are rounding errors of the number format
    if len(steps) < 10 or np.median(steps) < 0.005:
        return None
    step = float(steps.min())
    is_multiple = np.abs(steps / step - np.round(steps / step)) < 0.02
    return step if step > 0.005 and is_multiple.mean() > 0.95 else None


@dataclass(frozen=True)
class Match:
    """Comparison of a travel (sum of an odometer signal) with the path of the fixes."""

    explained: float     # share of the variance of the distances that the travel explains
    scale: float         # m per unit of travel, negative if it decreases with distance
    follows: bool        # the travel is proportional to the distance, within the fix errors


NO_MATCH = Match(0.0, 0.0, False)      # definition: result without a comparison


@dataclass(frozen=True, eq=False)
class FixPath:
    """Path of the fixes in cells of equal duration."""

    t_ns: Ints          # (k + 1,) edges, arrival times
    length: Floats      # (k,) m
    sigma: float        # of a fix, m

    def match(self, t_ns: Ints, travel: Floats) -> Match:
        """Return the comparison with a travel, (n,) in any unit at (n,) rising arrival times."""
        if len(t_ns) < MIN_STEPS:
            return NO_MATCH
        inside = (self.t_ns[:-1] >= t_ns[0]) & (self.t_ns[1:] <= t_ns[-1])
        step = np.diff(np.interp(self.t_ns, t_ns, travel))[inside]
        length, travelled = self.length[inside], np.abs(step)
        if len(length) < MIN_STEPS or not np.isfinite(travelled).all():
            return NO_MATCH
        moved = (travelled > MIN_NUMBER) & (length > length.mean())
        if not moved.any():
            return NO_MATCH
        error = np.abs(length - np.median(length[moved] / travelled[moved]) * travelled)
        outlier_share = 0.05      # of cells: resets of a counter, jumps of the fixes
        kept = error <= np.quantile(error, 1 - outlier_share)
        length, travelled, step = length[kept], travelled[kept], step[kept]
        if not travelled.any() or not np.ptp(length):
            return NO_MATCH
        scale = float(length.sum() / travelled.sum())
        residual_variance = float(np.mean((length - scale * travelled)**2))
        explained = 1 - residual_variance / float(np.var(length))
        follows = explained >= EXPLAINED or (
            explained >= EXPLAINED_OF_NOISE and residual_variance <= self.sigma**2)
        return Match(explained, scale if step.sum() >= 0 else -scale, follows)


def fix_path(rows: FixSamples, gnss: GnssConfig) -> FixPath | None:
    """Return the path of the usable fixes by arrival time; None if it is too short."""
    usable, covariance_n, _ = usable_fixes(rows, len(rows.stamp_ns), gnss)
    usable &= np.append(True, np.diff(rows.received_ns) > 0)
    if usable.sum() < MIN_STEPS:
        return None
    t_ns = rows.received_ns[usable]
    t = (t_ns - t_ns[0]) * 1e-9
    geodetic = np.stack([rows.latitude, rows.longitude, np.nan_to_num(rows.height)], -1)[usable]
    fixes_n = median_origin(t, geodetic).to_n(geodetic)
    reachable = find_reachable(t, fixes_n)
    t, t_ns, fixes_n = t[reachable], t_ns[reachable], fixes_n[reachable, :2]
    path_length = path_and_chord(t, fixes_n)[0]
    if path_length == 0:
        return None
    # duration of a cell, s: its mean path length is ten times the fix noise or more, so that the
    # noise of both ends is below 15 % of it
    min_duration, noise_ratio = 4.0, 10.0
    duration = max(min_duration,
                   noise_ratio * fix_white_noise(fixes_n) * (t[-1] - t[0]) / path_length)
    # first fix of each cell
    edges = np.unique(np.searchsorted(t[:-1], np.arange(t[0], t[-1], duration)))
    return FixPath(t_ns[edges], np.hypot(*np.diff(fixes_n[edges], axis=0).T),
                   float(np.sqrt(np.median(covariance_n[usable][:, 0, 0]))))


def stops_and_speeds(inputs: Inputs, scale: float, config: Config) -> tuple[Floats, list[float]]:
    """Return standstills, (k, 2) s, and lowest and highest speed, m/s; scale: 0 if unknown."""
    if len(inputs.t_imu) <= 3:
        return np.empty((0, 2)), [0.0, 0.0]
    interval = 1.0    # s, over which a speed is computed
    t = np.arange(inputs.travel.t[0], inputs.travel.t[-1] - interval, interval / 2)
    speed = np.abs(inputs.travel.at(t + interval) - inputs.travel.at(t)) * scale / interval
    return (inputs.standstills(scale or 1.0, config),
            [float(speed.min()), float(speed.max())] if len(t) else [0.0, 0.0])


def straight_sections(inputs: Inputs, located: LocatedFixes,
                      min_length: float) -> list[tuple[float, float]]:
    """Return (start, stop), s, of straight sections of ``min_length`` m or more, longest first."""
    if not located.rough_scale or len(inputs.t_fix) < 3:
        return []
    max_fixes = 600    # fixes tested for straight sections, evenly selected
    selected = np.unique(np.linspace(0, len(inputs.t_fix) - 1, max_fixes).astype(int))
    t, position = inputs.t_fix[selected], located.fixes_n[selected, :2]
    # between each two fixes
    travel = np.abs(inputs.travel.at(t[None]) - inputs.travel.at(t[:, None]))
    chord = np.hypot(*(position[None] - position[:, None]).transpose(2, 0, 1))
    is_long = chord >= min_length
    # chords are shorter than the path in curves, which reduces the rough scale: the straightest
    # sections determine it best
    ratio = chord[is_long] / np.maximum(travel[is_long], 1e-12)
    best = float(np.percentile(ratio, 95)) if len(ratio) else 0.0
    path_length = travel * max(located.rough_scale, min(best, 1.2 * located.rough_scale))
    # chord over path length: a section at least this straight suits the two-point method
    straight = 0.97
    # both end points have errors of sigma: a section within these errors is accepted
    suitable = np.triu((chord >= straight * path_length - located.fix_sigma)
                       & (path_length >= min_length)
                       & (chord <= path_length / straight + 4 * located.fix_sigma))
    sections: list[tuple[float, float]] = []
    while suitable.any():
        i, j = np.unravel_index(np.argmax(np.where(suitable, path_length, 0)), suitable.shape)
        sections.append((float(t[i]), float(t[j])))
        suitable[:j + 1, i:] = False            # all sections that overlap it
    return sections
