# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files that other ROS programs load: their keys, their types, and when they are written."""

from dataclasses import replace
import math
import re
from xml.etree import ElementTree

import pytest
import yaml

from odocal_ros.calib.result import Estimate
from odocal_ros.output import ros_files
from odocal_ros.output.files import as_json
from odocal_ros.outside.yaml_files import number
from odocal_ros.settings.config import Config, with_settings

CREATED = '2026-01-02T03:04:05+00:00'


def texts(calibration, config=None):
    config = config or Config()
    return ros_files.texts(calibration, config, as_json(calibration, config, [], CREATED))


def parameters(text):
    return yaml.safe_load(text)['/**']['ros__parameters']


def test_the_parameter_file_restores_the_node(good):
    result = parameters(texts(good)['calibration.yaml'])['result']
    assert result['scale_factor'] == 0.05
    assert result['scale_factor_sigma'] == 1.2e-6       # 1.2e-06 without the dot would be text
    assert math.isnan(result['pitch_mounting_angle'])
    assert result['legs'] == 1
    assert result['valid'] is True
    assert result['stamp'] == '2026-01-02 03:04:05 UTC'     # no date to YAML, quoted or not
    assert yaml.safe_load(result['stamp']) == result['stamp']


def test_ros2_param_load_reads_every_value(good, tmp_path):
    """By its own function: it reads each value a second time, as text."""
    load = pytest.importorskip('rclpy.parameter').parameter_dict_from_yaml_file
    path = tmp_path / 'calibration.yaml'
    path.write_text(texts(good)['calibration.yaml'])
    loaded = load(str(path), use_wildcard=True)
    assert loaded['result.stamp'].value.string_value == '2026-01-02 03:04:05 UTC'
    assert loaded['result.scale_factor'].value.double_value == 0.05


def test_the_parameter_file_has_every_name_the_node_declares(good, nothing):
    pytest.importorskip('rclpy', reason='no rclpy here: pip install odocal_ros[ros]')
    from odocal_ros.live import params
    wanted = {name.removeprefix('result.') for name in params.RESULTS}
    for calibration in (good, nothing):
        assert wanted <= set(parameters(texts(calibration)['calibration.yaml'])['result'])


def test_a_rejected_result_is_no_file_to_drive_by(rejected):
    written = texts(rejected)
    assert list(written) == ['calibration.yaml']
    result = parameters(written['calibration.yaml'])['result']
    assert result['valid'] is False
    assert result['scale_factor'] == 0.05


def test_autoware_gets_the_ratio_for_pulses_and_the_factor_for_speeds(good):
    by_pulses = parameters(texts(good)['vehicle_velocity_converter.param.yaml'])
    assert by_pulses == {'speed_scale_factor': 1.25, 'velocity_stddev_xx': 0.2,
                         'angular_velocity_stddev_zz': 0.1, 'frame_id': 'base_link'}
    speed = good.estimates | {'scale_factor': Estimate(0.98, 1e-3, '1'),
                              'scale_ratio': Estimate(0.49, 5e-4, '1')}
    by_speed = texts(replace(good, estimates=speed))['vehicle_velocity_converter.param.yaml']
    assert parameters(by_speed)['speed_scale_factor'] == 0.98
    speed['scale_factor_as_sent'] = Estimate(0.99, 1e-3, '1')
    truncated = texts(replace(good, estimates=speed))['vehicle_velocity_converter.param.yaml']
    assert parameters(truncated)['speed_scale_factor'] == 0.99
    unknown = good.estimates | {'scale_ratio': Estimate(None, None, '1')}
    assert 'vehicle_velocity_converter.param.yaml' not in texts(replace(good, estimates=unknown))


def test_the_gyro_bias_goes_back_to_the_axes_and_unit_of_the_message(good):
    assert 'imu_corrector.param.yaml' not in texts(good)
    bias = {f'gyro_bias_{a}': Estimate(v, 1e-5, 'rad/s') for a, v in zip(
        'xyz', (1.0, 2.0, 3.0), strict=True)}
    config = with_settings(Config(), {'imu.gyro_scale': 0.5})
    text = texts(replace(good, estimates=good.estimates | bias), config)[
        'imu_corrector.param.yaml']
    # C_bi is Rz(-90 deg): the body's x is the sensor's y, the body's y its -x
    assert parameters(text) == {
        'angular_velocity_offset_x': -4.0, 'angular_velocity_offset_y': 2.0,
        'angular_velocity_offset_z': 6.0, 'angular_velocity_stddev_xx': 0.03,
        'angular_velocity_stddev_yy': 0.03, 'angular_velocity_stddev_zz': 0.03}


def test_the_three_transforms_are_one_and_the_same(good):
    config = with_settings(Config(), {'imu.lever_arm': (0.5, -0.1, 1.0), 'frames.imu': 'imu_top',
                                      'frames.base': 'rear_axle'})
    written = texts(good, config)
    joint = ElementTree.fromstring(written['imu_transform.urdf'])
    assert joint.find('origin').attrib == {'xyz': '0.5 -0.1 1.0', 'rpy': '0.0 0.0 -0.0174533'}
    assert joint.find('parent').attrib == {'link': 'rear_axle'}
    assert joint.find('child').attrib == {'link': 'imu_top'}
    node = ElementTree.fromstring(written['imu_transform.launch.xml']).find('node')
    wanted = ('--x 0.5 --y -0.1 --z 1.0 --roll 0.0 --pitch 0.0 --yaw -0.0174533 '
              '--frame-id rear_axle --child-frame-id imu_top')
    assert node.attrib['args'] == wanted
    assert node.attrib['pkg'] == 'tf2_ros'
    assert written['imu_transform.txt'].endswith(f'static_transform_publisher {wanted}\n')


def test_without_a_yaw_there_is_no_transform(good):
    written = texts(replace(good, imu_rotation_rpy=None, imu_rotation_xyzw=None))
    assert not [name for name in written if 'transform' in name]
    assert 'vehicle_velocity_converter.param.yaml' in written


def test_every_file_written_is_known_for_removal(smoothed):
    assert set(texts(smoothed)) == ros_files.NAMES


@pytest.mark.parametrize('value', [1e-5, 1e22, -3e-7, 0.1, 0.0, 1.0, -123456.789])
def test_numbers_stay_doubles_for_every_yaml_reader(value):
    text = number(value)
    assert yaml.safe_load(text) == value
    assert isinstance(yaml.safe_load(text), float)
    assert re.search(r'[.]', text)
    assert number(None) == number(math.inf) == '.nan'       # what is not known
