# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Draw a realistic vehicle: first its properties, then effects of its sensors (docs/zoo.md).

Each effect has its own random stream: it is the same alone or with others.
"""

from collections.abc import Sequence
import math
from typing import Any

import numpy as np

from odocal_ros.errors import BadUsage, unknown_name
from odocal_ros.sim.draw_effects import EFFECTS, RARE
from odocal_ros.sim.noise import make_rng
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real import Real
from odocal_ros.sim.zoo import flat, GRADES, ROWS, SIZES, Vehicle

KINDS = ('town', 'straight', 'out_and_back', 'motorway', 'yard')
ODOMETER_EFFECTS = ('coarse_speed', 'coarse_pulses')   # each needs an odometer of its own


def draw_vehicle(seed: int, kind: str, grade: str, effects: Sequence[str] | None = None,
                 **given: Any) -> tuple[SimOptions, tuple[str, ...]]:
    """
    Return SimOptions of a drawn vehicle, and the names of the effects that it has.

    seed : of the vehicle, and of the noise of its drive.   kind, grade : scenario, and class of
    the IMU: consumer, industrial or tactical.   effects : those to be drawn; None: all, ``()``:
    the clean vehicle.   given : SimOptions that are set, not drawn; ``real``: a dict of its
    fields.

    Raises BadUsage: a name is unknown.
    """
    if grade not in GRADES:
        raise BadUsage(f'--vehicle real with --imu-grade {grade}: required: one of '
                       f'{", ".join(GRADES)}')
    names = list(EFFECTS) if effects is None else list(effects)
    for name in names:
        if name not in EFFECTS | RARE:
            raise BadUsage(f'--effect {name}: {unknown_name(name, EFFECTS | RARE)}')
    if set(ODOMETER_EFFECTS) <= set(effects or ()):
        raise BadUsage(f'--effect {" and ".join(ODOMETER_EFFECTS)}: a vehicle has one odometer; '
                       'select one of them')
    fixed = given.pop('real', {})
    vehicle, options = _base_vehicle(seed, kind, grade, alone=effects is not None)
    if 'scale' in given:
        ratio = options['nominal_scale'] / options['scale']
        given = {'nominal_scale': given['scale'] * ratio} | given
    options |= given
    if effects is None:
        odometer = ('', 'coarse_pulses', 'coarse_speed')[int(
            make_rng(seed, 'vehicle odometer').choice(3, p=vehicle.row('odometers')))]
        names = [n for n in names if n not in ODOMETER_EFFECTS or n == odometer]
    real: dict[str, Any] = {}
    present = []
    for name in names:
        drawn = (EFFECTS | RARE)[name](make_rng(seed, f'vehicle {name}'), vehicle)
        if drawn.options or drawn.real:      # a draw may have no effect
            present.append(name)
        options |= drawn.options
        real |= drawn.real
    return SimOptions(**options | given, real=Real(**real | fixed)), tuple(present)


def _base_vehicle(seed: int, kind: str, grade: str, alone: bool) -> tuple[Vehicle, dict[str, Any]]:
    """Return the vehicle and its options before any effect."""
    rng, grade_index = make_rng(seed, 'vehicle'), GRADES.index(grade)
    roll, pitch, yaw = (math.radians(sigma) * rng.standard_normal()
                        for sigma in ROWS['mounting'][grade_index])
    heading, slope = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, 0.02)
    quarter = int(rng.integers(1, 4)) if rng.uniform() < 0.2 else 0     # known
    rtk, city = bool(rng.uniform() < SIZES['rtk'][grade_index]), bool(rng.uniform() < 0.45)
    robot = kind == 'yard' and grade == 'consumer'
    size = 0.5 if robot else 1.0
    antenna = size * rng.normal((0.8, 0.0, 1.3), (0.8, 0.3, 0.2))
    imu = size * rng.normal((0.8, 0.0, 0.4), (0.6, 0.3, 0.2))
    scale = 1 / (500.0 if robot else 1000.0)     # fine counts, unless the odometer is coarser
    options: dict[str, Any] = {
        'scenario': kind, 'seed': seed, 'imu_grade': grade, 'heading': heading, 'slope': slope,
        'roll': roll, 'pitch': float(np.clip(pitch, -0.2, 0.2)), 'yaw': yaw,
        'mounting_rpy': (0.0, 0.0, quarter * math.pi / 2),
        'antenna_lever_arm': flat(antenna), 'imu_lever_arm': flat(imu),
        'odometer_lever_arm': (0.0, 0.0, -0.1 if robot else -0.3),
        'odometer_rate': 50.0, 'fix_rate': float(rng.choice([1.0, 5.0, 10.0])),
        'fix_noise': 'rtk' if rtk else 'white', 'fix_sigma': 0.02 if rtk else 1.5,
        'nominal_scale': scale,
        'scale': scale * (1 + SIZES['nominal scale'][grade_index] * rng.standard_normal())}
    options = {k: float(v) if isinstance(v, np.floating) else v for k, v in options.items()}
    return Vehicle(grade, kind, rtk, city and kind != 'motorway', robot, options, alone), options
