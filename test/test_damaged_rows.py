# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Damaged rows and methods that fail: only they are excluded, never the leg."""

from dataclasses import replace
from functools import partial
import warnings

from drives import reason_texts, seconds, settings, with_columns
import numpy as np
import pytest

from odocal_ros.calib.result import traces
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.pipeline import methods as leg_methods
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code, Verdict
from odocal_ros.screening.glitches import near_impossible_groups
from odocal_ros.screening.screen import screen

pytestmark = pytest.mark.slow
MADE = {'scenario': 'town', 'duration': 120.0, 'imu_grade': 'industrial', 'seed': 4}


@pytest.fixture(scope='module')
def config(made):
    return settings(made, method='auto')


def sound(leg, made):
    """Check that screening finds no bad row in a leg."""
    found = {r.code for r in screen(leg, settings(made))[1]}
    assert not {Code.BAD_ROWS_DROPPED, Code.ROWS_DAMAGED} & found


def with_speeds(leg, speeds):
    form = replace(leg.form, quantity='rate', modulus=0, scale_unit='1')
    return replace(leg, odometer=replace(leg.odometer, value=speeds), form=form)


def garbage(rng, first, last, column):
    """Overwrite rows with random bits, like a block that is unpacked wrongly."""
    raw = rng.integers(0, 256, column[first:last].nbytes, np.uint8)
    column[first:last] = raw.view(np.float64).reshape(column[first:last].shape)


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('share', [0.002, 0.02, 0.1])
def test_a_block_of_garbage_is_never_accepted(made, config, seed, share):
    rng, n = np.random.default_rng(seed), len(made.imu.stamp_ns)
    first = int(rng.integers(0, n * (1 - share)))
    wrong = partial(garbage, rng, first, first + int(n * share))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        result = calibrate(with_columns(made.leg(), 'imu', w_i=wrong, f_i=wrong), config)
    assert result.verdict is not Verdict.ACCEPTED
    assert Code.ROWS_DAMAGED in reason_texts(result)


def test_rows_near_impossible_ones_are_excluded_with_them(made, config):
    """One row of twenty is impossible; the others are wrong by possible values."""
    rng = np.random.default_rng(5)

    def wrong(column):
        column[4000:4600] += rng.normal(0, 0.05, (600, 3))
        column[4000:4600:20] = 1e200
    result = calibrate(with_columns(made.leg(), 'imu', w_i=wrong), config)
    assert result.imu_samples <= len(made.imu.stamp_ns) - 600
    assert result.verdict is not Verdict.ACCEPTED


def test_occasional_nan_of_a_driver_is_not_damage(made):
    leg = with_columns(made.leg(), 'imu', w_i=(slice(None, None, 50), np.nan))
    said = reason_texts(calibrate(leg, settings(made)))
    assert Code.BAD_ROWS_DROPPED in said
    assert Code.ROWS_DAMAGED not in said


@pytest.mark.parametrize(('rows', 'accepted'), [(4, True), (8, False)])
def test_several_impossible_rows_give_a_caution_at_any_place(made, config, rows, accepted):
    """Eight far apart were next to undetected wrong ones: a yaw error of 17 sigmas."""
    at = np.linspace(500, len(made.imu.stamp_ns) - 500, rows).astype(int)
    result = calibrate(with_columns(made.leg(), 'imu', w_i=(at, 1e200)), config)
    assert (Code.ROWS_DAMAGED not in reason_texts(result)) == accepted
    assert (result.verdict is Verdict.ACCEPTED) == accepted


def test_impossible_and_slightly_wrong_rows_are_one_group(made):
    """A rate of 0.8 rad/s in a row at rest was between two impossible ones: 25 sigmas of yaw."""
    leg = made.leg()
    at = int(np.searchsorted(leg.imu.stamp_ns, leg.start_ns)) - 600

    def wrong(column):
        column[[at, at + 3, at + 24]] = 1e200
        column[at + 4, 2], column[at + 5, 0] = 0.78, 0.21
    result = calibrate(with_columns(leg, 'imu', w_i=wrong), settings(made))
    assert Code.ROWS_DAMAGED in reason_texts(result)
    assert result.verdict is not Verdict.ACCEPTED


def test_groups_of_impossible_rows():
    wild = np.zeros(1000, bool)
    assert not near_impossible_groups(wild).any()
    wild[[100, 400, 800]] = True
    assert not near_impossible_groups(wild).any()              # alone
    wild[[405, 410, 414, 419]] = True                # 400 to 419: five apart at most
    assert np.flatnonzero(near_impossible_groups(wild)).tolist() == list(range(390, 430))
    assert not near_impossible_groups(np.zeros(0, bool)).any()


@pytest.mark.parametrize('yaw', [0, 2])
def test_exact_zeros_that_are_rotated_twice_are_not_damage(made, yaw):
    C, C_again = (matrix_from_rpy(np.pi / 2 * np.array(n)) for n in ((1, 1, yaw), (1, 1, 2)))

    def upright(column):
        column[:] = column * [0.0, 0.0, 1.0] @ C @ C_again
        assert 0 < np.abs(column[column != 0]).min() < 1e-50
    sound(with_columns(made.leg(), 'imu', w_i=upright, f_i=upright), made)


def test_a_filtered_speed_that_fades_at_rest_is_zero(made):
    """A low pass of 0.4 s in double precision is at 1e-50 after 46 s of standing."""
    leg = made.leg()
    t = seconds(leg, leg.odometer)
    speeds = np.where(t < 40.0, np.sin(t / 30.0)**2, np.exp((40.0 - t) / 0.4))
    assert np.abs(speeds).min() < 1e-60
    sound(with_speeds(leg, speeds), made)


@pytest.mark.parametrize('value', [5e-324, -1e-310, 1e-200])
def test_subnormal_odometer_values_are_used(made, value):
    leg = with_speeds(made.leg(), np.full(len(made.odometer.stamp_ns), value))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        result = calibrate(leg, settings(made))
    assert result.verdict is Verdict.REJECTED


@pytest.fixture(scope='module')
def whole(made, config):
    return calibrate(made.leg(), config)


BAD_COVARIANCES = [
    np.ones((3, 3)),                                        # E and N fully correlated
    [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]],    # a correlation of two
    [[1.0, 1 - 1e-9, 0.0], [1 - 1e-9, 1.0, 0.0], [0.0, 0.0, 1.0]],
    [[1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]],    # only with the height
    [[2.0, 0.0, 0.0], [3.0, 2.0, 0.0], [0.0, 0.0, 9.0]],    # not symmetric
    np.diag([1e-300, 1e-300, 1.0]), np.diag([1e300, 1.0, 1.0]), np.full((3, 3), 5e-324)]


def test_invalid_covariances_are_not_used(made, config, whole):
    def some(covariance):
        covariance[::len(covariance) // 8][:8] = BAD_COVARIANCES
    result = calibrate(with_columns(made.leg(), 'fix', covariance_n=some), config)
    assert Code.METHOD_FAILED not in reason_texts(result)
    for name in ('smoother', 'two_point'):
        mine, other = (r.methods[name].estimates['scale_factor'] for r in (result, whole))
        assert mine.value == pytest.approx(other.value, abs=other.sigma)   # eight fixes of many


@pytest.mark.parametrize('broken', ['two_point', 'smoother'])
def test_an_exception_in_a_method_excludes_that_method(made, config, whole, monkeypatch, broken):
    def breaks(prepared, passed):
        raise np.linalg.LinAlgError('Singular\nmatrix')
    monkeypatch.setitem(leg_methods.METHODS, broken, breaks)
    result = calibrate(made.leg(), config)
    reason, = (r for r in result.methods[broken].reasons if r.code is Code.METHOD_FAILED)
    assert (f'method {broken} failed with an internal error: LinAlgError (Singular matrix) in '
            'breaks') in reason.text
    (name, trace), = traces([result])
    assert name == broken
    assert 'Traceback' in trace
    other, = {'two_point', 'smoother'} - {broken}
    assert result.methods[other].estimates == whole.methods[other].estimates
    # also with two legs: the combination has the missing method
    later = replace(result, start_ns=result.stop_ns, stop_ns=2 * result.stop_ns - result.start_ns)
    both = combine([result, later], config)
    assert both.estimates['scale_factor'].method == other
    assert both.verdict is not Verdict.REJECTED
