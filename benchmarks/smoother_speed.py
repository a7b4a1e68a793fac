# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
How long the smoother takes, and how much memory, on simulated town drives.

    python benchmarks/smoother_speed.py [--cells NAME ...] [--seed 1]

One process, one thread. Printed for each cell: time to simulate and to screen (what reading and
cleaning a bag costs comes on top), wall and processor time of ``smooth``, iterations, the most
memory the process has held so far. Goals: ten minutes at 100 Hz under 3 s, an hour at
200 Hz under 20 s and 1 GiB in all. Run it on an idle machine.
"""

import os
import resource
import time

from harness import configured, parsed

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

CELLS = {
    'ten minutes': {'duration': 600.0, 'imu_rate': 100.0},
    'ten minutes, RTK': {'duration': 600.0, 'imu_rate': 100.0, 'fix_noise': 'rtk'},
    'ten minutes, slow fix errors': {'duration': 600.0, 'imu_rate': 100.0,
                                     'fix_noise': 'correlated'},
    'an hour': {'duration': 3600.0, 'imu_rate': 200.0},
}


def run(name, options, seed):
    """Print one line of figures."""
    from odocal_ros.estimator import make_smoother_leg, smooth
    from odocal_ros.nav.standstill import standstills
    from odocal_ros.screening.inputs import locate_fixes
    from odocal_ros.screening.screen import screen
    from odocal_ros.sim.scenarios import SimOptions, simulate

    t0 = time.perf_counter()
    drive = simulate(SimOptions(scenario='town', seed=seed, **options))
    t1 = time.perf_counter()
    config = configured(drive)
    leg = drive.leg()
    inputs, _ = screen(leg, config)
    located = locate_fixes(inputs, config)
    spans = standstills(inputs.t_imu, inputs.w_b, inputs.travel, located.rough,
                        config.leg.standstill)
    ready = make_smoother_leg(inputs, config, located.origin, located.fixes_n, spans,
                              located.rough)
    t2, cpu = time.perf_counter(), time.process_time()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result = smooth(ready, config)
    wall, cpu = time.perf_counter() - t2, time.process_time() - cpu
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    scale = result.estimates['scale_factor']
    off = (scale.value / drive.truth.scale - 1) * 1e6
    print(f'{name:<30} simulate {t1 - t0:5.1f} s  screen {t2 - t1:5.2f} s  smooth {wall:6.2f} s '
          f'(cpu {cpu:6.2f} s, {result.details["iterations"]} iterations)  most memory '
          f'{most / 1024:6.0f} MiB (before: {before / 1024:.0f})  scale {off:+.0f} +- '
          f'{scale.sigma / scale.value * 1e6:.0f} ppm', flush=True)


def main():
    """Run the cells."""
    args = parsed(__doc__, cells={'nargs': '*', 'default': list(CELLS), 'choices': list(CELLS)},
                  seed=1)
    for name in args.cells:
        run(name, CELLS[name], args.seed)


if __name__ == '__main__':
    main()
