# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Four wheels: errors of each wheel's factor and place over their sigmas.

    python benchmarks/four_wheels.py --drives 10

Town, 600 s, industrial and consumer IMU in turn. Cells: front wheels that steer, none that steers
(skid steering), and front wheels that steer on vehicles with all effects of docs/zoo.md.
"""

import math

from harness import configured, parsed
import numpy as np

from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.sim.draw import draw_vehicle, EFFECTS, ODOMETER_EFFECTS
from odocal_ros.sim.scenarios import simulate
from odocal_ros.sim.wheels import wheels_of

FIRST_SEED = 92_000_000
GRADES = ('industrial', 'consumer')
CELLS = {'steered': {'front_steers': True, 'all': False},
         'fixed': {'front_steers': False, 'all': False},
         'steered, all effects': {'front_steers': True, 'all': True}}


def errors_of(seed, cell):
    """Return name -> (error, sigma) pairs of a drive, and the codes of its reasons."""
    effects = [name for name in EFFECTS if name not in ODOMETER_EFFECTS] * cell['all']
    made = simulate(draw_vehicle(seed, 'town', GRADES[seed % 2], effects, duration=600.0, wheels=4,
                                 odometer='angle', front_steers=cell['front_steers'])[0])
    config = configured(made)
    leg = calibrate(made.leg(), config)
    method = leg.methods['smoother']
    scale = method.estimates['scale_factor']
    found = {'scale': [(scale.value / made.truth.scale - 1, scale.sigma / scale.value)]}
    wheels = list(zip(wheels_of(made.options), made.truth.wheel_scales, strict=True))
    fixed = [(wheel, true) for wheel, true in wheels if not wheel.steered]
    middle = np.average([wheel.arm[1] for wheel, _ in fixed], weights=[1 / k for _, k in fixed])
    for wheel, true in wheels:
        e = method.estimates[f'scale_factor_{wheel.name}']
        beside = method.details['wheels'].get(wheel.name)
        if e.value is None or beside is None:
            continue
        ratio = beside['ratio'] * made.truth.scale / true - 1
        place = beside['y'] - (wheel.arm[1] - middle)
        for name, error, sigma in (('factor', e.value / true - 1, e.sigma / true),
                                   ('ratio', ratio, beside['ratio_sigma']),
                                   ('left', place, beside['y_sigma'])):
            found.setdefault(f'{name} {wheel.name}', []).append((error, sigma))
        if 'x' in beside:
            found.setdefault(f'ahead {wheel.name}', []).append(
                (beside['x'] - made.options.wheelbase, beside['x_sigma']))
    return found, sorted({r.code.name for r in (*leg.reasons, *method.reasons)})


def main():
    """Run the drives, print a row for each quantity."""
    args = parsed(__doc__, drives=(10, 'drives a cell'), cell=('', 'cells whose name holds it'))
    for number, (name, cell) in enumerate(CELLS.items()):
        if args.cell not in name:
            continue
        rows: dict[str, list[tuple[float, float]]] = {}
        for k in range(args.drives):
            found, codes = errors_of(FIRST_SEED + 1000 * number + k, cell)
            print(f'{name} {k}: {" ".join(codes)}', flush=True)
            for key, pairs in found.items():
                rows.setdefault(key, []).extend(pairs)
        print(f'{name:22}{"ppm or mm":20}{"of":>4}{"rms error":>12}{"sigma":>10}'
              f'{"rms/sigma":>11}{"worst":>7}')
        for key, pairs in rows.items():
            error, sigma = np.transpose(pairs)
            z = error / sigma
            unit = 1e3 if key.startswith(('left', 'ahead')) else 1e6
            print(f'{"":22}{key:20}{len(z):4d}{unit * math.sqrt((error**2).mean()):12.3f}'
                  f'{unit * np.median(sigma):10.3f}{math.sqrt((z**2).mean()):11.2f}'
                  f'{np.abs(z).max():7.1f}')


if __name__ == '__main__':
    main()
