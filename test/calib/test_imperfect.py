"""The Imu's own errors: judged from the drive, held by the sigma."""

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.calib.smoother import smooth
from odocal_ros.calib.smoother.imperfect import believed
from odocal_ros.config import with_settings

GRADE, BELIEF = 3e-3, 0.8
BOTH = np.full(2, GRADE)
TOWN = {'scenario': 'town', 'duration': 400.0, 'imu_grade': 'industrial', 'sway': 0.05}


def seen(sigma, error, held=BOTH):
    """Return covariance, values and priors, of data that tell both so well."""
    data = 1 / sigma**2
    both = data + 1 / held**2
    return np.diag(1 / both), data * error / both, GRADE * np.ones(2), BELIEF, held


def test_weights_are_the_evidence_written_out():
    prior, weight = believed(*seen(1e-3, 2e-3))
    # each axis: the value seen is N(0, s^2) without an error, N(0, s^2 + grade^2) with one
    total = 1e-3**2 + GRADE**2
    odds = BELIEF / (1 - BELIEF) * (1e-6 / total * np.exp(4e-6 * (1 / 1e-6 - 1 / total)))
    assert weight == pytest.approx(odds / (1 + odds), rel=2e-3)      # 1e-3 is added to the data
    # the posterior of that prior has the mean square of both: w var + w (1 - w) mean^2
    var, mean = 1 / (1e6 + GRADE**-2), 2e-3 * GRADE**2 / total
    square = weight * var + weight * (1 - weight) * mean**2
    expected = min(1 / (1 / square - 1e6), GRADE**2) if square < 1e-6 else GRADE**2
    assert prior**2 == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize('held', [1e-4, 1e-3])
def test_what_was_believed_before_does_not_weigh_twice(held):
    again = believed(*seen(1e-3, 2e-3, np.full(2, held)))
    for now, first in zip(again, believed(*seen(1e-3, 2e-3)), strict=True):
        # differences of 1e3 leave 1e-13 of it by rounding
        np.testing.assert_allclose(now, first, rtol=1e-9)


def test_a_drive_that_tells_there_is_none_is_believed():
    prior, weight = believed(*seen(1e-4, 0.0))
    assert weight < 0.01
    assert prior.max() < 2e-5
    # and one that tells nothing is not
    blind, weight = believed(*seen(0.1, 0.0))
    assert weight == pytest.approx(BELIEF, rel=2e-3)
    assert blind.max() > 0.8 * GRADE


def test_fixes_that_tell_it_well_are_not_taken_for_telling_that_there_is_none():
    error = 5e-4      # as its grade allows, and ten times what such fixes tell it to
    _, config, leg = made(scenario='town', duration=250.0, imu_grade='tactical', fix_noise='rtk',
                          accel_scale_error=error, seed=4)
    details = smooth(leg, with_settings(config, {'imu.accel_scale_sigma': np.nan})).details
    for axis in 'xy':
        found = details[f'accelerometer_scale_{axis}']
        assert abs(found['value'] - error) < 3.0 * found['sigma']
        # a belief of none that had given way by steps would hold it to less than its grade
        assert details['posterior_to_prior'][f'accelerometer_scale_{axis}'] == pytest.approx(
            found['sigma'] / error, rel=0.01)


def test_of_slow_fixes_an_error_too_small_to_be_told_is_held_too():
    grade = 0.01
    drive, config, leg = made(scenario='town', duration=200.0, imu_grade='consumer',
                              fix_noise='correlated', accel_scale_error=grade / 4, seed=4)
    result = smooth(leg, with_settings(config, {'imu.accel_scale_sigma': np.nan}))
    scale = result.estimates['scale_factor']
    assert abs(scale.value - drive.truth.scale) < 3.0 * scale.sigma
    for axis in 'xy':       # believed as large as the grade's, whatever its evidence
        assert result.details['posterior_to_prior'][f'accelerometer_scale_{axis}'] == (
            pytest.approx(result.details[f'accelerometer_scale_{axis}']['sigma'] / grade))


@pytest.mark.parametrize('noise', ['white', 'correlated'])
def test_the_sigma_of_the_scale_holds_it(noise):
    drive, config, leg = made(**TOWN, fix_noise=noise, accel_scale_error=GRADE, seed=4)
    graded = with_settings(config, {'imu.accel_scale_sigma': np.nan})     # that of its grade
    scale = smooth(leg, graded).estimates['scale_factor']
    assert abs(scale.value - drive.truth.scale) < 3.0 * scale.sigma       # 1 in 370
    # of an Imu said to have none, the error is many sigmas: what this is for
    wrong = smooth(leg, config).estimates['scale_factor']
    assert abs(wrong.value - drive.truth.scale) > 4.0 * wrong.sigma
