# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rounded positions have the uncertainty of their step, and others do not."""

from dataclasses import replace

from drives import ANGLES, configured, drive, off, reason_texts, TOWN, with_columns
import numpy as np
import pytest

from odocal_ros.nav.geodesy import radii
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.screening.fix_screen import rounding_variance
from odocal_ros.screening.screen import screen
from odocal_ros.sim.noise import make_rng

pytestmark = pytest.mark.core
LATITUDE, LONGITUDE = np.deg2rad(48.1), np.deg2rad(11.5)
MERIDIAN, NORMAL = radii(LATITUDE)
RADII = np.array([NORMAL * np.cos(LATITUDE), MERIDIAN])    # m per rad, east and north
STOP = 150      # fixes at a standstill


def float32(degrees):
    return degrees.astype(np.float32).astype(float)


def nmea(degrees):
    """Return angles rounded as degrees and minutes with four decimals."""
    whole = np.trunc(degrees)
    return whole + np.round((degrees - whole) * 60, 4) / 60


def decimals(n):
    return lambda degrees: np.round(degrees, n)


def rounded(kind):
    """Return a change of angles in rad, by a function of degrees."""
    return lambda angle: np.deg2rad(kind(np.rad2deg(angle)))


def fixes(seed=0, n=600, side=1.0):
    """Return fixes of a winding road with a standstill at its end, 2 m apart: (n, 3)."""
    place = np.cumsum(2 * (np.arange(n) < n - STOP) * np.exp(0.8j * np.sin(0.03 * np.arange(n))))
    place = np.stack([place.real, side * place.imag], -1) + make_rng(seed, 'place').uniform(size=2)
    place += 0.01 * make_rng(seed, 'noise').standard_normal((n, 2)) * (
        np.arange(n) < n - STOP)[:, None]
    return np.c_[(place / RADII + [LONGITUDE, LATITUDE])[:, ::-1], np.zeros(n)]


def stated(geodetic, sigma=0.015):
    return np.tile(sigma**2 * np.eye(3), (len(geodetic), 1, 1))


def errors(kind, geodetic):
    """Return rounded fixes, and their errors east and north, m."""
    made = geodetic.copy()
    made[:, :2] = rounded(kind)(geodetic[:, :2])
    return made, (made - geodetic)[:, 1::-1] * RADII


@pytest.mark.parametrize(('kind', 'steps_deg'), [
    (float32, (2**-20, 2**-18)), (nmea, (1e-4 / 60, 1e-4 / 60)), (decimals(5), (1e-5, 1e-5)),
    (decimals(6), (1e-6, 1e-6))])
def test_equal_coordinates_share_one_error_that_is_uniform_in_the_step(kind, steps_deg):
    made, error = errors(kind, fixes())
    variance, why = rounding_variance(made, stated(made))
    step = np.deg2rad(steps_deg) * RADII
    # closed form: the mean of the standstill has the variance of one rounding
    np.testing.assert_allclose(variance[-STOP:, :2].mean(axis=0) / STOP, step**2 / 12, rtol=0.1)
    # in motion each fix has another coordinate
    np.testing.assert_allclose(variance[:, :2].min(axis=0), step**2 / 12, rtol=1e-4)
    assert not variance[:, 2].any()
    assert (np.abs(error) <= 0.501 * step).all()
    assert [r.code for r in why] == [Code.FIXES_NOISIER_THAN_SAID]
    assert f'{step[0]:.2g} m east and {step[1]:.2g} m north' in why[0].text


def test_means_of_standstills_are_as_uncertain_as_stated():
    z = []
    for seed in range(40):
        made, error = errors(nmea, fixes(seed))
        variance, _ = rounding_variance(made, stated(made))
        z.append(error[-STOP:].mean(axis=0) / np.sqrt(variance[-STOP:, :2].mean(axis=0) / STOP))
    # statistical: a uniform error, 80 values: its rms has a sigma of 0.05
    assert abs(np.sqrt(np.mean(np.square(z))) - 1) < 0.2


def test_a_coordinate_that_hardly_changes_has_the_step_of_the_other():
    made, _ = errors(nmea, fixes(side=0.002))
    variance, _ = rounding_variance(made, stated(made))
    step = np.deg2rad(1e-4 / 60) * MERIDIAN
    assert len(np.unique(made[:, 0])) < 5
    equal = np.argmin(made[::-1, 0] == made[-1, 0])     # fixes up to the end, more than the stop
    np.testing.assert_allclose(variance[-1, 1], equal * step**2 / 12, rtol=1e-4)


@pytest.mark.parametrize('geodetic', [
    fixes(), fixes()[:1], fixes()[:0], np.tile(fixes()[:1], (300, 1)), np.repeat(
        fixes()[:100], 5, axis=0), fixes() * [-1, 1, 1], fixes()[-STOP - 3:]],
    ids=['drive', 'one', 'none', 'held', 'repeated', 'south', 'parked'])
def test_ordinary_doubles_are_not_rounded(geodetic):
    variance, why = rounding_variance(geodetic, stated(geodetic))
    assert variance.shape == geodetic.shape
    assert not variance.any()
    assert not why


def test_a_step_far_below_the_stated_sigma_is_not_reported():
    for kind, sigma in ((decimals(8), 0.01), (decimals(7), 0.01), (decimals(6), 0.7)):
        made, _ = errors(kind, fixes())
        variance, why = rounding_variance(made, stated(made, sigma))
        assert variance[:, :2].all()
        assert not why


def test_a_scale_from_float32_positions_is_as_uncertain_as_stated():
    made = drive(**TOWN | {'seed': 5}, fix_rate=5.0, fix_noise='rtk')
    leg, config = made.leg(), replace(configured(made), method='smoother')
    coarse = with_columns(leg, 'fix', latitude=rounded(float32), longitude=rounded(float32))
    found = calibrate(coarse, config)
    assert off(found.methods['smoother'], made, 'scale_factor', *ANGLES) < 2.5
    assert 'rounded' in reason_texts(found)[Code.FIXES_NOISIER_THAN_SAID]
    inputs, _ = screen(leg, config)
    assert not inputs.rounding_n.any()
