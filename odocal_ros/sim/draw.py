# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Draw the options of a simulated drive with a realistic vehicle, for tests over many vehicles.

In: a seed, the scenario and the IMU grade. Out: SimOptions of an ideal vehicle, changed by effects
of its sensors (docs/zoo.md). Each effect has its own random stream, so that its values do not
depend on which other effects are drawn.
"""

from collections.abc import Sequence
import math
from typing import Any

import numpy as np

from odocal_ros.errors import BadUsage, unknown_name
from odocal_ros.sim.draw_effects import EFFECTS, RARE
from odocal_ros.sim.noise import make_rng
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.vehicle_distributions import BY_GRADE, DRAWN_GRADES, flat, Vehicle

KINDS = ('town', 'straight', 'out_and_back', 'motorway', 'yard')    # scenarios of the zoo
ODOMETER_EFFECTS = ('coarse_speed', 'coarse_pulses')   # each defines the only odometer


def draw_vehicle(seed: int, kind: str, grade: str, effects: Sequence[str] | None = None,
                 **fixed_options: Any) -> tuple[SimOptions, tuple[str, ...]]:
    """
    Return SimOptions of a drawn vehicle, and the names of the effects that it has.

    seed : of the vehicle, and of the noise of its drive.   kind : scenario.   grade : of the IMU:
    consumer, industrial or tactical.   effects : names of the effects to draw; None: all, ``()``:
    an ideal vehicle.   fixed_options : fields of SimOptions that are not drawn; ``real``: a dict
    of fields of RealEffects.

    Raises BadUsage: a name is unknown, or two effects exclude each other.
    """
    if grade not in DRAWN_GRADES:
        raise BadUsage(f'--vehicle real with --imu-grade {grade}: required: one of '
                       f'{", ".join(DRAWN_GRADES)}')
    names = list(EFFECTS) if effects is None else list(effects)
    for name in names:
        if name not in EFFECTS | RARE:
            raise BadUsage(f'--effect {name}: {unknown_name(name, EFFECTS | RARE)}')
    if set(ODOMETER_EFFECTS) <= set(effects or ()):
        raise BadUsage(f'--effect {" and ".join(ODOMETER_EFFECTS)}: a vehicle has one odometer; '
                       'select one of them')
    fixed_real = fixed_options.pop('real', {})
    vehicle, options = _ideal_vehicle(seed, kind, grade, effects is not None)
    if 'scale' in fixed_options:     # keep the drawn relative error of the nominal scale
        ratio = options['nominal_scale'] / options['scale']
        fixed_options = {'nominal_scale': fixed_options['scale'] * ratio} | fixed_options
    options |= fixed_options      # for the effects; again below, as effects may replace them
    if effects is None:
        odometer_effect = ('', 'coarse_pulses', 'coarse_speed')[int(make_rng(
            seed, 'vehicle odometer').choice(3, p=vehicle.grade_value('odometers')))]
        names = [n for n in names if n not in ODOMETER_EFFECTS or n == odometer_effect]
    real: dict[str, Any] = {}
    present_effects = []
    for name in names:
        effect = (EFFECTS | RARE)[name](make_rng(seed, f'vehicle {name}'), vehicle)
        if effect.options or effect.real:
            present_effects.append(name)
        options |= effect.options
        real |= effect.real
    options |= fixed_options
    return SimOptions(**options, real=RealEffects(**real | fixed_real)), tuple(present_effects)


def _ideal_vehicle(seed: int, kind: str, grade: str,
                   effects_certain: bool) -> tuple[Vehicle, dict[str, Any]]:
    """Return a drawn vehicle and its SimOptions before any effect; numbers: docs/zoo.md."""
    rng, grade_index = make_rng(seed, 'vehicle'), DRAWN_GRADES.index(grade)
    roll, pitch, yaw = (math.radians(sigma) * rng.standard_normal()
                        for sigma in BY_GRADE['mounting'][grade_index])
    heading, slope = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, 0.02)
    nominal_quarter_turns = int(rng.integers(1, 4)) if rng.uniform() < 0.2 else 0
    rtk = bool(rng.uniform() < BY_GRADE['rtk'][grade_index])
    city = bool(rng.uniform() < 0.45)
    robot = kind == 'yard' and grade == 'consumer'
    size = 0.5 if robot else 1.0
    antenna = size * rng.normal((0.8, 0.0, 1.3), (0.8, 0.3, 0.2))
    imu = size * rng.normal((0.8, 0.0, 0.4), (0.6, 0.3, 0.2))
    scale = 1 / (500.0 if robot else 1000.0)     # m/pulse, fine; ODOMETER_EFFECTS are coarser
    fix_rate = float(rng.choice([1.0, 5.0, 10.0]))
    scale_error = BY_GRADE['nominal scale'][grade_index] * rng.standard_normal()
    options: dict[str, Any] = {
        'scenario': kind, 'seed': seed, 'imu_grade': grade, 'heading': heading, 'slope': slope,
        'roll': roll, 'pitch': float(np.clip(pitch, -0.2, 0.2)), 'yaw': yaw,
        'mounting_rpy': (0.0, 0.0, nominal_quarter_turns * math.pi / 2),
        'antenna_lever_arm': flat(antenna), 'imu_lever_arm': flat(imu),
        'odometer_lever_arm': (0.0, 0.0, -0.1 if robot else -0.3),
        'odometer_rate': 50.0, 'fix_rate': fix_rate,
        'fix_noise': 'rtk' if rtk else 'white', 'fix_sigma': 0.02 if rtk else 1.5,
        'nominal_scale': scale, 'scale': scale * (1 + scale_error)}
    options = {k: float(v) if isinstance(v, np.floating) else v for k, v in options.items()}
    return Vehicle(grade, kind, rtk, city and kind != 'motorway', robot, options,
                   effects_certain), options
