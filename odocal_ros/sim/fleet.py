# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A fleet with known truth: models, vehicles that differ, tyres changed, IMUs moved."""

from dataclasses import dataclass, replace
import math

import numpy as np

from odocal_ros.settings.levels import DAY_NS
from odocal_ros.sim.noise import make_rng
from odocal_ros.sim.scenarios import Drive, SimOptions

WALK = 1e-4              # judgement: random walk of the scale, relative, per square root of a day
# judgement: shares of the vehicles of which a value changes; if there are three or more vehicles,
# at least one for each value
CHANGE_SHARES = {'scale_factor': 0.1, 'yaw_mounting_angle': 0.05, 'counter': 1 / 30}


@dataclass(frozen=True)
class Model:
    """A kind of vehicle."""

    name: str
    nominal_scale: float    # m/pulse, as configured
    scale: float            # m/pulse, true mean of its vehicles
    yaw: float              # rad, mean mounting angles of their IMUs
    pitch: float


# judgement: models of an example fleet
MODELS = (Model('shuttle', 0.0210, 0.0213, math.radians(1.0), math.radians(0.4)),
          Model('van', 0.0245, 0.0243, math.radians(-0.5), math.radians(0.8)),
          Model('truck', 0.0310, 0.0312, math.radians(0.2), math.radians(-0.6)))


@dataclass(frozen=True)
class FleetChange:
    """A change of a vehicle before one of its bags, which count from 0."""

    bag: int
    value: str           # name of the value: scale_factor, yaw_mounting_angle or counter
    size: float = 0.0    # relative, or rad


@dataclass(frozen=True, eq=False)
class FleetVehicle:
    """A vehicle and the true values of its drives."""

    name: str
    model: Model
    scale: np.ndarray    # (bags,) m/pulse
    yaw: np.ndarray      # (bags,) rad
    pitch: float         # rad
    odometer_km: np.ndarray    # (bags,) on the dashboard
    changes: tuple[FleetChange, ...] = ()

    def has_broken_counter(self, bag: int) -> bool:
        """Return True if the odometer counter is broken in a bag."""
        return any(change.value == 'counter' and change.bag <= bag for change in self.changes)


def fleet_of(vehicles: int, bags: int, seed: int) -> list[FleetVehicle]:
    """Return ``vehicles`` vehicles with ``bags`` drives each, one per week."""
    order = make_rng(seed, 'fleet').permutation(vehicles).tolist()
    changes: dict[int, str] = {}      # vehicle -> value
    for value, share in CHANGE_SHARES.items():
        for _ in range(math.ceil(vehicles * share - 1e-9) if vehicles > 2 and bags > 2 else 0):
            changes[order.pop()] = value
    return [_vehicle(number, bags, changes.get(number), make_rng(seed, f'fleet vehicle {number}'))
            for number in range(vehicles)]


def _vehicle(number: int, bags: int, changing_value: str | None,
             rng: np.random.Generator) -> FleetVehicle:
    """Return a vehicle; changing_value : its name, if a value changes before one of the bags."""
    model = MODELS[number % len(MODELS)]
    walk = np.cumsum(WALK * math.sqrt(7) * rng.standard_normal(bags))
    # between vehicles of a model, 1 sigma: 0.3 % of the scale, 0.3 and 0.2 deg
    scale = model.scale * (1 + 0.003 * rng.standard_normal()) * np.exp(walk)
    yaw = np.full(bags, model.yaw + math.radians(0.3) * rng.standard_normal())
    pitch = model.pitch + math.radians(0.2) * rng.standard_normal()
    odometer_km = 1000.0 + 400.0 * np.cumsum(rng.uniform(0.5, 1.5, bags))    # 400 km a week
    first_bag = int(rng.integers(1, max(2, bags - 1)))
    size = float(rng.choice([-1, 1]) * rng.uniform(0.5, 1.0))
    if changing_value == 'scale_factor':
        size *= 0.02
        scale[first_bag:] *= 1 + size
    elif changing_value == 'yaw_mounting_angle':
        size *= math.radians(3.0)
        yaw[first_bag:] += size
    else:
        size = 0.0
    changes = (FleetChange(first_bag, changing_value, size),) if changing_value else ()
    return FleetVehicle(f'{model.name}_{number + 1:03d}', model, scale, yaw, pitch, odometer_km,
                        changes)


def drive_options(vehicle: FleetVehicle, number: int, bag: int, options: SimOptions) -> SimOptions:
    """Return the options of a drive; number, bag : of the vehicle and of its drive, from 0."""
    return replace(
        options, seed=options.seed + 1000 * (number + 1) + bag, yaw=float(vehicle.yaw[bag]),
        start_ns=options.start_ns + bag * 7 * DAY_NS + number % 100 * DAY_NS // 24,
        pitch=vehicle.pitch, scale=float(vehicle.scale[bag]),
        nominal_scale=vehicle.model.nominal_scale)


def with_broken_counter(drive: Drive) -> Drive:
    """Return a drive whose odometer counter stops after a third of its samples."""
    value = drive.odometer.value.copy()
    third = int(1 / 3 * len(value))
    value[third:] = value[third]
    return replace(drive, wheels=(replace(drive.odometer, value=value), *drive.wheels[1:]))
