"""The Imu's own errors: judged from the drive, held by the sigma."""

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.calib.smoother import smooth
from odocal_ros.calib.smoother.imperfect import believed, weigh_kinds
from odocal_ros.config import with_settings

GRADE, BELIEF = 3e-3, 0.8
TOWN = {'scenario': 'town', 'duration': 400.0, 'imu_grade': 'industrial', 'sway': 0.05}


def seen(sigma, error):
    """Return information and gradient, in units of GRADE, of data that tell two errors so well."""
    data = (GRADE / sigma)**2
    return data * np.eye(2), data * np.full(2, error / GRADE)


def test_weights_are_the_evidence_written_out():
    data, gradient = seen(1e-3, 2e-3)
    prior, weight = believed(data, np.outer(gradient, gradient), BELIEF)
    # each error: the value seen is N(0, s^2) where there is none, N(0, s^2 + grade^2) else
    total = 1e-3**2 + GRADE**2
    odds = BELIEF / (1 - BELIEF) * (1e-6 / total * np.exp(4e-6 * (1 / 1e-6 - 1 / total)))
    assert weight == pytest.approx(odds / (1 + odds))
    # the posterior of that prior has the mean square of both: w var + w (1 - w) mean^2
    var, mean = 1 / (1e6 + GRADE**-2), 2e-3 * GRADE**2 / total
    square = weight * var + weight * (1 - weight) * mean**2
    expected = min(1 / (1 / square - 1e6), GRADE**2) if square < 1e-6 else GRADE**2
    assert prior * GRADE**2 == pytest.approx(expected)


def test_a_drive_that_tells_there_is_none_is_believed():
    data, gradient = seen(1e-4, 0.0)
    prior, weight = believed(data, np.outer(gradient, gradient), BELIEF)
    assert weight < 0.01
    assert np.sqrt(prior.max()) * GRADE < 2e-5
    # and one that tells nothing is not
    data, gradient = seen(0.1, 0.0)
    blind, weight = believed(data, np.outer(gradient, gradient), BELIEF)
    assert weight == pytest.approx(BELIEF, rel=2e-3)
    assert np.sqrt(blind.max()) > 0.8


def test_of_two_kinds_one_is_there_and_the_other_is_not():
    # alike to 0.7 in what they do: alone, either would be taken for what the other does
    data = 400.0 * np.array([[1.0, 0.7], [0.7, 1.0]])
    kinds = (slice(0, 1), slice(1, 2))
    there, absent = weigh_kinds(data, data @ [1.0, 0.0], kinds)
    assert there == 1.0
    assert absent < 0.05**2
    np.testing.assert_allclose(weigh_kinds(data, data @ [0.0, 1.0], kinds), [absent, there],
                               rtol=0.1)
    # where none is there, it is as for gradients that scatter so
    assert weigh_kinds(data, None, kinds).max() < 0.05**2


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
