# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Time the wheels' search on an hour of driving: many parameter sets at once, beside a loop.

    python benchmarks/wheel_search_speed.py [--hours 1] [--sets 1000]

An hour of track at 50 Hz and fixes at 5 Hz (18 000). ``at once`` are the products of matrices that
the search uses; ``set by set`` evaluates one set after another with the same precomputed sums;
``from the pulses`` sums travel and heading up again for each set, as the patent's equations say.
"""

import time

from harness import parsed
import numpy as np

from odocal_ros.calib.wheel_search.parameter_sets import search_ranges
from odocal_ros.calib.wheel_search.planar import course_pieces, PlanarLeg, score
from odocal_ros.calib.wheel_search.search import search
from odocal_ros.settings.config import WheelsConfig

RATE, FIX_EVERY, TRACK = 50, 10, 1.6     # Hz, epochs, m
SIGMA = 1.5                              # m
LOOPED = 50                              # sets that the slow ways are timed with


def drive(hours):
    """Return travel steps of both wheels, m, yaw at their middle, and the planar leg they make."""
    n = int(hours * 3600 * RATE)
    t = np.arange(n) / RATE
    rate = 0.05 * np.sin(t / 20.0) + 0.02 * np.sin(t / 7.0)
    yaw, step = np.cumsum(rate) / RATE, (12.0 + 3.0 * np.sin(t / 60.0)) / RATE
    left, right = step - rate * TRACK / 2 / RATE, step + rate * TRACK / 2 / RATE
    way = [np.cumsum(s * np.exp(1j * yaw))[::FIX_EVERY] for s in (left, right)]
    true = (1.004 * way[0] + 0.998 * way[1]) / 2 * np.exp(1j * np.deg2rad(0.7))
    noise = np.random.default_rng(1).normal(0.0, SIGMA, (len(true), 2))
    fixes, sigma = _plane(true) + noise, np.full(len(true), SIGMA)
    leg = PlanarLeg(t[::FIX_EVERY], _plane(way[0]), _plane(way[1]), fixes, np.zeros(2), sigma,
                    1.0, 1.0, pieces=course_pieces(fixes, sigma))
    return left, right, yaw, leg


def _plane(p):
    return np.stack([p.real, p.imag], -1)


def by_pulses(steps, leg, parameters):
    """Return maximum and mean distance of one set from the pulses up."""
    left, right, yaw = steps
    a, b, h = parameters
    p = np.cumsum((a * left + b * right) / 2 * np.exp(1j * (yaw + h)))[::FIX_EVERY]
    d = np.abs(p - leg.fixes_n @ [1, 1j])
    return d.max(), d.mean()


def timed(run):
    """Return the wall time, s, and the answer."""
    began = time.perf_counter()
    answer = run()
    return time.perf_counter() - began, answer


def main():
    """Print the times."""
    args = parsed(__doc__, hours=1.0, sets=1000)
    *steps, leg = drive(args.hours)
    sets = leg.start + np.random.default_rng(2).uniform(-0.05, 0.05, (args.sets, 3))
    print(f'{args.hours:g} h: {len(steps[0])} epochs, {len(leg.t)} fixes, {args.sets} sets')
    unique_paths, scores = timed(lambda: score(leg, sets, course=False))
    course, _ = timed(lambda: score(leg, sets))
    one, alone = timed(lambda: [score(leg, s, course=False).mean[0] for s in sets[:LOOPED]])
    slow, pulses = timed(lambda: [by_pulses(steps, leg, s)[1] for s in sets[:LOOPED]])
    share = args.sets / LOOPED
    print(f'  at once:         {unique_paths:7.2f} s ({course:.2f} s with the course)')
    print(f'  set by set:      {one * share:7.2f} s (from {LOOPED} sets)')
    print(f'  from the pulses: {slow * share:7.2f} s (from {LOOPED} sets)')
    parted = max(np.abs(scores.mean[:LOOPED] - way).max() for way in (alone, pulses))
    print(f'  mean distances part by {parted:.1e} m')
    whole, found = timed(lambda: search(leg, search_ranges(WheelsConfig())))
    print(f'  whole search ({len(found.sets)} rows, {found.surface_minimum.iterations} surfaces): '
          f'{whole:.2f} s')


if __name__ == '__main__':
    main()
