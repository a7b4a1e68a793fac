# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""When a calibration must not silently replace another."""

from dataclasses import replace

from calibration_parts import CREATED
import pytest

from odocal_ros.calib.result import Estimate
from odocal_ros.output.files import write_results
from odocal_ros.output.stored import objection, objection_to_folder, read_stored, stored_in
from odocal_ros.settings.config import Config


@pytest.fixture
def stored_objection(tmp_path):
    def run(old, new):
        for name, one in (('old', old), ('new', new)):
            write_results(one, Config(), tmp_path / name, [], CREATED, force=True)
        assert objection(read_stored(tmp_path / 'old'), read_stored(tmp_path / 'new')) \
            == objection_to_folder(stored_in(tmp_path / 'old'), tmp_path / 'new')
        return objection_to_folder(stored_in(tmp_path / 'old'), tmp_path / 'new')
    return run


def next_drive(calibration, **estimates):
    """Return a calibration of another drive, with other values."""
    legs = tuple(replace(leg, start_ns=leg.start_ns + 10**13, stop_ns=leg.stop_ns + 10**13)
                 for leg in calibration.legs)
    return replace(calibration, legs=legs, estimates=calibration.estimates | estimates)


def test_a_rejected_result_is_worse_than_a_good_one_and_replaced_by_any(
        stored_objection, good, rejected, nothing):
    assert stored_objection(good, next_drive(rejected)).startswith('the new result is rejected (')
    assert 'GYRO_SIGN' in stored_objection(good, next_drive(rejected))
    assert stored_objection(good, rejected)        # of the same drive too
    for old, new in ((rejected, good), (rejected, nothing), (nothing, rejected)):
        assert stored_objection(old, new) == ''


@pytest.mark.parametrize(('factor', 'worse'), [(0.5, False), (1.9, False), (2.1, True)])
@pytest.mark.parametrize('name', ['scale_factor', 'yaw_mounting_angle'])
def test_a_sigma_twice_as_large_is_worse(stored_objection, good, name, factor, worse):
    old = good.estimates[name]
    new = next_drive(good, **{name: replace(old, sigma=old.sigma * factor)})
    text = stored_objection(good, new)
    assert bool(text) == worse
    assert not worse or f'{name.replace("_", " ")} is 2.1 times larger' in text


def test_scales_of_two_vehicles_are_compared_by_their_relative_sigma(stored_objection, good):
    old = good.estimates['scale_factor']
    assert stored_objection(good, next_drive(good, scale_factor=replace(
        old, value=10 * old.value, sigma=6 * old.sigma))) == ''
    assert '6.0 times larger' in stored_objection(good, next_drive(good, scale_factor=replace(
        old, value=old.value / 10, sigma=0.6 * old.sigma)))


def test_a_lost_value_is_worse_and_a_new_one_or_another_unit_is_not(stored_objection, good):
    lost = next_drive(good, yaw_mounting_angle=Estimate(None, None, 'rad'))
    assert stored_objection(good, lost) == (
        'the new result has no yaw mounting angle, the old one has -1.0000 ± 0.0029 deg')
    assert stored_objection(lost, next_drive(next_drive(good))) == ''
    assert stored_objection(good, next_drive(good, scale_factor=Estimate(0.3, 1.0, 'm/rad'))) == ''


def test_more_legs_are_better_even_with_a_larger_sigma(stored_objection, good):
    wider = next_drive(good, scale_factor=Estimate(0.05, 1e-4, 'm/pulse'))
    both = replace(wider, legs=(*good.legs, *wider.legs))
    assert stored_objection(good, both) == ''
    assert stored_objection(good, wider) != ''
    # the same legs, other settings
    assert stored_objection(good, replace(wider, legs=good.legs)) != ''


def test_an_unreadable_result_may_be_replaced(stored_objection, good, tmp_path):
    stored_objection(good, good)
    (tmp_path / 'old' / 'calibration.json').write_text('{}')
    assert stored_in(tmp_path / 'old') is stored_in(tmp_path / 'gone') is None
    assert objection_to_folder(None, tmp_path / 'new') == ''
    assert objection_to_folder(stored_in(tmp_path / 'new'), tmp_path / 'gone') == ''


def test_a_result_of_the_method_wheels_is_read_and_replaced(stored_objection, good):
    """Older versions have such a method and estimates."""
    wheels = {'scale_factor_left': Estimate(0.0499, 1e-6, 'm/pulse', 'wheels'),
              'heading_error': Estimate(0.01, 1e-3, 'rad', 'wheels')}
    base = good.methods['two_point']
    old = replace(good, estimates=good.estimates | wheels, methods=good.methods | {
        'wheels': replace(base, name='wheels', estimates=base.estimates | wheels)})
    left = replace(wheels['scale_factor_left'], method='smoother')
    assert stored_objection(old, next_drive(good, scale_factor_left=left)) == ''
    assert 'no scale factor left' in stored_objection(old, next_drive(good))
