# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files for drive controllers and for devices with a wheel input, by those systems' own names."""

from dataclasses import replace
from math import tau

import foreign_keys
import pytest
import yaml

from odocal_ros.calib.result import Estimate
from odocal_ros.output import ros_files
from odocal_ros.output.files import as_json
from odocal_ros.settings.config import Config, with_settings

CREATED = '2026-01-02T03:04:05+00:00'


def texts(calibration, **settings):
    config = with_settings(Config(), {k.replace('__', '.'): v for k, v in settings.items()})
    return ros_files.texts(calibration, config, as_json(calibration, config, [], CREATED))


def controllers(calibration, **settings):
    written = yaml.safe_load(texts(calibration, **settings)['ros2_controllers.yaml'])
    return {name: block['ros__parameters'] for name, block in written.items()}


def with_estimates(good, **changed):
    return replace(good, estimates=good.estimates | changed)


def wheels(good):
    return with_estimates(good, scale_factor_left=Estimate(0.0408, 1e-6, 'm/pulse'),
                          scale_factor_right=Estimate(0.0412, 1e-6, 'm/pulse'),
                          track_width=Estimate(1.53, 1e-3, 'm'))


def test_every_key_is_one_of_the_system_it_goes_into(good):
    bias = {f'gyro_bias_{a}': Estimate(0.1, 1e-5, 'rad/s') for a in 'xyz'}
    whole = with_estimates(wheels(good), **bias)
    options = {'wheels__pulses_per_revolution': 40.0, 'odometer__track_width': 1.5,
               'odometer__nominal_scale': 0.04}
    written = texts(whole, **options)
    for name, keys in (('vehicle_velocity_converter', foreign_keys.AUTOWARE_VELOCITY),
                       ('imu_corrector', foreign_keys.AUTOWARE_IMU)):
        found = yaml.safe_load(written[f'{name}.param.yaml'])['/**']['ros__parameters']
        assert set(found) == keys
    found = controllers(whole, **options)
    assert {name: set(block) for name, block in found.items()} == foreign_keys.ROS2_CONTROLLERS
    assert all(isinstance(v, float) for block in found.values() for v in block.values())
    lines = written['wheel_input.txt'].splitlines()
    for system, begin in foreign_keys.DEVICES.items():
        above = [i for i, line in enumerate(lines) if line.startswith(f'# {system}')]
        assert len(above) == 1, system
        following = next(line for line in lines[above[0]:] if not line.startswith('#'))
        assert following.startswith(begin)
    assert foreign_keys.UBLOX_FACTOR_ID in written['wheel_input.txt']


def test_every_file_says_where_it_goes(good):
    written = texts(good, wheels__pulses_per_revolution=40.0)
    for name, word in (('calibration.yaml', '# for the node calibrator'),
                       ('vehicle_velocity_converter.param.yaml', '# for autoware vehicle_vel'),
                       ('ros2_controllers.yaml', '# for ros2_controllers'),
                       ('wheel_input.txt', '# for receivers'), ('imu_transform.urdf', 'URDF'),
                       ('imu_transform.launch.xml', 'launch file'),
                       ('imu_transform.txt', 'TF')):
        assert word in written[name], name


def test_devices_are_told_the_wheel_in_their_units(good):
    # 0.05 m a pulse: 50 000 um, 20 pulses a metre; 40 pulses a turn: 2 m round
    lines = texts(good, wheels__pulses_per_revolution=40.0)['wheel_input.txt'].splitlines()
    assert [line for line in lines if line and not line.startswith('#')] == [
        'CFG-SFODO-FACTOR = 50000', 'gain: 20.0', 'Pulses per metre = 20',
        'SETWHEELPARAMETERS 40 2 0.05', 'WENC_RADIUS 0.3183099']      # 2 m / (2 pi)
    assert '10 ppm' in ' '.join(lines)                         # 0.5 um of 50 000
    assert '# one pulse: 50000.0 ± 1.2 um; 20.00000 ± 0.00048 pulses/m' in lines
    assert all(len(line) <= 99 for line in lines[3:])


@pytest.mark.parametrize('pulses', [0.0, 40.5])
def test_systems_that_count_turns_are_left_out_without_whole_ticks_a_turn(good, pulses):
    text = texts(good, wheels__pulses_per_revolution=pulses)['wheel_input.txt']
    assert 'SETWHEELPARAMETERS' not in text
    assert 'WENC_RADIUS' not in text
    assert 'wheels.pulses_per_revolution' in text


def test_one_wheel_gives_one_multiplier_for_both(good):
    found = controllers(good)
    assert found == {'diff_drive_controller': {'left_wheel_radius_multiplier': 1.25,
                                               'right_wheel_radius_multiplier': 1.25}}


def test_two_wheels_give_each_its_own(good):
    found = controllers(wheels(good), odometer__nominal_scale=0.04, odometer__track_width=1.5)
    assert found['diff_drive_controller'] == pytest.approx({
        'left_wheel_radius_multiplier': 1.02, 'right_wheel_radius_multiplier': 1.03,
        'wheel_separation_multiplier': 1.02})


def test_a_track_width_that_was_told_is_no_correction(good):
    told = with_estimates(wheels(good), track_width=Estimate(1.5, None, 'm'))
    found = controllers(told, odometer__nominal_scale=0.04, odometer__track_width=1.5)
    assert 'wheel_separation_multiplier' not in found['diff_drive_controller']


@pytest.mark.parametrize(('unit', 'settings', 'radius'), [
    ('m/rad', {}, 0.05), ('m/pulse', {'wheels__pulses_per_revolution': 40.0}, 2 / tau),
    ('1', {'wheels__radius': 0.3}, 0.015)])
def test_the_radius_follows_from_the_factor(good, unit, settings, radius):
    found = controllers(with_estimates(good, scale_factor=Estimate(0.05, 1e-6, unit)), **settings)
    for name, keys in foreign_keys.ROS2_CONTROLLERS.items():
        if name != 'diff_drive_controller':
            assert found[name] == pytest.approx(dict.fromkeys(keys, radius))


def test_nothing_is_written_of_what_is_not_determined(good):
    lost = {n: Estimate(None, None, 'm/pulse') for n in ('scale_factor', 'scale_ratio')}
    written = texts(with_estimates(good, **lost))
    assert {'wheel_input.txt', 'ros2_controllers.yaml'}.isdisjoint(written)
    by_angle = with_estimates(good, scale_factor=Estimate(0.05, 1e-6, 'm/rad'))
    assert 'wheel_input.txt' not in texts(by_angle)
