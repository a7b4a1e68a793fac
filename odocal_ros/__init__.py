# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Calibrate a vehicle's odometer against IMU and GNSS.

Frames   n   local level, east-north-up, Cartesian, fixed to the Earth at the leg's start point
         b   IMU body: the Imu message's frame i after the nominal rotation, forward-left-up
         v   vehicle: x along the travel that positive pulses mean, y left, z up
         i   the Imu message's own frame; in ``w_ib`` and the like: inertial; e: Earth-fixed
Matrices C_nb takes a vector from b to n; letters that touch must match: f_n = C_nb @ f_b
Angles   mounting angles: fixed-axis roll, pitch, yaw of the IMU on the vehicle,
         v_v = C_vb v_b, C_vb = Rz(yaw) Ry(pitch) Rx(roll); yaw > 0: IMU's x axis points left of
         forward; pitch > 0: below it. yaw is from east, counter-clockwise; heading from north,
         clockwise
Units    SI and radians unless the name says otherwise; latitude and longitude in rad inside
Time     stamp_ns is int64 header time; t is float seconds since the start mark
Words    mark: a point the operator names; leg: what lies between two; track: the path dead
         reckoned; chord: straight line between a leg's ends; scale factor: metres of travel per
         pulse; fix: a GNSS position; pre-roll: samples kept before the start mark
Rooms    data       samples and legs         settings   what may be set, grades
         outside    names, YAML, files from and to others
         messages   from bytes to samples    bagio      bags; the only place of rosbags
         screening  what of it is usable     nav        strapdown, odometer, dead reckoning
         calib      methods, budgets, verdict, legs combined
         patent     the search of CN104359492A; paper: the tables of Shi et al. 2015
         pipeline   one pure function from leg to result
         planning   what a drive will tell; foresee: the same while it is driven
         apply      a calibration at work, sample by sample
         sim        drives with known truth  output     files, report, words
         live       the nodes, the only place of rclpy
         library    recordings, options and figures to answers, for any program
         offline    the odocal command        fleet   many vehicles; the only place of Dask
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
# name: its module; imported when it is first asked for, so that this page stays quick
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
