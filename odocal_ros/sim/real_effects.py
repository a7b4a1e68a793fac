# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Parameters of the errors of real sensors beyond noise and bias, with their checks.

``RealEffects`` has one field for each; its defaults mean no error. ``real_sensors.py``,
``wheels.py`` and ``body.py`` apply them; ``odocal simulate --real NAME=VALUE`` sets them.
"""

import ast
from dataclasses import dataclass, Field, field, fields
import difflib
import math
from typing import Any, TypeVar

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.errors import BadUsage
from odocal_ros.settings.nominal import GRADES

Vector = tuple[float, float, float]
Matrix = tuple[float, ...]      # nine, row by row
ZEROS3, ZEROS9 = (0.0,) * 3, (0.0,) * 9    # definition
CHOICES = {'speed_rounding': ('floor', 'round'), 'configured_grade': tuple(GRADES)}
T = TypeVar('T')
# keys of the metadata of a field
SIGNED, POSITIVE, PAIRS = 'may be negative', 'above 0', 'names of a pair and an example'


def _signed(default: T) -> T:
    """Return a field that may be negative; others may not."""
    return field(default=default, metadata={SIGNED: True})


def _positive(default: float) -> float:
    """Return a field that must be above 0."""
    return field(default=default, metadata={POSITIVE: True})


def _pairs(*texts: str) -> tuple[tuple[float, float], ...]:
    """Return a field with pairs; texts : names of first and second number, and an example."""
    return field(default=(), metadata={PAIRS: texts})


@dataclass(frozen=True, kw_only=True)
class RealEffects:
    """
    Parameters of a vehicle, SI and radians; those of the IMU in its own frame i (the housing).

    The IMU reads ``w_m = (I + M_g) w + b_g + G f + n`` and ``f_m = (I + M_a) f + b_a + n``.
    """

    gyro_matrix: Matrix = _signed(ZEROS9)        # M_g: scale on the diagonal, misalignment off it
    accel_matrix: Matrix = _signed(ZEROS9)       # M_a
    g_sensitivity: Matrix = _signed(ZEROS9)      # G, rad/s per m/s^2
    gyro_bias: Vector | None = _signed(None)     # rad/s at the first sample; None: by the grade
    accel_bias: Vector | None = _signed(None)    # m/s^2
    gyro_step: Vector = _signed(ZEROS3)          # rad/s, change of the bias at bias_step_at
    accel_step: Vector = _signed(ZEROS3)         # m/s^2
    bias_step_at: float = 0.0                    # s after the first sample
    gyro_slope: Vector = _signed(ZEROS3)         # rad/s per K
    accel_slope: Vector = _signed(ZEROS3)        # m/s^2 per K
    warm_rise: float = _signed(0.0)              # K of warming after the first sample
    warm_time: float = _positive(300.0)          # s
    gyro_instability: float = 0.0            # rad/s, 1 sigma of a first-order Gauss-Markov process
    accel_instability: float = 0.0               # m/s^2
    instability_time: float = _positive(3600.0)  # s
    vibration: float = 0.0                    # m/s^2 rms of each axis at high speed; half at 5 m/s
    gyro_vibration: float = 0.0                  # rad/s rms
    rectification: float = _signed(0.0)          # m/s^2 of bias per (m/s^2)^2 of vibration
    imu_latency: float = 0.0                     # s, mean delay of its stamps
    imu_jitter: float = 0.0                      # s, 1 sigma
    imu_batch: int = 1                           # samples that arrive, and are stamped, together

    speed_step: float = 0.0               # resolution, in the unit of the published speed; 0: none
    speed_rounding: str = 'floor'                # one of CHOICES
    dead_band: float = 0.0                       # speeds below are published as 0
    speed_hold: float = 0.0                      # least change of speed that is published
    speed_filter: float = 0.0                  # s, time constant of a low-pass filter on the speed
    odometer_jitter: float = 0.0                 # s, 1 sigma, on top of odometer_delay
    odometer_clock_rate: float = _signed(0.0)    # relative rate error of its clock to the IMU's
    speed_law: float = _signed(0.0)              # relative growth of the tyres at 36 m/s, as v^2
    warming: float = _signed(0.0)                # relative growth of the tyres, from cold to warm
    warming_time: float = _positive(600.0)       # s of driving
    tyre_slip: float = 0.0                       # slip by tyre force over load: 1 / stiffness
    driven: bool = True                    # the wheel that is counted drives (else it only brakes)

    sideslip: float = _signed(0.0)           # rad per m/s^2 to the side; outwards at the rear axle
    squat: float = _signed(0.0)                  # rad per m/s^2, nose up
    brake_dive: float = _signed(0.0)    # rad per m/s^2 of braking, nose down, added to squat
    wheelbase: float = 0.0                   # m, the body is parallel to its chord; 0: to the road
    body_roll: float = _signed(0.0)              # rad per m/s^2, outwards
    banking: float = 0.0                         # share of the lateral force taken by banking
    constant_crossfall: float = _signed(0.0)     # rad, constant lean of the road to the right
    kneeling: float = _signed(0.0)               # rad, lean of a bus to the right at a stop
    kerbs: float = 0.0                           # m, alternately up and down
    kerb_distance: float = _positive(15.0)       # m, mean, between them
    alternating_crossfall: float = 0.0           # rad, largest, alternating in side
    alternating_crossfall_length: float = _positive(20.0)  # m, its wavelength

    imu_arm_error: Vector = _signed(ZEROS3)      # m, configured minus true
    odometer_arm_error: Vector = _signed(ZEROS3)
    antenna_arm_error: Vector = _signed(ZEROS3)

    receiver_lag: float = 0.0               # s, time constant of a first-order filter on positions
    receiver_tracking: float = 0.0          # s, time constant of a filter of position and velocity
    receiver_odometer: float = _signed(0.0)   # relative scale error of an odometer in the receiver
    receiver_odometer_time: float = _positive(20.0)  # s in which satellites correct it
    # (sigma east and north, m; correlation time, s) each; up has twice the sigma
    slow_errors: tuple[tuple[float, float], ...] = _pairs(
        'sigma', 'correlation time', '((1.2,60),(0.9,900))')
    bursts: float = 0.0                          # multipath bursts per hour
    burst_size: float = 12.0                     # m, median
    burst_time: float = _positive(8.0)           # s, median
    burst_onset: float = _positive(2.0)          # s, mean rise and fall time
    burst_spread: float = 0.9                    # of the logarithm of size and duration, 1 sigma
    # (begin, length) s each, in which the receiver dead-reckons by an odometer and a gyro
    tunnels: tuple[tuple[float, float], ...] = _pairs(
        'begin', 'length', '((200,60),(400,30))')
    tunnel_odometer: float = _signed(0.0)        # relative scale error of this odometer
    tunnel_heading: float = _signed(0.0)         # rad, heading error after a minute in a tunnel
    drops: float = 0.0                           # share of lost fixes
    fix_jitter: float = 0.0                      # s, 1 sigma, on top of fix_delay
    fix_clock_rate: float = _signed(0.0)         # relative rate error of its clock to the IMU's
    stated_sigma_ratio: float = _positive(1.0)   # stated sigma over true sigma
    configured_grade: str | None = None          # configured imu.grade; None: the true one

    def __post_init__(self) -> None:
        for parameter in fields(self):
            value = _check(parameter, getattr(self, parameter.name))
            object.__setattr__(self, parameter.name, value)

    def matrix(self, name: str) -> Floats:
        """Return a matrix by its name: (3, 3)."""
        return np.reshape(getattr(self, name), (3, 3))


def _check(parameter: Field[Any], value: Any) -> Any:
    """Return a parameter as numbers and tuples of them, or raise BadUsage."""
    default, metadata = parameter.default, parameter.metadata

    def require(is_valid: bool, requirement: str) -> None:
        if not is_valid:
            raise BadUsage(f'--real {parameter.name}={value}: required: {requirement}')
    choices = CHOICES.get(parameter.name, ())
    if choices or (value is None and default is None):
        require(value in (*choices, default), f'one of {", ".join(choices)}')
        return value
    if isinstance(value, list | tuple):       # lists: as read from YAML
        value = tuple(tuple(v) if isinstance(v, list) else v for v in value)
    numbers = value if isinstance(value, tuple) else (value,)
    if PAIRS in metadata:
        first, second, example = metadata[PAIRS]
        require(value is numbers and all(isinstance(v, tuple) and len(v) == 2 for v in value),
                f'pairs of {first} and {second}, such as {example}')
        require(all(v[1] for v in value), f'a {second} above 0')
        numbers = tuple(x for pair in value for x in pair)
    elif default is None or isinstance(default, tuple):
        count = len(default or ZEROS3)
        require(value is numbers and len(value) == count,
                f'{count} numbers, such as ({"0," * (count - 1)}0.01)')
    else:
        require(value is not numbers, 'one number')
    require(all(isinstance(x, int | float) and math.isfinite(x) for x in numbers),
            'finite numbers')
    smallest = min(numbers, default=1.0)      # without pairs there is no number
    if parameter.name == 'drops':
        require(0 <= smallest < 1, '0 or more, below 1')
    elif parameter.name == 'imu_batch':
        require(smallest >= 1 and smallest % 1 == 0, 'a whole number, 1 or more')
    elif POSITIVE in metadata:
        require(smallest > 0, POSITIVE)
    else:
        require(smallest >= 0 or SIGNED in metadata, '0 or more')
    return value


def parse_parameter(text: str) -> tuple[str, Any]:
    """Return name and value of ``NAME=VALUE``; raise BadUsage for an unknown name."""
    name, _, value = text.partition('=')
    names = [parameter.name for parameter in fields(RealEffects)]
    if name not in names:
        similar = difflib.get_close_matches(name, names, 3) or names
        raise BadUsage(f'--real {name}: no such parameter; similar: {", ".join(similar)}')
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value
