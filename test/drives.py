# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulated drives for tests: made once, changed as copies; and their settings."""

from dataclasses import fields, replace
from functools import wraps
import inspect

import numpy as np

from odocal_ros.data.samples import OdometerForm, OdometerSamples, take
from odocal_ros.forecast.planned_drive import drive_from_rates
from odocal_ros.forecast.robot_motion import MOTION_STEP, RobotMotion
from odocal_ros.forecast.thinned_leg import ThinnedLeg
from odocal_ros.nav.rotations import exp_so3
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config import Config, HOLONOMIC, with_settings
from odocal_ros.sim.scenarios import motion_of, SimOptions, simulate
from odocal_ros.sim.truth import operator_settings

ANGLES = ('yaw_mounting_angle', 'pitch_mounting_angle')
LOW_RATES = {'imu_rate': 50.0, 'odometer_rate': 20.0}
STRAIGHT = {'scenario': 'straight', 'duration': 200.0, 'imu_grade': 'tactical', 'seed': 5}
TOWN = {'scenario': 'town', 'duration': 300.0, 'imu_grade': 'industrial', 'seed': 4}


def cached(function):
    """
    Return a function that computes once for equal arguments in any notation.

    To functools.cache, a default that is written out, or another order, is another argument.
    """
    known, signature = {}, inspect.signature(function)

    @wraps(function)
    def once(*args, **options):
        bound = signature.bind(*args, **options)
        bound.apply_defaults()
        key = repr([(name, sorted(value.items()) if isinstance(value, dict) else value)
                    for name, value in bound.arguments.items()])
        if key not in known:
            known[key] = function(*args, **options)
        return known[key]
    return once


@cached
def drive(**options):
    """Return a drive at low rates; equal options give the same one."""
    return simulate(SimOptions(**(LOW_RATES | options)))


def settings(made, heading_sigma=1e-3, **changes):
    """
    Return the settings of a drive with its true heading, and changes as group__name.

    The method is the quick one, two_point, by default.
    """
    o = made.options
    known = {
        'method': 'two_point',
        'odometer.nominal_scale': float(o.nominal_scale),
        'odometer.lever_arm': tuple(map(float, o.odometer_lever_arm)),
        'imu.lever_arm': tuple(map(float, o.imu_lever_arm)),
        'gnss.lever_arm': tuple(map(float, o.antenna_lever_arm)),
        'imu.mounting_rpy': tuple(map(float, o.mounting_rpy)),
        'imu.grade': 'navigation' if o.imu_grade == 'perfect' else o.imu_grade,
        'verdict.max_yaw_sigma': 0.1, 'verdict.max_scale_sigma': 0.1}
    if heading_sigma is not None:
        known |= {'alignment.heading': float(made.truth.heading),
                  'alignment.heading_sigma': heading_sigma}
    return with_settings(Config(), known | {k.replace('__', '.'): v for k, v in changes.items()})


def configured(made):
    """Return the settings that the operator of a drawn vehicle has."""
    return with_settings(Config(), {f'{group}.{key}': tuple(v) if isinstance(v, list) else v
                                    for group, keys in operator_settings(made).items()
                                    for key, v in keys.items()})


def changed(samples, **columns):
    """Return samples with columns changed: by (rows, value) or by functions of a copy."""
    arrays = {f.name: np.array(getattr(samples, f.name)) for f in fields(samples)}
    for name, change in columns.items():
        if isinstance(change, tuple):
            rows, value = change
            arrays[name][rows] = value
        elif (result := change(arrays[name])) is not None:
            arrays[name] = result
    return type(samples)(**arrays)


def with_columns(leg, slot, **columns):
    """Return a leg with columns of a topic ``changed``."""
    return leg.with_rows(**{slot: changed(leg.rows(slot), **columns)})


def kept(leg, slot, rows):
    return leg.with_rows(**{slot: take(leg.rows(slot), rows)})


def without(leg, slot, begin=-np.inf, end=np.inf):
    """Return a leg without the rows of a topic between times after its start mark, s."""
    t = seconds(leg, leg.rows(slot))
    return kept(leg, slot, (t < begin) | (t > end))


def with_increments(leg):
    step = np.diff(leg.odometer.value, prepend=leg.odometer.value[:1])
    return replace(leg, odometer=replace(leg.odometer, value=step),
                   form=OdometerForm('increment', 0, 'm/pulse'))


def seconds(leg, samples):
    """Return the times of rows, s since the start mark."""
    return (samples.stamp_ns - leg.start_ns) * 1e-9


def shifted(leg, **marks):
    """Return a leg with its marks moved by seconds: start=, stop=."""
    return replace(leg, **{f'{name}_ns': getattr(leg, f'{name}_ns') + round(s * 1e9)
                           for name, s in marks.items()})


def planned(motion, options):
    t = np.arange(0.0, motion.duration + 1e-9, 0.1)
    return drive_from_rates(t, motion.speed(t), motion.yaw_rate(t), options.heading,
                            latitude=options.latitude, longitude=options.longitude,
                            height=options.height)


def two_point(leg, config, **more):
    return calibrate(leg, config, **more).methods['two_point']


def reason_texts(result):
    reasons = [*result.reasons, *(r for m in result.methods.values() for r in m.reasons)]
    return {r.code: r.text for r in reasons}


def errors_in_sigmas(result, truth):
    """Return (estimate - truth) / sigma of scale, yaw and pitch, if they are estimated."""
    e = result.methods['two_point'].estimates
    true = {'scale_factor': truth.scale, 'yaw_mounting_angle': truth.yaw,
            'pitch_mounting_angle': truth.pitch}
    return {k: (e[k].value - v) / e[k].sigma for k, v in true.items() if e[k].value is not None}


def off(found, made, *names):
    """Return the largest error over sigma of the named estimates, by default of the scale."""
    truth, estimates = made.truth, getattr(found, 'estimates', found)
    true = {'scale_factor': truth.scale, 'yaw_mounting_angle': truth.yaw,
            'pitch_mounting_angle': truth.pitch, 'track_width': made.options.track_width,
            **{f'scale_factor_{side}': scale for side, scale in zip(
                ('left', 'right'), truth.wheel_scales or (), strict=False)}}
    return np.max([abs(estimates[name].value - true[name]) / estimates[name].sigma
                   for name in names or ('scale_factor',)])


def rejecting(result):
    return {c for c in reason_texts(result) if c.severity.value == 'rejected'}


def delayed_in_bursts(samples, every_s=15.0, how_long_s=0.12, drain_s=1e-3):
    """Return odometer rows over an interrupted line, and which rows are delayed."""
    t = (samples.stamp_ns - samples.stamp_ns[0]) * 1e-9
    free = np.where(t % every_s < how_long_s, t - t % every_s + how_long_s, t)
    for k in range(1, len(free)):        # one after the other
        free[k] = max(free[k], free[k - 1] + drain_s)
    stamps = samples.stamp_ns[0] + np.round(free * 1e9).astype(np.int64)
    return OdometerSamples(stamps, stamps, samples.value), free - t > drain_s


def thinned(leg, stop_s=float('inf'), begin_s=float('-inf'), into=None):
    """Return the cells of a leg between times after its start mark, s, added to ``into``."""
    cells = into or ThinnedLeg(leg.form)
    for slot in ('imu', 'odometer', 'odometer_right', 'fix'):
        rows = leg.rows(slot)
        t = (rows.stamp_ns - leg.start_ns) / 10**9
        cells.feed(slot, take(rows, (t > begin_s) & (t <= stop_s)))
    return cells


def turned(imu, at_ns, turn):
    """Return samples of an IMU that is rotated by rad within a second, also in its gyro."""
    since = np.clip((imu.stamp_ns - at_ns) * 1e-9, 0.0, 1.0)
    angle = np.outer(since**2 * (3 - 2 * since), turn)
    w, f = (np.einsum('kji,kj->ki', exp_so3(angle), x) for x in (imu.w_i, imu.f_i))
    return replace(imu, w_i=w + np.outer(6 * since * (1 - since), turn), f_i=f)


def robot_motion(options):
    """Return the motion of a simulated drive as that of a planned run, without rests."""
    simulated = motion_of(options)
    t = MOTION_STEP * np.arange(int(simulated.duration / MOTION_STEP) + 1)
    state = simulated.at(t)
    side_speed = state.sway[:, 0] * (options.drive in HOLONOMIC)
    return RobotMotion(t, state.speed, side_speed, state.yaw_rate, np.empty((0, 2)))
