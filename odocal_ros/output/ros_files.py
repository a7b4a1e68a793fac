"""Texts of the files that other ROS programs load unchanged."""

import math
from xml.sax.saxutils import quoteattr

import numpy as np

from odocal_ros.calib.result import Calibration
from odocal_ros.config import Config
from odocal_ros.output.summary import sentence
from odocal_ros.reasons import Verdict

PARAMS = 'calibration.yaml'
VELOCITY = 'vehicle_velocity_converter.param.yaml'
IMU = 'imu_corrector.param.yaml'
LAUNCH, URDF, COMMAND = ('imu_transform.launch.xml', 'imu_transform.urdf', 'imu_transform.txt')
NAMES = {PARAMS, VELOCITY, IMU, LAUNCH, URDF, COMMAND}
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
    head = _head(calibration, content)
    if 'autoware' in formats:
        factor, bias_i = _speed_factor(calibration), _gyro_bias_i(calibration, config)
        if factor is not None:
            out[VELOCITY] = head + _velocity_converter(factor, config.frames.base)
        if bias_i is not None:
            out[IMU] = head + _imu_corrector(bias_i)
    if 'transform' in formats and calibration.imu_rotation_rpy is not None:
        out |= _transform(calibration, config, content)
    return out


def number(value: float | None) -> str:
    """Return a double as YAML that every reader types as one: 1e-05 is text to YAML 1.1."""
    if value is None or not math.isfinite(value):
        return '.nan'
    text = repr(float(value))
    mantissa, e, exponent = text.partition('e')
    return text if not e or '.' in mantissa else f'{mantissa}.0e{exponent}'


def _head(calibration, content) -> str:
    bags = ', '.join(str(i['bag']) for i in content['inputs'] if i.get('bag')) or 'live'
    lines = [f'{content["software"]}, {content["created"]}, {len(calibration.legs)} leg'
             f'{"s" * (len(calibration.legs) != 1)}, from: {bags}', sentence(calibration)]
    return ''.join(f'# {line}\n' for line in lines)


def _params(calibration, content) -> str:
    lines = [_head(calibration, content).rstrip(),
             '# scale factor: metres of travel per pulse (per rad for joints, 1 for speeds)',
             '# angles: rad, of the IMU on the vehicle about fixed axes; yaw > 0: its x axis '
             'points left of forward',
             '/**:', '  ros__parameters:', '    result:']
    for name, entry in content['result'].items():
        if name != 'imu_rotation':
            lines += [f'      {name}: {number(entry["value"])}',
                      f'      {name}_sigma: {number(entry["sigma"])}']
    valid = calibration.verdict is not Verdict.REJECTED
    lines += [f'      legs: {len(calibration.legs)}', f'      valid: {str(valid).lower()}',
              f"      stamp: '{content['created']}'"]
    return '\n'.join(lines) + '\n'


def _speed_factor(calibration) -> float | None:
    """Return what to multiply reported speeds by; pulses have one only against a nominal K0."""
    scale, ratio = (calibration.estimates.get(n) for n in ('scale_factor', 'scale_ratio'))
    if scale is not None and scale.unit == '1':
        return scale.value
    return None if ratio is None else ratio.value


def _velocity_converter(factor, frame) -> str:
    return ('# for autoware vehicle_velocity_converter; the two stddev are its defaults, not '
            'measured here\n'
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
    lines = ['# for autoware imu_corrector; the stddev are its defaults, not measured here',
             '/**:', '  ros__parameters:']
    lines += [f'    angular_velocity_offset_{axis}: {number(b)}'
              for axis, b in zip(AXES, bias_i, strict=True)]
    lines += [f'    angular_velocity_stddev_{axis}{axis}: 0.03' for axis in AXES]
    return '\n'.join(lines) + '\n'


def _transform(calibration, config, content) -> dict[str, str]:
    xyz = [repr(float(v)) for v in config.imu.lever_arm]
    rpy = [repr(float(v)) for v in calibration.imu_rotation_rpy]
    base, imu = config.frames.base, config.frames.imu or IMU_FRAME
    options = ' '.join([*(f'--{a} {v}' for a, v in zip(AXES, xyz, strict=True)),
                        *(f'--{a} {v}' for a, v in zip(('roll', 'pitch', 'yaw'), rpy,
                                                       strict=True)),
                        f'--frame-id {base}', f'--child-frame-id {imu}'])
    note = _head(calibration, content).replace('# ', '').replace('--', '-').strip()
    urdf = (f'<!-- put into your URDF in place of the joint that carries the IMU\n{note} -->\n'
            f'<joint name={quoteattr(f"{base}_to_{imu}")} type="fixed">\n'
            f'  <origin xyz="{" ".join(xyz)}" rpy="{" ".join(rpy)}"/>\n'
            f'  <parent link={quoteattr(base)}/>\n  <child link={quoteattr(imu)}/>\n</joint>\n')
    launch = ('<?xml version="1.0"?>\n'
              f'<!-- {note} -->\n<launch>\n'
              f'  <node pkg="tf2_ros" exec="static_transform_publisher" name='
              f'{quoteattr(f"{base}_to_{imu}")}\n        args={quoteattr(options)}/>\n</launch>\n')
    command = (_head(calibration, content)
               + f'# The attitude of {imu} on {base}. robot_localization takes it from TF, which '
               'this command publishes;\n'
               '# it is not the yaw_offset of navsat_transform, which corrects a compass.\n'
               f'ros2 run tf2_ros static_transform_publisher {options}\n')
    return {LAUNCH: launch, URDF: urdf, COMMAND: command}
