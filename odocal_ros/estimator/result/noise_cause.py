# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cause of IMU noise above its grade: quantisation, vibration, or the sensor itself."""

from collections.abc import Collection

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.pieces import Array, by_row, thinned
from odocal_ros.estimator.imu_noise import of_samples
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem

FINEST = 1e-5           # rad/s and m/s^2, physical: finer steps have no effect
SAMPLES = 20_000        # judgement: fewest rows for the detection of a step
ROWS_A_VALUE = 20       # judgement: a signal that holds so few values is quantised
EXPLAINED = 0.4         # judgement: share of the noise variance that quantisation must have
# judgement: times that single samples vary more in motion than at rest. Real drives: vibrating
# accelerometers 26 and 3.6, gyros 1.3 and 2.0
VIBRATION = 3.0
MOST_SAMPLES = 2**18    # judgement: their median has a sigma of 0.2 %; more only take memory
FEWEST_ROWS = 100       # judgement: samples at rest, whose median then has a sigma of 15 %
NAMES = {'gyro': 'gyro', 'accel': 'accelerometer'}
UNITS = {'gyro': 'rad/s/sqrt(Hz)', 'accel': 'm/s^2/sqrt(Hz)'}    # of white noise


def noise_remedy(problem: Problem, level: dict[str, float], worse: list[str]) -> str:
    """
    Return the cause of a noise that exceeds its grade, with the evidence, and what to do.

    level : roots of the white noise levels of 'gyro' and 'accel', SI per sqrt(Hz).
    worse : those of 'gyro' and 'accel' that exceed their grade; empty: no text.
    """
    if not worse:
        return ''
    coarse = {name: step for name, step in quantised(problem.leg, level).items() if name in worse}
    vibrating: dict[str, str] = {}
    own: list[str] = []
    unknown: list[str] = []
    moving, rest = at_rest_and_moving(problem)
    for name in (name for name in worse if name not in coarse):
        still, vary = rest.get(name, 0.0), moving.get(name, 0.0)
        if still and vary > VIBRATION * still:
            vibrating[name] = (f'{NAMES[name]} samples vary {vary / still:.0f} times as much '
                               'in motion as at rest')
        elif not still and vary > VIBRATION * level[name]:
            vibrating[name] = (f'{NAMES[name]} samples vary {vary / level[name]:.0f} times as '
                               'much as their means over seconds')
        else:       # less at rest than its integral
            (own if VIBRATION * still > level[name] else unknown).append(name)
    said = []

    def cause(names: Collection[str]) -> str:
        """Return the subject of a cause, with the sensors if others have another cause."""
        of = ' and '.join(NAMES[name] for name in names)
        return 'The cause' + f' of the {of} noise' * (len(names) < len(worse))
    if coarse:
        said.append(f'{cause(coarse)} is quantisation: {_steps_in_words(coarse)}. Set a finer '
                    'resolution or a smaller range in the IMU or its driver, if there is one.')
    if vibrating:
        said.append(f'{cause(vibrating)} is vibration: {", ".join(vibrating.values())}. Mount '
                    'the IMU firmly and away from the engine.')
    said += [f'The {NAMES[name]} noise does not come from vibration: at rest it is similar. If '
             f'this is its normal noise, {_setting(name, level)}' for name in own]
    said += [f'The cause of the {NAMES[name]} noise is unknown: ' + (
        'single samples vary less than their means over seconds. ' if rest else
        'there is no standstill to compare with. ')
        + f'Mount the IMU firmly. If this is its normal noise, {_setting(name, level)}'
        for name in unknown]
    return ' '.join(said)


def at_rest_and_moving(problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
    """Return the white noise of single samples in motion and at rest; {}: too few samples."""
    leg, keys = problem.leg, problem.imu.t[problem.imu.key]
    still = problem.still[:-1] & problem.still[1:]

    def part(t: Floats) -> Array:
        """Return 0 in motion, 1 at rest, 2 outside the keyframes."""
        at = np.searchsorted(keys, t, side='right') - 1
        inside = (t >= keys[0]) & (t < keys[-1])
        return np.where(inside, still[np.clip(at, 0, len(keys) - 2)], 2).astype(np.uint8)

    parts = by_row(part, leg.t_imu)
    moving, rest = (of_samples(leg, rows) if len(rows) >= FEWEST_ROWS else {} for rows in (
        np.flatnonzero(parts == kind)[:MOST_SAMPLES] for kind in (0, 1)))
    return moving, rest


def _setting(name: str, level: dict[str, float]) -> str:
    return f'set imu.{name}_noise to {level[name]:.2g} ({UNITS[name]}).'


def _steps_in_words(steps: dict[str, float]) -> str:
    return ' and '.join(
        f'the {NAMES[name]} has steps of ' + (
            f'{np.rad2deg(step):.3g} deg/s' if name == 'gyro' else f'{step:.3g} m/s^2')
        for name, step in steps.items())


def steps(leg: SmootherLeg) -> dict[str, float]:
    """Return the quantisation steps of gyro, rad/s, and accelerometer, m/s^2; 0: none."""
    return {'gyro': _step(leg.w_b), 'accel': _step(leg.f_b)}


def quantised(leg: SmootherLeg, level: dict[str, float]) -> dict[str, float]:
    """
    Return the steps of those sensors whose noise their quantisation explains.

    level : roots of the white noise levels of 'gyro' and 'accel', SI per sqrt(Hz).
    """
    interval = float(np.median(np.diff(leg.t_imu[:SAMPLES])))
    return {name: step for name, step in steps(leg).items()
            if step**2 / 12 * interval > EXPLAINED * level[name]**2}


def _step(x: Floats) -> float:
    """Return the largest step of the columns of a signal."""
    rows = thinned(x, SAMPLES)
    found = 0.0
    for column in rows.T:
        values = np.unique(np.round(column / FINEST))
        if 2 < len(values) < len(rows) / ROWS_A_VALUE:
            found = max(found, float(np.median(np.diff(values))) * FINEST)
    return found
