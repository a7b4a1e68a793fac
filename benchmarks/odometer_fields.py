# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Share of the variance of the distances between fixes that vehicle signals explain.

One line per simulated drive: (as a counter / as a speed) of true odometers and of signals that are
none. ``python benchmarks/odometer_fields.py``, 20 s.
"""

from itertools import product

import numpy as np

from odocal_ros.data.samples import OdometerForm
from odocal_ros.nav.odometer import make_travel
from odocal_ros.offline.survey import fix_path
from odocal_ros.settings.config import Config
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.scenarios import simulate

DURATION = {'town': 400.0, 'motorway': 600.0, 'yard': 300.0, 'straight': 200.0,
            'out_and_back': 300.0}


def signals(t, v):
    """Return signals of a vehicle with the speed v, m/s, at times t, s."""
    a = np.gradient(v, t)
    gear = np.clip(np.floor(np.abs(v) / 6) + 1, 1, 5)
    step = t[1] - t[0]
    return {'speed': v, 'counter': np.round(np.cumsum(v) * step / 0.02), 'km/h': np.round(3.6 * v),
            'time': t, 'gear': gear, 'engine speed': 800 + 500 * np.abs(v) / gear,
            'throttle': np.clip(a, 0, 3), 'temperature': 60 - 40 * np.exp(-t / 300),
            'energy': np.cumsum(np.maximum(a, 0) * v + 0.01 * v**3 + 2) * step}


def main():
    """Print the table."""
    for scenario, noise, sigma in product(DURATION, ('white', 'correlated'), (0.5, 2.5)):
        made = simulate(SimOptions(
            imu_rate=25.0, odometer_rate=10.0, fix_rate=1.0, scenario=scenario, seed=3,
            duration=DURATION[scenario], odometer='speed', fix_noise=noise, fix_sigma=sigma))
        path = fix_path(made.fix, Config().gnss)
        t_ns = made.odometer.received_ns
        t = (t_ns - t_ns[0]) * 1e-9
        cells = []
        for name, x in signals(t, made.odometer.value).items():
            found = [path.match(t_ns,
                                make_travel(t, x, OdometerForm(quantity, 0, ''))[0].s).explained
                     for quantity in ('cumulative', 'rate')]
            cells.append(f'{name} {max(found):.2f}')
        print(f'{scenario}, {noise}, {sigma} m: {len(path.length)} cells; {", ".join(cells)}')


if __name__ == '__main__':
    main()
