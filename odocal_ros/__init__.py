# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Calibrate a vehicle's odometer against IMU and GNSS.

Frames   n   local level, east-north-up, Cartesian, fixed to the Earth at the leg's start point
         b   IMU body: the IMU message's frame i after the nominal rotation, forward-left-up
         v   vehicle: x forward (direction of positive pulses), y left, z up
         i   frame of the IMU message; in ``w_ib`` and similar names: inertial; e: Earth-fixed
Matrices C_nb transforms a vector from b to n; adjacent letters match: f_n = C_nb @ f_b
Angles   mounting angles: fixed-axis roll, pitch, yaw of the IMU on the vehicle,
         v_v = C_vb v_b, C_vb = Rz(yaw) Ry(pitch) Rx(roll); yaw > 0: IMU's x axis points left of
         forward; pitch > 0: below it. yaw is from east, counter-clockwise; heading from north,
         clockwise
Units    SI and radians unless the name says otherwise; latitude and longitude in rad inside
Time     stamp_ns is int64 header time; t is float seconds since the start mark
Terms    see the glossary in CONTRIBUTING.md
Packages data       samples and legs         settings   settings and IMU grades
         safe_io    limits for untrusted files, safe text, atomic writing
         messages   bytes to samples         bagio      bags; the only user of rosbags
         screening  input checks             nav        strapdown, odometer, dead reckoning
         calib      two-point and planar methods, budgets, verdict, combination of legs
         estimator  the smoother: GNSS, IMU and odometer of a whole leg
         pipeline   one pure function from leg to result
         forecast   the sigmas that a drive will give: planned, or as far as it is driven
         apply      dead reckoning with a calibration, sample by sample
         pattern    patterns that a robot drives for a calibration
         sim        drives with known truth  output     result files, report, printed text
         live       the nodes; the only user of rclpy
         library    the functions behind the commands, for any program
         offline    the odocal command       fleet      many vehicles; the only user of Dask
Flow     messages -> data.samples -> data.leg -> screening -> pipeline.calibrate -> calib.result
         -> status, YAML, JSON
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from odocal_ros.errors import OdocalError
    from odocal_ros.library.calibrate_bag import calibrate_bag
    from odocal_ros.library.calibration import Calibration
    from odocal_ros.library.compare import compare, Comparison
    from odocal_ros.library.plan import plan, Planned
    from odocal_ros.library.read_bag import read_bag, Recording
    from odocal_ros.library.simulate import simulate
    from odocal_ros.settings.config import Config

__version__ = '1.0.0'
__all__ = ['Calibration', 'Comparison', 'Config', 'OdocalError', 'Planned', 'Recording',
           'calibrate_bag', 'compare', 'plan', 'read_bag', 'simulate']
# name: its module; imported at its first use, so that `import odocal_ros` stays quick
_HOMES = {'Calibration': 'library.calibration', 'Comparison': 'library.compare',
          'Config': 'settings.config', 'OdocalError': 'errors', 'Planned': 'library.plan',
          'Recording': 'library.read_bag', 'calibrate_bag': 'library.calibrate_bag',
          'compare': 'library.compare', 'plan': 'library.plan', 'read_bag': 'library.read_bag',
          'simulate': 'library.simulate'}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
