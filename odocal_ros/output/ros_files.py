"""Texts of the files that other programs load unchanged."""

from xml.sax.saxutils import quoteattr

import numpy as np

from odocal_ros.calib.result import BESIDE, Calibration
from odocal_ros.config import Config
from odocal_ros.output.controller_files import CONTROLLERS, controllers
from odocal_ros.output.device_files import DEVICES, devices
from odocal_ros.output.file_head import head, number
from odocal_ros.output.geojson import geojson, TRACK
from odocal_ros.output.leg_table import leg_table, LEGS
from odocal_ros.reasons import Verdict

PARAMS = 'calibration.yaml'
VELOCITY = 'vehicle_velocity_converter.param.yaml'
IMU = 'imu_corrector.param.yaml'
LAUNCH, URDF, COMMAND = ('imu_transform.launch.xml', 'imu_transform.urdf', 'imu_transform.txt')
NAMES = {PARAMS, VELOCITY, IMU, LAUNCH, URDF, COMMAND, CONTROLLERS, DEVICES, TRACK, LEGS}
# declared by the node for every drive; of one wheel they stay unknown
TWO_WHEELS = ('scale_factor_left', 'scale_factor_right', 'heading_error', 'track_width')
IMU_FRAME = 'imu_link'      # REP-145, where frames.imu is left empty
AXES = 'xyz'


def texts(calibration: Calibration, config: Config, content: dict) -> dict[str, str]:
    """
    Return file texts by name for the formats asked.

    Files that a vehicle would act on are given only for values worth acting on: none when the
    calibration is rejected, and each only if what it holds was determined.
    """
    out: dict[str, str] = {}
    formats = config.output.formats
    if 'params' in formats:
        out[PARAMS] = _params(calibration, content)
    if calibration.verdict is Verdict.REJECTED:
        return out
    for name, make in MAKERS.items():
        if name in formats:
            out |= make(calibration, config, content)
    return out


def _params(calibration, content) -> str:
    lines = [head(calibration, content).rstrip(),
             '# for the node calibrator: --params-file, or ros2 param load',
             '# scale factor: metres of travel per pulse (per rad for joints, 1 for speeds)',
             '# angles: rad, of the IMU on the vehicle about fixed axes; yaw > 0: its x axis '
             'points left of forward',
             '/**:', '  ros__parameters:', '    result:']
    unknown = dict.fromkeys(TWO_WHEELS, {'value': None, 'sigma': None})
    for name, entry in (unknown | content['result']).items():
        if name not in BESIDE:
            lines += [f'      {name}: {number(entry["value"])}',
                      f'      {name}_sigma: {number(entry["sigma"])}']
    valid = calibration.verdict is not Verdict.REJECTED
    lines += [f'      legs: {len(calibration.legs)}', f'      valid: {str(valid).lower()}',
              f"      stamp: '{content['created']}'"]
    return '\n'.join(lines) + '\n'


def _autoware(calibration, config, content) -> dict[str, str]:
    out = {}
    top = head(calibration, content)
    factor, bias_i = _speed_factor(calibration), _gyro_bias_i(calibration, config)
    if factor is not None:
        out[VELOCITY] = top + _velocity_converter(factor, config.frames.base)
    if bias_i is not None:
        out[IMU] = top + _imu_corrector(bias_i)
    return out


def _speed_factor(calibration) -> float | None:
    """Return what to multiply reported speeds by; pulses have one only against a nominal K0."""
    scale, ratio = (calibration.estimates.get(n) for n in ('scale_factor', 'scale_ratio'))
    if scale is not None and scale.unit == '1':
        return scale.value
    return None if ratio is None else ratio.value


def _velocity_converter(factor, frame) -> str:
    return ('# for autoware vehicle_velocity_converter, in place of its param file of this name;\n'
            '# the two stddev are its defaults, not measured here\n'
            '/**:\n  ros__parameters:\n'
            f'    speed_scale_factor: {number(factor)}\n'
            '    velocity_stddev_xx: 0.2\n'
            '    angular_velocity_stddev_zz: 0.1\n'
            f'    frame_id: {frame}\n')


def _gyro_bias_i(calibration, config):
    """Return the gyro bias in the Imu's own axes and unit as sent, (3,), None if unknown."""
    bias = [calibration.estimates.get(f'gyro_bias_{axis}') for axis in AXES]
    C_bi = next((leg.C_bi for leg in calibration.legs if leg.C_bi is not None), None)
    if C_bi is None or any(e is None or e.value is None for e in bias):
        return None
    return np.asarray(C_bi).T @ [e.value for e in bias] / config.imu.gyro_scale


def _imu_corrector(bias_i) -> str:
    lines = ['# for autoware imu_corrector, in place of its param file of this name;',
             '# the stddev are its defaults, not measured here',
             '/**:', '  ros__parameters:']
    lines += [f'    angular_velocity_offset_{axis}: {number(b)}'
              for axis, b in zip(AXES, bias_i, strict=True)]
    lines += [f'    angular_velocity_stddev_{axis}{axis}: 0.03' for axis in AXES]
    return '\n'.join(lines) + '\n'


def _transform(calibration, config, content) -> dict[str, str]:
    if calibration.imu_rotation_rpy is None:
        return {}
    xyz = [repr(float(v)) for v in config.imu.lever_arm]
    rpy = [repr(float(v)) for v in calibration.imu_rotation_rpy]
    base, imu = config.frames.base, config.frames.imu or IMU_FRAME
    options = ' '.join([*(f'--{a} {v}' for a, v in zip(AXES, xyz, strict=True)),
                        *(f'--{a} {v}' for a, v in zip(('roll', 'pitch', 'yaw'), rpy,
                                                       strict=True)),
                        f'--frame-id {base}', f'--child-frame-id {imu}'])
    note = head(calibration, content).replace('# ', '').replace('--', '-').strip()
    urdf = (f'<!-- put into your URDF in place of the joint that carries the IMU\n{note} -->\n'
            f'<joint name={quoteattr(f"{base}_to_{imu}")} type="fixed">\n'
            f'  <origin xyz="{" ".join(xyz)}" rpy="{" ".join(rpy)}"/>\n'
            f'  <parent link={quoteattr(base)}/>\n  <child link={quoteattr(imu)}/>\n</joint>\n')
    launch = ('<?xml version="1.0"?>\n'
              f'<!-- include it in the launch file of your vehicle\n{note} -->\n<launch>\n'
              f'  <node pkg="tf2_ros" exec="static_transform_publisher" name='
              f'{quoteattr(f"{base}_to_{imu}")}\n        args={quoteattr(options)}/>\n</launch>\n')
    command = (head(calibration, content)
               + f'# The attitude of {imu} on {base}. robot_localization takes it from TF, which '
               'this command publishes;\n'
               '# it is not the yaw_offset of navsat_transform, which corrects a compass.\n'
               f'ros2 run tf2_ros static_transform_publisher {options}\n')
    return {LAUNCH: launch, URDF: urdf, COMMAND: command}


MAKERS = {'autoware': _autoware, 'transform': _transform, 'ros2_control': controllers,
          'devices': devices, 'track': geojson, 'legs': leg_table}
