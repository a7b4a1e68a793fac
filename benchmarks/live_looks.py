# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
What looks at a leg cost while it is recorded, and how good the running estimate is.

    python benchmarks/live_looks.py [--seconds 600] [--grade consumer] [--noise white]

A simulated town drive is looked at as the node does, without ROS. Printed as the leg grows: CPU of
a look, what of it is done ever less often, and when the next will be; at the end the CPU of all
looks against that of the first EARLY_S, each by time, beside the goal, and how far the running
estimate is from the result of the whole leg.
"""

import math
import time

from harness import parsed

from odocal_ros.data.samples import take
from odocal_ros.errors import OdocalError
from odocal_ros.forecast.leg_forecast import forecast_leg
from odocal_ros.forecast.leg_so_far import SmootherSoFar
from odocal_ros.forecast.thinned_leg import ThinnedLeg
from odocal_ros.live.running_estimate import UPDATE_CPU_SHARE, UPDATE_PERIOD_NS
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

NAMES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')
LINES = 40       # printed of a leg
EARLY_S, GOAL_GROWTH = 600.0, 1.1


def look(leg, config, state, before_ns, now_ns):
    """Take a look at what has come between two stamps: forecast or None, s of CPU, s once."""
    thinned, smoother = state
    begin = time.thread_time()
    for slot in ('imu', 'odometer', 'fix'):
        rows = leg.rows(slot)
        thinned.feed(slot, take(rows, (rows.stamp_ns > before_ns) & (rows.stamp_ns <= now_ns)))
    try:
        seen = forecast_leg(thinned.leg(leg.start_ns), thinned.fix_rate(), config,
                            smoother=smoother)
    except OdocalError:
        seen = None
    return seen, time.thread_time() - begin, smoother.cold_start_cpu_s


def show(leg, config, seconds):
    """Print all looks at a leg; return the last forecast."""
    print('   leg s   look s CPU   of that once   next after s   scale sigma ppm   yaw sigma deg')
    state = ThinnedLeg(leg.form), SmootherSoFar()
    before_ns, now_ns, pauses, total, shown = 0, leg.start_ns + UPDATE_PERIOD_NS, [], 0.0, -1.0
    early = 0.0
    while before_ns < leg.stop_ns:
        seen, cost, unique_paths = look(leg, config, state, before_ns, now_ns)
        total += cost
        pauses.append(max(UPDATE_PERIOD_NS * 1e-9,
                          cost + (cost - unique_paths) / UPDATE_CPU_SHARE))
        t = (now_ns - leg.start_ns) * 1e-9
        early = total if t <= EARLY_S else early
        if seen is not None and (t > shown + seconds / LINES or now_ns >= leg.stop_ns):
            shown = t
            print(f'{t:8.0f} {cost:12.2f} {unique_paths:14.2f} {pauses[-1]:14.1f} '
                  f'{seen.scale.sigma * 1e6:17.1f} {math.degrees(seen.yaw.sigma or 0.0):15.4f}')
        next_ns = now_ns + round(pauses[-1] * 1e9)
        before_ns, now_ns = now_ns, leg.stop_ns if now_ns < leg.stop_ns < next_ns else next_ns
    middle, most = sorted(pauses)[len(pauses) // 2], max(pauses[1:])
    print(f'{len(pauses)} looks, {100 * total / seconds:.1f} % of a core; from one to the next '
          f'{middle:.1f} s in the middle, {most:.1f} s at most')
    if seconds > EARLY_S:
        growth = total / seconds / (early / EARLY_S)
        print(f'CPU by time against that of the first {EARLY_S:.0f} s: {growth:.2f}, goal '
              f'{GOAL_GROWTH:g}{"" if growth <= GOAL_GROWTH else "   MISSED"}')
    return seen


def main() -> None:
    """Drive, look, compare."""
    args = parsed(__doc__, seconds=600.0, imu=100.0, grade='consumer',
                  noise=('white', 'of the fixes: white, correlated, rtk'), seed=1)
    config = with_settings(Config(), {'imu.grade': args.grade})
    leg = simulate(SimOptions(scenario='town', duration=args.seconds, imu_rate=args.imu,
                              imu_grade=args.grade, fix_noise=args.noise, seed=args.seed)).leg()
    seen = show(leg, config, args.seconds)
    result = calibrate(leg, config).methods['smoother'].estimates
    for name in NAMES:
        e, r = seen.methods['smoother'].estimates[name], result[name]
        print(f'{name}: {(e.value - r.value) / r.sigma:+.2f} sigmas from the result, with '
              f'{e.sigma / r.sigma:.2f} times its sigma')


if __name__ == '__main__':
    main()
