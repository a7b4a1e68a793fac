# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Texts of the files that other programs load unchanged: ROS parameters, transforms, maps.

The map is GeoJSON (RFC 7946) with four features a leg: the corrected track, the track as
configured, the fixes, the two marks; WGS 84 longitude and latitude in degrees, height in metres.
"""

from dataclasses import replace
import json
import re
from typing import Any
from xml.etree import ElementTree

import numpy as np

from odocal_ros.calib.result import Calibration, LegResult, NOT_ESTIMATES, RAW_SCALE
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.output import device_files
from odocal_ros.output.plot_style import even_rows
from odocal_ros.output.summary import not_estimated, sentence
from odocal_ros.output.tables import leg_table, LEGS
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.safe_io import text_formats
from odocal_ros.safe_io.text_formats import date_text, parameter_block
from odocal_ros.settings.config import Config, with_settings

TRACK = 'track.geojson'
MAX_TRACK_POINTS = 5000          # judgement: points of a feature: maps do not show more
TRACK_TEXT = ('For QGIS, Foxglove, geojson.io and other maps. corrected: dead reckoning with the '
              'calibrated values; as_configured: with the previous values; fixes: of the '
              'receiver; both tracks start at the start mark')
DEGREE_PLACES = 8     # judgement: 1e-8 deg: 1 mm
PARAMS = 'calibration.yaml'
VELOCITY = 'vehicle_velocity_converter.param.yaml'
IMU = 'imu_corrector.param.yaml'
LAUNCH, URDF, COMMAND = ('imu_transform.launch.xml', 'imu_transform.urdf', 'imu_transform.txt')
NAMES = {PARAMS, VELOCITY, IMU, LAUNCH, URDF, COMMAND, TRACK, LEGS, device_files.CONTROLLERS,
         device_files.DEVICES, device_files.TWIST, device_files.IMU_ERRORS}
# the file always contains these parameters; without two wheels they have no value
TWO_WHEELS = ('scale_factor_left', 'scale_factor_right', 'track_width')
AXES = 'xyz'
IMU_FRAME = 'imu_link'      # REP-145, by default


def file_texts(calibration: Calibration, config: Config,
               content: dict[str, Any]) -> dict[str, str]:
    """
    Return file name -> text for the configured formats.

    Except calibration.yaml, files are for use on a vehicle: there are none for a rejected
    calibration, and each only if its values are determined.
    """
    formats = config.output.formats
    files = {PARAMS: _params(calibration, content)} if 'params' in formats else {}
    if calibration.verdict is not Verdict.REJECTED:
        for name, make_texts in FORMATS.items():
            if name in formats:
                files |= make_texts(calibration, config, content)
    return files


def _params(calibration: Calibration, content: dict[str, Any]) -> str:
    unknown = dict.fromkeys(TWO_WHEELS, {'value': None, 'sigma': None})
    result: dict[str, object] = {}
    for name, entry in (unknown | content['result']).items():
        if name not in NOT_ESTIMATES:
            result |= {name: entry['value'], f'{name}_sigma': entry['sigma']}
    result |= {'legs': len(calibration.legs),
               'valid': calibration.verdict is not Verdict.REJECTED,
               'stamp': date_text(content['created']), 'vehicle': content['vehicle']}
    return (device_files.origin_comment(calibration, content)
            + '# for the node calibrator at its start: --ros-args --params-file THIS_FILE\n'
            '# scale factor: metres of travel per pulse (per rad for joints, 1 for speeds)\n'
            '# angles: rad, of the IMU on the vehicle about fixed axes; yaw > 0: its x axis '
            'points left of forward\n' + parameter_block({'result': result}))


def _autoware(calibration: Calibration, config: Config, content: dict[str, Any]) -> dict[str, str]:
    """Return the parameter files of two nodes of Autoware, each if its values are known."""
    files: dict[str, tuple[str, str, dict[str, Any]]] = {}
    factor, bias_i = _speed_factor(calibration), _gyro_bias_i(calibration, config)
    if factor is not None:
        files[VELOCITY] = 'vehicle_velocity_converter', 'the two stddev', {
            'speed_scale_factor': factor, 'velocity_stddev_xx': 0.2,
            'angular_velocity_stddev_zz': 0.1, 'frame_id': config.frames.base}
    if bias_i is not None:
        files[IMU] = 'imu_corrector', 'the stddev', {
            f'angular_velocity_offset_{axis}': float(b)
            for axis, b in zip(AXES, bias_i, strict=True)} | {
            f'angular_velocity_stddev_{axis}{axis}': 0.03 for axis in AXES}
    origin = device_files.origin_comment(calibration, content)
    return {name: f'{origin}# for autoware {node}, in place of its param file of this name;\n'
            f'# {defaults} are its defaults, not measured here\n{parameter_block(values)}'
            for name, (node, defaults, values) in files.items()}


def _speed_factor(calibration: Calibration) -> float | None:
    """Return the factor for raw speeds; for pulses only with a nominal scale."""
    scale, ratio = (calibration.estimates.get(name) for name in ('scale_factor', 'scale_ratio'))
    if scale is not None and scale.unit == '1':
        return calibration.estimates.get(RAW_SCALE, scale).value
    return None if ratio is None else ratio.value


def _gyro_bias_i(calibration: Calibration, config: Config) -> Floats | None:
    """Return the gyro bias in the axes and raw unit of the IMU messages, (3,), None if unknown."""
    estimates = [calibration.estimates.get(f'gyro_bias_{axis}') for axis in AXES]
    bias = [estimate.value for estimate in estimates
            if estimate is not None and estimate.value is not None]
    C_bi = next((leg.C_bi for leg in calibration.legs if leg.C_bi is not None), None)
    if C_bi is None or len(bias) < len(AXES):
        return None
    return np.asarray(C_bi).T @ bias / config.imu.gyro_scale


def _transform(calibration: Calibration, config: Config,
               content: dict[str, Any]) -> dict[str, str]:
    """Return the transform of the IMU as launch file, URDF joint and command; {} if unknown."""
    if calibration.imu_rotation_rpy is None:
        return {}
    xyz = [repr(float(length)) for length in config.imu.lever_arm]
    rpy = [repr(float(angle)) for angle in calibration.imu_rotation_rpy]
    base, imu = config.frames.base, config.frames.imu or IMU_FRAME
    name = re.sub(r'\W', '_', f'{base}_to_{imu}')        # a node's name has no / . -
    words = [word for option, value in zip((*AXES, 'roll', 'pitch', 'yaw'), (*xyz, *rpy),
                                           strict=True) for word in (f'--{option}', value)]
    words += ['--frame-id', base, '--child-frame-id', imu]
    joint = ElementTree.Element('joint', name=name, type='fixed')
    ElementTree.SubElement(joint, 'origin', xyz=' '.join(xyz), rpy=' '.join(rpy))
    ElementTree.SubElement(joint, 'parent', link=base)
    ElementTree.SubElement(joint, 'child', link=imu)
    launch = ElementTree.Element('launch')
    ElementTree.SubElement(launch, 'node', pkg='tf2_ros', exec='static_transform_publisher',
                           name=name, args=text_formats.for_launch(words))
    not_set = '' if any(config.imu.lever_arm) else ' (not set)'
    note = (f'{device_files.origin_text(calibration, content)}\n'
            f'translation: imu.lever_arm{not_set}; {not_estimated(calibration)} as configured')
    command = (text_formats.for_comment(
        f'{note}\nThe attitude of {imu} on {base}. robot_localization takes it from TF, which '
        'this command publishes;\n'
        'it is not the yaw_offset of navsat_transform, which corrects a compass.')
        + f'ros2 run tf2_ros static_transform_publisher {text_formats.for_shell(words)}\n')
    return {LAUNCH: '<?xml version="1.0"?>\n' + _xml(
                launch, f'include it in the launch file of your vehicle\n{note}'),
            URDF: _xml(joint, 'put it into your URDF in place of the joint of the IMU\n' + note),
            COMMAND: command}


def _xml(root: Any, note: str) -> str:
    """Return an element as text after a comment."""
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding='unicode')
    return f'<!-- {text_formats.for_xml_comment(note)} -->\n{text}\n'


def with_imu_frame(calibration: Calibration, config: Config,
                   frame: str) -> tuple[Calibration, Config]:
    """Return result and settings with the frame of the IMU messages, unless it is configured."""
    # a frame from a bag is untrusted: a note states that it is replaced
    if config.frames.imu or not frame:
        return calibration, config
    valid = frame.lstrip('/')       # ROS 1 frames begin with /
    valid = valid if text_formats.is_frame(valid) else IMU_FRAME
    if valid != frame:
        note = Reason(Code.FRAME_REPLACED, 'the frame of the IMU messages, '
                      f"'{text_formats.one_line(frame[:60])}', is not valid in TF; "
                      f'{valid} is written')
        calibration = replace(calibration, reasons=(*calibration.reasons, note))
    return calibration, with_settings(config, {'frames.imu': valid})


def geojson(calibration: Calibration, config: Config, content: dict[str, Any]) -> dict[str, str]:
    """Return file name -> text, empty if no leg has a track."""
    # many legs share the points of a file, so that it stays small; a leg has three tracks
    track_count, points_of_file = 3 * max(1, len(calibration.legs)), 150_000
    max_points = max(2, min(MAX_TRACK_POINTS, points_of_file // track_count))
    shapes = [feature for n, leg in enumerate(calibration.legs, 1)
              for feature in features(n, leg, max_points)]
    if not shapes:
        return {}
    collection = {'type': 'FeatureCollection', 'name': 'odocal', 'about': TRACK_TEXT,
                  'software': content['software'], 'created': content['created'],
                  'result': sentence(calibration), 'features': shapes}
    return {TRACK: json.dumps(collection, allow_nan=False, ensure_ascii=False) + '\n'}


def features(number: int, leg: LegResult, max_points: int) -> list[dict[str, Any]]:
    """Return the features of a leg, of at most ``max_points`` points; none in a local frame."""
    if leg.origin is None:
        return []

    def feature(geometry: dict[str, Any], kind: str, **properties: Any) -> dict[str, Any]:
        return {'type': 'Feature', 'geometry': geometry,
                'properties': {'kind': kind, 'leg': number, 'bag': leg.bag,
                               'verdict': leg.verdict.value, **properties}}
    shapes = []
    for kind, rows, geometry in (('corrected', leg.track_n, _line),
                                 ('as_configured', leg.track_before_n, _line),
                                 ('fixes', leg.reference_n, lambda rows: {
                                     'type': 'MultiPoint', 'coordinates': rows.tolist()})):
        positions = _positions(rows, leg, max_points)
        if rows is not None and len(positions):
            shapes.append(feature(geometry(positions), kind, points=len(positions), of=len(rows)))
    track = _positions(leg.track_n, leg, max_points)
    if len(track):
        for name, row, stamp_ns in (('start', 0, leg.start_ns), ('stop', -1, leg.stop_ns)):
            point = {'type': 'Point', 'coordinates': track[row].tolist()}
            shapes.append(feature(point, 'mark', mark=name, stamp_ns=stamp_ns))
    return shapes


def _positions(rows_n: Floats | None, leg: LegResult, max_points: int) -> Floats:
    """Return rows of n, m, as (k, 2 or 3) longitude, latitude, deg, and height, m, if known."""
    if rows_n is None or leg.origin is None or not len(rows_n):
        return np.empty((0, 3))
    rows_n = np.array(rows_n, dtype=float)[even_rows(len(rows_n), max_points)]
    rows_n = rows_n[np.isfinite(rows_n[:, :2]).all(axis=1)]
    geodetic = Origin(*leg.origin).to_geodetic(np.nan_to_num(rows_n))
    degrees = np.rad2deg(geodetic[:, 1::-1]).round(DEGREE_PLACES)
    if np.isnan(rows_n[:, 2]).any():
        return degrees
    height_places = 3    # mm
    return np.column_stack([degrees, geodetic[:, 2].round(height_places)])


def _line(positions: Floats) -> dict[str, Any]:
    """Return a line, cut where it crosses the 180th meridian (RFC 7946, 3.1.9)."""
    jumps = np.flatnonzero(np.abs(np.diff(positions[:, 0])) > 180)
    if len(positions) < 2:
        return {'type': 'Point', 'coordinates': positions[0].tolist()}
    if not len(jumps):
        return {'type': 'LineString', 'coordinates': positions.tolist()}
    pieces = [piece.tolist() for piece in np.split(positions, jumps + 1)]
    for k, row in enumerate(jumps):
        end, begin = _crossing(positions[row], positions[row + 1])
        pieces[k].append(end)
        pieces[k + 1].insert(0, begin)
    return {'type': 'MultiLineString', 'coordinates': pieces}


def _crossing(before: Floats, after: Floats) -> tuple[list[float], list[float]]:
    """Return the point on the 180th meridian between two points, on the side of each."""
    side = 180.0 if before[0] > 0 else -180.0
    # longitude of ``after`` continued beyond the meridian: + 2 * side
    share = (side - before[0]) / (after[0] + 2 * side - before[0])
    others = (before[1:] + share * (after[1:] - before[1:])).round(DEGREE_PLACES).tolist()
    return [side, *others], [-side, *others]


# name in output.formats: function of calibration, settings, content of calibration.json
FORMATS = {
    'autoware': _autoware, 'transform': _transform, 'ros2_control': device_files.controllers,
    'devices': device_files.devices, 'covariance': device_files.wheel_covariance,
    'imu': device_files.imu_errors, 'track': geojson, 'legs': leg_table}
