# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Print the time of the error model for an hour at 50 Hz."""

import time

import numpy as np

from odocal_reproductions.paper.error_model import propagate
from odocal_reproductions.paper.path import planned_path

HOUR, RATE = 3600, 50


def best_of(run, times=5):
    """Return the shortest wall time of a few runs, s."""
    wall_times = []
    for _ in range(times):
        begin = time.perf_counter()
        run()
        wall_times.append(time.perf_counter() - begin)
    return min(wall_times)


def main():
    t = np.arange(HOUR * RATE + 1) / RATE
    path = planned_path(t, 15 + 5 * np.sin(t / 30), 0.5 * np.sin(t / 60), 0.7)
    seconds = best_of(lambda: propagate(path, np.zeros(6), [1e-8] * 3))
    print(f'propagate: {seconds:.2f} s for {HOUR} s at {RATE} Hz, {len(t)} epochs')


if __name__ == '__main__':
    main()
