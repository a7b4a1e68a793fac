# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Parameters of the errors of real sensors beyond noise and bias, with their checks.

``RealEffects`` has one field for each; its defaults mean no error. ``real_sensors.py``,
``wheels.py`` and ``body.py`` apply them; ``odocal simulate --real NAME=VALUE`` sets them.
"""

from dataclasses import dataclass, fields
import difflib
import math
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.errors import BadUsage
from odocal_ros.settings.nominal import GRADES

Vector = tuple[float, float, float]
Matrix = tuple[float, ...]      # nine, row by row
ZEROS3, ZEROS9 = (0.0,) * 3, (0.0,) * 9    # definition
CHOICES = {'speed_rounding': ('floor', 'round'), 'configured_grade': tuple(GRADES)}
# names of parameters that may be negative; of those that are pairs; of those above 0
SIGNED = ('gyro_matrix', 'accel_matrix', 'g_sensitivity', 'gyro_bias', 'accel_bias', 'gyro_step',
          'accel_step', 'gyro_slope', 'accel_slope', 'warm_rise', 'rectification', 'speed_law',
          'warming', 'imu_arm_error', 'odometer_arm_error', 'antenna_arm_error',
          'receiver_odometer', 'sideslip', 'squat', 'body_roll', 'crossfall', 'kneeling',
          'tunnel_odometer', 'tunnel_heading', 'odometer_clock_rate', 'fix_clock_rate')
PAIRS = {'slow_errors': ('sigma', 'correlation time', '((1.2,60),(0.9,900))'),
         'tunnels': ('begin', 'length', '((200,60),(400,30))')}
POSITIVE = ('warm_time', 'wander_time', 'warming_time', 'burst_time', 'stated_factor',
            'receiver_odometer_time', 'burst_onset', 'kerb_distance',
            'cross_slope_length')


@dataclass(frozen=True, kw_only=True)
class RealEffects:
    """
    Parameters of a vehicle, SI and radians; those of the IMU in its own frame i (the housing).

    The IMU reads ``w_m = (I + M_g) w + b_g + G f + n`` and ``f_m = (I + M_a) f + b_a + n``.
    """

    gyro_matrix: Matrix = ZEROS9      # M_g: scale on the diagonal, misalignment off it
    accel_matrix: Matrix = ZEROS9     # M_a
    g_sensitivity: Matrix = ZEROS9    # G, rad/s per m/s^2
    gyro_bias: Vector | None = None  # rad/s at the first sample; None: drawn by the grade
    accel_bias: Vector | None = None   # m/s^2
    gyro_step: Vector = ZEROS3        # rad/s, change of the bias at bias_step_at
    accel_step: Vector = ZEROS3       # m/s^2
    bias_step_at: float = 0.0        # s after the first sample
    gyro_slope: Vector = ZEROS3       # rad/s per K
    accel_slope: Vector = ZEROS3      # m/s^2 per K
    warm_rise: float = 0.0           # K of warming after the first sample
    warm_time: float = 300.0         # s
    gyro_wander: float = 0.0         # rad/s, in-run instability, first order Markov
    accel_wander: float = 0.0        # m/s^2
    wander_time: float = 3600.0      # s
    vibration: float = 0.0           # m/s^2 rms of each axis, reached at speed
    gyro_vibration: float = 0.0      # rad/s rms
    rectification: float = 0.0       # m/s^2 of bias per (m/s^2)^2 of vibration
    imu_latency: float = 0.0         # s, mean delay of its stamps
    imu_jitter: float = 0.0          # s, 1 sigma
    imu_batch: int = 1               # samples that arrive, and are stamped, together

    speed_step: float = 0.0          # resolution of the published speed, in its unit; 0: none
    speed_rounding: str = 'floor'    # floor or round
    dead_band: float = 0.0           # speeds below are published as 0
    speed_hold: float = 0.0          # least change of speed that is published
    speed_filter: float = 0.0        # s, time constant of a low-pass filter on the speed
    odometer_jitter: float = 0.0     # s, 1 sigma, on top of odometer_delay
    odometer_clock_rate: float = 0.0    # relative rate error of its clock to that of the IMU
    speed_law: float = 0.0           # relative growth of the tyres at 36 m/s, as v^2
    warming: float = 0.0             # relative growth of the tyres, from cold to warm
    warming_time: float = 600.0      # s of driving
    tyre_slip: float = 0.0           # slip by tyre force over load: 1 / stiffness
    driven: bool = True              # the wheel that is counted drives (else it only brakes)

    sideslip: float = 0.0            # rad per m/s^2 to the side, rear axle drifts outwards
    squat: float = 0.0               # rad per m/s^2, nose up
    wheelbase: float = 0.0           # m, the body is parallel to its chord; 0: to the road
    body_roll: float = 0.0           # rad per m/s^2, outwards
    banking: float = 0.0             # share of the lateral force taken by banking
    crossfall: float = 0.0           # rad, constant lean of the road to the right
    kneeling: float = 0.0            # rad, lean of a bus to the right at a stop
    kerbs: float = 0.0               # m, alternately up and down
    kerb_distance: float = 15.0      # m, mean, between them
    cross_slope: float = 0.0         # rad, largest, alternating in side
    cross_slope_length: float = 20.0    # m, its wavelength

    imu_arm_error: Vector = ZEROS3        # m, configured minus true
    odometer_arm_error: Vector = ZEROS3
    antenna_arm_error: Vector = ZEROS3

    receiver_lag: float = 0.0        # s, time constant of a first-order filter on positions
    receiver_tracking: float = 0.0   # s, time constant of a filter of position and velocity
    receiver_odometer: float = 0.0   # relative scale error of an odometer fused into the fixes
    receiver_odometer_time: float = 20.0    # s in which satellites correct it
    # (sigma m of east and north, up twice; correlation s) each
    slow_errors: tuple[tuple[float, float], ...] = ()
    bursts: float = 0.0              # multipath bursts per hour
    burst_size: float = 12.0         # m, median
    burst_time: float = 8.0          # s, median
    burst_onset: float = 2.0         # s, mean rise and fall time
    burst_spread: float = 0.9        # of the logarithm of size and length, 1 sigma
    # (begin, length) s each, in which the receiver dead-reckons by an odometer and a gyro
    tunnels: tuple[tuple[float, float], ...] = ()
    tunnel_odometer: float = 0.0     # relative scale error of this odometer
    tunnel_heading: float = 0.0      # rad, heading error at the end of a tunnel's first minute
    drops: float = 0.0               # share of lost fixes
    fix_jitter: float = 0.0          # s, 1 sigma, on top of fix_delay
    fix_clock_rate: float = 0.0      # relative rate error of its clock to that of the IMU
    stated_factor: float = 1.0       # stated sigma over true sigma
    configured_grade: str | None = None    # configured imu.grade; None: the true one

    def __post_init__(self) -> None:
        for field in fields(self):
            value = _checked(field.name, getattr(self, field.name), field.default)
            object.__setattr__(self, field.name, value)

    def matrix(self, name: str) -> Floats:
        """Return a matrix by its name: (3, 3)."""
        return np.reshape(getattr(self, name), (3, 3))


def _checked(name: str, value: Any, default: Any) -> Any:
    """Return a parameter as numbers and tuples of them, or raise BadUsage."""
    if name in CHOICES:
        if value not in CHOICES[name] and value != default:
            raise BadUsage(f'--real {name}={value}: required: one of {", ".join(CHOICES[name])}')
        return value
    if value is None and default is None:
        return None
    if isinstance(value, list | tuple):
        value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
    numbers = _numbers(name, value, default)
    if not all(isinstance(x, int | float) and math.isfinite(x) for x in numbers):
        raise BadUsage(f'--real {name}={value}: required: finite numbers')
    smallest = min(numbers, default=1.0)
    is_valid, requirement = smallest >= 0 or name in SIGNED, '0 or more'
    if name == 'drops':
        is_valid, requirement = 0 <= smallest < 1, '0 or more, below 1'
    elif name == 'imu_batch':
        is_valid, requirement = smallest >= 1 and smallest % 1 == 0, 'a whole number, 1 or more'
    elif name in POSITIVE:
        is_valid, requirement = smallest > 0, 'above 0'
    if not is_valid:
        raise BadUsage(f'--real {name}={value}: required: {requirement}')
    return value


def _numbers(name: str, value: Any, default: Any) -> tuple[Any, ...]:
    """Return the numbers of a parameter, or raise BadUsage for a wrong form."""
    if name in PAIRS:
        first, second, example = PAIRS[name]
        if not (isinstance(value, tuple)
                and all(isinstance(v, tuple) and len(v) == 2 for v in value)):
            raise BadUsage(f'--real {name}: required: pairs of {first} and {second}, such as '
                           f'{example}')
        if not all(v[1] for v in value):
            raise BadUsage(f'--real {name}: the {second} is 0; required: above 0')
        return tuple(x for pair in value for x in pair)
    count = 3 if default is None else len(default) if isinstance(default, tuple) else 0
    if isinstance(value, tuple) != bool(count) or count and len(value) != count:
        example = f'{count} numbers, such as ({"0," * (count - 1)}0.01)'
        raise BadUsage(f'--real {name}: required: {example if count else "one number"}')
    return value if count else (value,)


def parse_parameter(text: str) -> tuple[str, Any]:
    """Return name and value of ``NAME=VALUE``; raise BadUsage for an unknown name."""
    import ast
    name, _, value = text.partition('=')
    names = [f.name for f in fields(RealEffects)]
    if name not in names:
        similar = difflib.get_close_matches(name, names, 3) or names
        raise BadUsage(f'--real {name}: no such parameter; similar: {", ".join(similar)}')
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value
