# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""When a calibration must not quietly take the place of another."""

from dataclasses import replace

from conftest import CREATED
import pytest

from odocal_ros.calib.result import Estimate
from odocal_ros.output.files import write_results
from odocal_ros.output.stored import objection, objection_to_folder, read_stored, stored_in
from odocal_ros.settings.config import Config


@pytest.fixture
def why(tmp_path):
    """Return a function: why a calibration is worse than another, both by way of their files."""
    def run(old, new):
        for name, one in (('old', old), ('new', new)):
            write_results(one, Config(), tmp_path / name, [], CREATED, force=True)
        assert objection(read_stored(tmp_path / 'old'), read_stored(tmp_path / 'new')) \
            == objection_to_folder(stored_in(tmp_path / 'old'), tmp_path / 'new')
        return objection_to_folder(stored_in(tmp_path / 'old'), tmp_path / 'new')
    return run


def later(calibration, **estimates):
    """Return a calibration of another drive, with other values."""
    legs = tuple(replace(leg, start_ns=leg.start_ns + 10**13, stop_ns=leg.stop_ns + 10**13)
                 for leg in calibration.legs)
    return replace(calibration, legs=legs, estimates=calibration.estimates | estimates)


def test_a_rejected_one_is_worse_than_a_good_one_and_anything_may_replace_it(
        why, good, rejected, nothing):
    assert why(good, later(rejected)).startswith('the new result is rejected (')
    assert 'GYRO_SIGN' in why(good, later(rejected))
    assert why(good, rejected)        # of the same drive too
    assert why(rejected, good) == why(rejected, nothing) == why(nothing, rejected) == ''


@pytest.mark.parametrize(('factor', 'worse'), [(0.5, False), (1.9, False), (2.1, True)])
@pytest.mark.parametrize('name', ['scale_factor', 'yaw_mounting_angle'])
def test_a_sigma_twice_as_large_is_worse(why, good, name, factor, worse):
    old = good.estimates[name]
    said = why(good, later(good, **{name: replace(old, sigma=old.sigma * factor)}))
    assert bool(said) == worse
    assert not worse or f'{name.replace("_", " ")} is 2.1 times larger' in said


def test_scales_of_two_vehicles_are_compared_by_their_relative_sigma(why, good):
    old = good.estimates['scale_factor']
    assert why(good, later(good, scale_factor=replace(
        old, value=10 * old.value, sigma=6 * old.sigma))) == ''
    assert '6.0 times larger' in why(good, later(good, scale_factor=replace(
        old, value=old.value / 10, sigma=0.6 * old.sigma)))


def test_a_value_lost_is_worse_and_one_gained_or_of_another_unit_is_not(why, good):
    lost = later(good, yaw_mounting_angle=Estimate(None, None, 'rad'))
    assert why(good, lost) == ('the new result has no yaw mounting angle, the old one has '
                               '-1.0000 ± 0.0029 deg')
    assert why(lost, later(later(good))) == ''
    assert why(good, later(good, scale_factor=Estimate(0.3, 1.0, 'm/rad'))) == ''


def test_more_legs_know_better_even_with_a_larger_sigma(why, good):
    wider = later(good, scale_factor=Estimate(0.05, 1e-4, 'm/pulse'))
    both = replace(wider, legs=(*good.legs, *wider.legs))
    assert why(good, both) == ''
    assert why(good, wider) != ''
    assert why(good, replace(wider, legs=good.legs)) != ''      # the same legs, other settings


def test_what_cannot_be_read_is_no_loss(why, good, tmp_path):
    why(good, good)
    (tmp_path / 'old' / 'calibration.json').write_text('{}')
    assert stored_in(tmp_path / 'old') is stored_in(tmp_path / 'gone') is None
    assert objection_to_folder(None, tmp_path / 'new') == ''
    assert objection_to_folder(stored_in(tmp_path / 'new'), tmp_path / 'gone') == ''


def test_a_result_of_the_method_wheels_is_read_and_replaced(why, good):
    """Older versions have such a method and estimate; it holds the result's own factors."""
    wheels = {'scale_factor_left': Estimate(0.0499, 1e-6, 'm/pulse', 'wheels'),
              'heading_error': Estimate(0.01, 1e-3, 'rad', 'wheels')}
    base = good.methods['two_point']
    old = replace(good, estimates=good.estimates | wheels, methods=good.methods | {
        'wheels': replace(base, name='wheels', estimates=base.estimates | wheels)})
    left = replace(wheels['scale_factor_left'], method='smoother')
    assert why(old, later(good, scale_factor_left=left)) == ''
    assert 'no scale factor left' in why(old, later(good))
