# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The parsers of ROS, u-blox tools and MAVLink read what odocal writes and what docs show."""

from dataclasses import replace
import math
import re
import sys
from types import SimpleNamespace

from pages import fenced, ROOT
import pytest
import yaml

from odocal_ros.calib.result import Estimate
from odocal_ros.output import ros_files
from odocal_ros.output.files import as_json
from odocal_ros.settings.config import Config, with_settings

PAGE = (ROOT / 'docs' / 'recipes.md').read_text(encoding='utf-8')


def texts(calibration, **settings):
    config = with_settings(Config(), {
        'wheels.pulses_per_revolution': 60.0, 'odometer.nominal_scale': 0.04,
        'odometer.track_width': 1.5} | settings)
    return ros_files.texts(calibration, config, as_json(calibration, config, [],
                                                        '2026-01-02T03:04:05+00:00'))


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
    rover = {'odometer.drive': 'mecanum'}
    levers = smoothed.estimates | {'rotation_lever': Estimate(0.4, 1e-3, 'm')}
    found = {name: text for name, text in texts(smoothed).items() if name.endswith('.yaml')}
    found['mecanum'] = texts(replace(smoothed, estimates=levers), **rover)['ros2_controllers.yaml']
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
            wanted = dict(flat(block['ros__parameters']))
            node = 'some_node' if key == '/**' else key.rpartition('/')[2]
            read = as_rcl_reads(path, node, wanted)
            for (parameter, value), got in zip(wanted.items(), read, strict=True):
                # an empty list has no type: rcl leaves it out, and the node takes its default
                assert same(got, value or None if isinstance(value, list) else value), (
                    name, parameter, got)


def device_lines(calibration):
    text = texts(calibration)['wheel_input.txt']
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
