# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files for other programs: keys, types, when they are written, and as their parsers read them."""

from dataclasses import replace
import math
import re
import sys
from types import SimpleNamespace
from xml.etree import ElementTree

from calibration_parts import texts, with_estimates
from pages import fenced, ROOT
import pytest
import yaml

from odocal_ros.calib.result import Estimate
from odocal_ros.output import program_files
from odocal_ros.safe_io.text_formats import yaml_number

SIZES = {'wheels__pulses_per_revolution': 60.0, 'odometer__nominal_scale': 0.04,
         'odometer__track_width': 1.5}
PAGE = (ROOT / 'docs' / 'recipes.md').read_text(encoding='utf-8')


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
    expected = {name.removeprefix('result.') for name in params.RESULTS}
    for calibration in (good, nothing):
        assert expected <= set(parameters(texts(calibration)['calibration.yaml'])['result'])


def test_a_rejected_result_writes_only_the_parameter_file(rejected):
    written = texts(rejected)
    assert list(written) == ['calibration.yaml']
    result = parameters(written['calibration.yaml'])['result']
    assert result['valid'] is False
    assert result['scale_factor'] == 0.05


def test_the_autoware_factor_is_the_ratio_for_pulses_and_the_scale_for_speeds(good):
    by_speed = with_estimates(good, scale_factor=Estimate(0.98, 1e-3, '1'),
                              scale_ratio=Estimate(0.49, 5e-4, '1'))
    truncated = with_estimates(by_speed, scale_factor_as_sent=Estimate(0.99, 1e-3, '1'))
    name = 'vehicle_velocity_converter.param.yaml'
    for calibration, factor in ((good, 1.25), (by_speed, 0.98), (truncated, 0.99)):
        assert parameters(texts(calibration)[name]) == {
            'speed_scale_factor': factor, 'velocity_stddev_xx': 0.2,
            'angular_velocity_stddev_zz': 0.1, 'frame_id': 'base_link'}
    assert name not in texts(with_estimates(good, scale_ratio=Estimate(None, None, '1')))


def test_the_gyro_bias_is_written_in_axes_and_unit_of_the_message(good):
    assert 'imu_corrector.param.yaml' not in texts(good)
    bias = {f'gyro_bias_{a}': Estimate(v, 1e-5, 'rad/s') for a, v in zip(
        'xyz', (1.0, 2.0, 3.0), strict=True)}
    text = texts(with_estimates(good, **bias), imu__gyro_scale=0.5)['imu_corrector.param.yaml']
    # C_bi is Rz(-90 deg): the body's x is the sensor's y, the body's y its -x
    assert parameters(text) == {
        'angular_velocity_offset_x': -4.0, 'angular_velocity_offset_y': 2.0,
        'angular_velocity_offset_z': 6.0, 'angular_velocity_stddev_xx': 0.03,
        'angular_velocity_stddev_yy': 0.03, 'angular_velocity_stddev_zz': 0.03}


def test_the_three_transform_files_contain_the_same_transform(good):
    written = texts(good, imu__lever_arm=(0.5, -0.1, 1.0), frames__imu='imu_top',
                    frames__base='rear_axle')
    joint = ElementTree.fromstring(written['imu_transform.urdf'])
    assert joint.find('origin').attrib == {'xyz': '0.5 -0.1 1.0', 'rpy': '0.0 0.0 -0.0174533'}
    assert joint.find('parent').attrib == {'link': 'rear_axle'}
    assert joint.find('child').attrib == {'link': 'imu_top'}
    node = ElementTree.fromstring(written['imu_transform.launch.xml']).find('node')
    expected = ('--x 0.5 --y -0.1 --z 1.0 --roll 0.0 --pitch 0.0 --yaw -0.0174533 '
                '--frame-id rear_axle --child-frame-id imu_top')
    assert node.attrib['args'] == expected
    assert node.attrib['pkg'] == 'tf2_ros'
    assert written['imu_transform.txt'].endswith(f'static_transform_publisher {expected}\n')


def test_without_a_yaw_no_transform_is_written(good):
    written = texts(replace(good, imu_rotation_rpy=None, imu_rotation_xyzw=None))
    assert not [name for name in written if 'transform' in name]
    assert 'vehicle_velocity_converter.param.yaml' in written


def test_every_file_written_is_known_for_removal(smoothed):
    assert set(texts(smoothed)) == program_files.NAMES


@pytest.mark.parametrize('value', [1e-5, 1e22, -3e-7, 0.1, 0.0, 1.0, -123456.789])
def test_numbers_stay_doubles_for_every_yaml_reader(value):
    text = yaml_number(value)
    assert yaml.safe_load(text) == value
    assert isinstance(yaml.safe_load(text), float)
    assert re.search(r'[.]', text)
    assert yaml_number(None) == yaml_number(math.inf) == '.nan'       # what is not known


def flat(values, prefix=''):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flat(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


def as_rcl_reads(path, node, names):
    """Return the values that a node of this name is given for these parameters."""
    rclpy = pytest.importorskip('rclpy', reason='no rclpy here: pip install odocal_ros[ros]')
    from rcl_interfaces.msg import ParameterDescriptor
    context = rclpy.Context()
    rclpy.init(args=['--ros-args', '--params-file', str(path)], context=context)
    try:
        made = rclpy.create_node(node, context=context, enable_rosout=False,
                                 start_parameter_services=False)
        found = [made.declare_parameter(
            name, descriptor=ParameterDescriptor(dynamic_typing=True)).value for name in names]
        made.destroy_node()
    finally:
        context.shutdown()
    return [list(value) if hasattr(value, 'typecode') else value for value in found]


def same(a, b):
    if isinstance(a, list):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and (a == b or (a != a and b != b))


def parameter_texts(smoothed):
    """Return every parameter text by name: written files, files of config/, blocks of docs."""
    written = texts(smoothed, **SIZES)
    found = {name: text for name, text in written.items() if name.endswith('.yaml')}
    rover = texts(with_estimates(smoothed, rotation_lever=Estimate(0.4, 1e-3, 'm')),
                  odometer__drive='mecanum', **SIZES)
    found['mecanum'] = rover['ros2_controllers.yaml']
    found |= {path.name: path.read_text(encoding='utf-8') for path in (
        ROOT / 'config').glob('*.yaml')}
    return found | {f'block {k} of recipes.md': '\n'.join(lines) for k, (_, lines) in enumerate(
        fenced(PAGE)) if any('ros__parameters' in line for line in lines)}


def test_rcl_reads_each_value_of_each_parameter_file(smoothed, tmp_path):
    """Type and value as YAML 1.1 reads them, so that no number arrives as text or integer."""
    found = parameter_texts(smoothed)
    assert {'calibration.yaml', 'imu_corrector.param.yaml', 'imu_errors.yaml',
            'ros2_controllers.yaml', 'wheel_odometry_covariance.yaml'} < set(found)
    for name, text in found.items():
        path = tmp_path / 'file.yaml'
        path.write_text(text, encoding='utf-8')
        for key, block in yaml.safe_load(text).items():
            expected = dict(flat(block['ros__parameters']))
            node = 'some_node' if key == '/**' else key.rpartition('/')[2]
            read = as_rcl_reads(path, node, expected)
            for (parameter, value), got in zip(expected.items(), read, strict=True):
                # an empty list has no type: rcl leaves it out, and the node takes its default
                assert same(got, value or None if isinstance(value, list) else value), (
                    name, parameter, got)


def device_lines(calibration):
    text = texts(calibration, **SIZES)['wheel_input.txt']
    return [line for line in text.splitlines() if line and not line.startswith('#')]


def test_pyubx2_sends_the_factor_of_the_file(good, tmp_path, monkeypatch):
    ubx = pytest.importorskip('pyubx2', reason='no pyubx2 here: pip install odocal_ros[dev]')
    name, value = device_lines(good)[0].split(' = ')
    sent = ubx.UBXMessage.config_set(1, 0, [(name.replace('-', '_'), int(value))]).serialize()
    got = ubx.UBXReader.parse(sent, msgmode=ubx.SET)
    assert (got.identity, got.CFG_SFODO_FACTOR) == ('CFG-VALSET', 50_000)     # um of 0.05 m
    assert got.payload[4:8] == (0x40070007).to_bytes(4, 'little')
    # and so does the program of the page, here into a file in place of the port
    program, = ('\n'.join(lines) for language, lines in fenced(PAGE) if language == 'python')
    monkeypatch.setitem(sys.modules, 'serial', SimpleNamespace(
        Serial=lambda port, baud: (tmp_path / 'port').open('wb')))
    exec(program, {})
    got = ubx.UBXReader.parse((tmp_path / 'port').read_bytes(), msgmode=ubx.SET)
    assert (got.payload[1], got.CFG_SFODO_FACTOR) == (0b111, 21_299)     # layers, um
    keys = set(re.findall(r'\bCFG-SF[A-Z]+-[A-Z_0-9]+', PAGE))
    assert keys
    assert {key.replace('-', '_') for key in keys} <= set(ubx.UBX_CONFIG_DATABASE)


def test_pymavlink_loads_the_radius_of_the_file_and_of_the_recipe(good, tmp_path):
    mavparm = pytest.importorskip('pymavlink.mavparm', reason='no pymavlink here')
    path = tmp_path / 'rover.param'
    blocks = ['\n'.join(lines) for _, lines in fenced(PAGE) if any('WENC' in x for x in lines)]
    for text, travel, pulses in ((device_lines(good)[-1], 0.05, 60), (blocks[0], 0.0213, 60)):
        path.write_text(f'{text}\n')
        loaded = mavparm.MAVParmDict()
        assert loaded.load(str(path))
        assert loaded['WENC_RADIUS'] * math.tau / pulses == pytest.approx(travel, rel=1e-5)
        assert len(loaded) == len(text.splitlines())
