# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Timing, units and quality of the samples of a topic, as plain numbers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats
from odocal_ros.data.pieces import across, lengths, median, medians
from odocal_ros.data.samples import FixSamples, ImuSamples, OdometerForm, OdometerSamples
from odocal_ros.screening.fix_screen import placed
from odocal_ros.screening.glitches import beyond, oriented
from odocal_ros.screening.late_rows import arrival_jitter
from odocal_ros.settings.grades import G

AXES = 'xyz'


def timing(samples: FixSamples | ImuSamples | OdometerSamples, start_ns: int,
           headerless: bool) -> dict[str, Any]:
    """
    Return rate, gaps and what is odd about the stamps of a topic.

    ``at`` is in seconds from the bag's first message; ``header_to_bag`` is how long after its
    header stamp a message was recorded, None without a header; ``arrival_jitter`` is the standard
    deviation of arrivals without a header, s.
    """
    stamped = samples.stamp_ns > 0
    stamp, received = samples.stamp_ns[stamped], samples.received_ns[stamped]
    step = np.diff(stamp) * 1e-9
    rising = step[step > 0]
    usual = median(rising) if len(rising) else 0.0
    gap = 5.0    # in median intervals: longer is a gap
    least_gap = 0.1    # s, shorter is jitter
    gaps = np.flatnonzero(step > max(gap * usual, least_gap))
    order = gaps[np.argsort(-step[gaps], kind='stable')][:10]
    lag: Floats = np.multiply(received - stamp, 1e-9)
    # mean of what lies between the gaps: bursts and gaps are no rate
    running = float(rising.sum() - step[gaps].sum())
    return {
        'rate_hz': (len(rising) - len(gaps)) / running if running > 0 else None,
        'headerless': headerless,
        'header_to_bag': None if headerless or not len(lag) else median(lag),
        'header_to_bag_spread': None if headerless or not len(lag) else float(
            np.subtract(*np.percentile(lag, [97.5, 2.5])) / 4),
        'arrival_jitter': arrival_jitter(
            np.maximum.accumulate(stamp - start_ns) * 1e-9) if headerless else None,
        'zero_stamps': int((~stamped).sum()), 'repeated_stamps': int((step == 0).sum()),
        'backward_steps': int((step < 0).sum()), 'gap_count': len(gaps),
        'gaps': [{'at': (int(stamp[k]) - start_ns) * 1e-9, 'length': float(step[k])}
                 for k in np.sort(order)]}


def imu(samples: ImuSamples) -> dict[str, Any]:
    """Return gravity, units and orientation of an IMU topic."""
    samples = oriented(samples)
    f_i = samples.f_i[~beyond('f_i', samples.f_i)]
    w_i = samples.w_i[~beyond('w_i', samples.w_i)]
    mean = medians(f_i) if len(f_i) else np.zeros(3)
    size = float(np.linalg.norm(mean))
    axis = int(np.argmax(np.abs(mean)))
    fast = float(np.percentile(lengths(w_i - medians(w_i)), 99.9)) if len(w_i) else 0.0
    there = ~np.isnan(samples.yaw_variance)
    turned = there & (across(np.maximum, np.abs(samples.q_ni[:, :3])) > 1e-9)
    variance = samples.yaw_variance[turned]
    known = variance[variance > 0]
    return {
        'gravity': size, 'gravity_axis': f'{"+" if mean[axis] > 0 else "-"}{AXES[axis]}',
        'tilt_from_axis': float(np.arccos(np.clip(abs(mean[axis]) / size, 0, 1))) if size else 0.0,
        'up_i': (mean / size).tolist() if size else [0.0, 0.0, 0.0],
        'force_unit': 'm/s^2' if 0.85 * G < size < 1.15 * G else 'g' if 0.85 < size < 1.15
        else 'unknown',
        'fastest_turn': fast,
        'not_finite': len(samples.stamp_ns) - min(len(f_i), len(w_i)),
        # an identity that never changes is a default, not an attitude
        'orientation': bool(turned.mean() > 0.5) if len(turned) else False,
        'orientation_refused': float((~there).mean()) if len(there) else 0.0,
        'yaw_sigma': float(np.sqrt(np.median(known))) if len(known) else None}


def odometer(samples: OdometerSamples, form: OdometerForm) -> dict[str, Any]:
    """Return the values that an odometer topic counts."""
    finite = samples.value[~beyond('value', samples.value)]
    return {'quantity': form.quantity, 'scale_unit': form.scale_unit, 'modulus': form.modulus,
            'first': _number(finite[:1]), 'last': _number(finite[-1:]),
            'least': _number(np.sort(finite)[:1]), 'most': _number(np.sort(finite)[-1:]),
            'not_finite': len(samples.value) - len(finite)}


def _number(array: NDArray[Any]) -> float | None:
    """Return the first of some numbers, as Python has it."""
    number: float | None = array[0].item() if len(array) else None
    return number


def fixes(samples: FixSamples) -> dict[str, Any]:
    """Return status and quality of fixes."""
    covariance = np.diagonal(samples.covariance_n, axis1=1, axis2=2)
    known = (samples.covariance_type > 0) & (covariance[:, :2] > 0).all(axis=1) \
        & ~beyond('covariance_n', covariance)
    sigma = np.sqrt(covariance[known, :2].max(axis=1)) if known.any() else np.empty(0)
    place = placed(samples)
    heights = samples.height[place & ~beyond('height', samples.height)]
    values, counts = np.unique(samples.status, return_counts=True)
    return {
        'status': dict(zip(map(str, values.tolist()), counts.tolist(), strict=True)),
        'positions': int(place.sum()), 'covariance_known': int(known.sum()),
        'sigma': {'least': float(sigma.min()), 'median': float(np.median(sigma)),
                  'most': float(sigma.max())} if len(sigma) else None,
        'position_step': _grid_step(samples.latitude[place]),
        'height': {'least': float(heights.min()), 'most': float(heights.max())}
        if len(heights) else None}


def _grid_step(latitude: Floats) -> float | None:
    """Return the step, m, in which latitudes come, where it is coarser than 5 mm."""
    steps = np.abs(np.diff(np.unique(latitude))) * 6.37e6
    steps = steps[steps > 1e-6]        # below that it is the last bit
    if len(steps) < 10 or np.median(steps) < 0.005:
        return None
    step = float(steps.min())
    whole = np.abs(steps / step - np.round(steps / step)) < 0.02
    return step if step > 0.005 and whole.mean() > 0.95 else None
