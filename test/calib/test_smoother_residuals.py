# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Residuals of the smoother: compared with recomputed equations, closed forms, drawn errors."""

from dataclasses import replace

from drives import cached, changed
import numpy as np
import pytest
from smoother_legs import leg_of, made, truth

from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.factors.gnss import Fixes
from odocal_ros.estimator.factors.motion import D, PHI, V
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.result.residuals import bias_sigmas, stored_residuals
from odocal_ros.estimator.smoother import best_fit

pytestmark = pytest.mark.slow
SHORT = {'duration': 200.0, 'imu_grade': 'industrial'}


@cached
def fitted(**options):
    drive, config, leg = made(**(SHORT | options))
    problem = make_problem(leg, config)
    return drive, config, leg, problem, best_fit(problem, config)


def in_halves(rows):
    return np.hsplit(rows.astype(float), 2)


def odometer_residuals(leg, config):
    """Return the fit of a leg, and the odometer's residuals and sigmas."""
    problem = make_problem(leg, config)
    fit = best_fit(problem, config)
    return fit, *in_halves(stored_residuals(leg, problem, fit)['residual_odometer'])


def test_residuals_equal_those_of_the_equations_recomputed_at_the_estimate():
    """The fit linearises its rows to first order; its last step is within 0.03 sigma."""
    _, _, leg, problem, fit = fitted()
    found = stored_residuals(leg, problem, fit)
    again = Equations(problem, fit.state, fit.priors, fit.variance_factors, True)
    motion = again.factors[MotionRows.name].motion
    begin, end = (np.swapaxes(C, 1, 2) for C in (motion.C, motion.C_end))
    middle = np.swapaxes((motion.C + motion.C_end) @ fit.state.C_bv, 1, 2) / 2
    for name, expected in (
            ('gyro', np.einsum('kij,kj->ki', end, motion.residual[:, PHI]) / motion.T),
            ('accelerometer', np.einsum('kij,kj->ki', begin, motion.residual[:, V]) / motion.T),
            ('odometer', np.einsum('kij,kj->ki', middle, motion.residual[:, D])),
            ('fix', -again.factors[Fixes.name].raw)):
        value, sigma = in_halves(found[f'residual_{name}'])
        if name == 'odometer':      # its rows end before the end of the last second
            value, sigma, expected = value[:-1], sigma[:-1], expected[:-1]
        # the delay may change by a tenth of its 0.7 ms. One count more or less at 20 Hz, 0.43 m/s,
        # at either end is then 0.06 mm; the counts before and after may differ by twice as much.
        # The mean of two axes is shorter by an eighth of the squared turn between them
        counts = 1.2e-4 if name == 'odometer' else 0.0
        near = 0.2 + 0.03 * np.abs(value / sigma).max(axis=1, keepdims=True)
        assert np.all(np.abs(value - expected) < np.maximum(near * sigma, counts)), name
        assert np.abs(expected / sigma).max() > 0.5, 'there is something to compare'


def test_residual_sigmas_are_those_of_white_noise_over_an_interval():
    """White noise of density s gives a mean over T a sigma of s / sqrt(T)."""
    _, _, leg, problem, fit = fitted()
    found = stored_residuals(leg, problem, fit)
    T = np.diff(fit.state.t)
    _, sigma = in_halves(found['residual_gyro'])
    # the random walk of the bias adds less than 1e-3
    np.testing.assert_allclose(sigma, np.sqrt(fit.levels['gyro'] / T)[:, None].repeat(3, 1),
                               rtol=1e-3)
    _, sigma = in_halves(found['residual_accelerometer'])
    # gyro noise rotates gravity: most of the horizontal sigma
    assert np.all(sigma > 0.999 * np.sqrt(fit.levels['accel'] / T)[:, None])
    np.testing.assert_allclose(sigma[problem.at_rest[1:], 2], np.sqrt(
        fit.levels['accel'] / T)[problem.at_rest[1:]], rtol=0.02)
    _, sigma = in_halves(found['residual_fix'])
    stated = np.sqrt(np.einsum('mii->mi', leg.covariance_n[problem.used_fixes]))
    factor = np.sqrt([fit.levels['fix'], fit.levels['fix'], fit.levels['fix_up']])
    np.testing.assert_allclose(sigma, stated * factor, rtol=1e-3)


def test_wheel_slip_appears_in_the_residuals_at_its_time():
    drive, config, *_ = fitted()
    begin, seconds, metres = 100.0, 1.0, 1.0
    rows = drive.leg()
    share = np.clip(((rows.odometer.stamp_ns - rows.start_ns) * 1e-9 - begin) / seconds, 0.0, 1.0)
    more = np.round(share * metres / drive.truth.scale).astype(int)
    leg = leg_of(replace(rows, odometer=changed(rows.odometer, value=lambda value: value + more)),
                 config)
    fit, value, sigma = odometer_residuals(leg, config)
    t, along = fit.state.t, value[:, 0]
    slipping = (t[1:] > begin) & (t[:-1] < begin + seconds)
    # the fitted path is shorter than the wheel travel; the IMU determines the path length of a
    # second to 1 mm; the slip is 1 - (IMU variance over slip variance) of the difference
    assert along[slipping].sum() == pytest.approx(-metres, rel=0.05)
    assert np.abs(along[:-1][~slipping[:-1]]).max() < 0.02      # last interval: rows end earlier
    assert np.abs(along / sigma[:, 0])[:-1].max() < 4, 'its sigma was widened'


def test_odometer_residuals_are_nan_without_odometer_data():
    drive, config, *_ = fitted()
    rows = drive.leg()
    when = (rows.odometer.stamp_ns - rows.start_ns) * 1e-9
    leg = leg_of(replace(rows, odometer=changed(rows.odometer, **dict.fromkeys(
        ('stamp_ns', 'received_ns', 'value'), lambda column: column[when < 150.0]))), config)
    fit, value, sigma = odometer_residuals(leg, config)
    absent = fit.state.t[1:] > 152.0
    assert absent.sum() > 20
    assert np.isnan(value[absent]).all()
    assert np.isnan(sigma[absent]).all()
    assert np.isfinite(value[fit.state.t[1:] < 148.0]).all()


def test_sigmas_of_the_biases_hold_over_the_whole_drive():
    errors_in_sigmas = []
    for seed in range(1, 9):
        drive, config, leg, _, fit = fitted(seed=seed, duration=120.0)
        true = truth(drive, config, leg)
        sigma = bias_sigmas(fit.solved.marginals(), 1.0)
        off = np.stack([fit.state.gyro_bias - true.gyro_bias,
                        fit.state.accel_bias - true.accel_bias])
        errors_in_sigmas.append(off / sigma)
        assert sigma.shape == (2, len(fit.state.t), 3)
        assert sigma[0, len(true.t) // 2, 2] < 0.99 * sigma[0, 0, 2], 'least amid the drive'
    z = np.sqrt((np.array([one[:, ::50].copy() for one in errors_in_sigmas])**2).mean(axis=(0, 2)))
    # rms of 8 drives, each axis about one draw: 0.35 to 1.75 in 999 of 1000 by chi2 of 8
    assert z.min() > 0.35
    assert z.max() < 1.75
