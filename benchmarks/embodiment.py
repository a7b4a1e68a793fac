"""
Source B's embodiment, computed: table of combinations, best, refined and least-squares optimum.

    python benchmarks/embodiment.py [--fix-noise white|correlated|rtk] [--seed 1] [--real [BAG]]

Simulated town drive, ten minutes: wheels of 0.3 m nominal radius (the source states none), truly
0.01 m less on the left and 0.01 m more on the right, heading given 0.25 deg too small (counter-
clockwise). --real: the minute of a RAV4 in the shared data, rear wheels, whose radius is taken for
0.35 m: its messages carry speeds, so only the ratio counts.
"""

import argparse
import math
from pathlib import Path

import numpy as np

from odocal_ros.calib.marks import fix_at, MARK_WINDOW, standing_at
from odocal_ros.nav.dead_reckoning import dead_reckon, forward_b
from odocal_ros.nav.earth import earth_rate_n
from odocal_ros.nav.standstill import standstills
from odocal_ros.nav.strapdown import attitude
from odocal_ros.patent.embodiment import embodiment, FOUND, RADIUS
from odocal_ros.patent.planar import planar_leg
from odocal_ros.pipeline.align import align
from odocal_ros.screening.fix_screen import origin_amid
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, with_settings

REAL = Path(__file__).parents[2] / 'shared/data/comma2k19_rav4/bag'
REAL_RADIUS, REAL_PITCH = 0.35, math.radians(3.75)      # m; rad, truth.yaml


def simulated(fix_noise, seed):
    """Return leg, settings and pitch of the simulated drive: radii and heading off by FOUND."""
    from odocal_ros.sim.scenarios import SimOptions, simulate
    left, right = RADIUS + FOUND[0], RADIUS + FOUND[1]
    drive = simulate(SimOptions(
        scenario='town', seed=seed, imu_grade='tactical', odometer='angle', two_wheels=True,
        scale=2 / (1 / left + 1 / right), wheel_difference=right / left - 1, yaw=0.0, pitch=0.0,
        nominal_scale=RADIUS, fix_noise=fix_noise))
    # yaw to be turned counter-clockwise: the heading, clockwise, is given too large
    config = with_settings(Config(), {
        'imu.grade': 'tactical', 'alignment.heading_source': 'fixed',
        'alignment.heading': drive.truth.heading + math.radians(FOUND[2])})
    return drive.leg(), config, 0.0


def recorded(path):
    """Return leg, settings and pitch of the real drive."""
    from odocal_ros.bagio.read import open_bag
    from odocal_ros.data.leg import LegRecorder
    from odocal_ros.messages.decode import make_reader
    from odocal_ros.offline.legs import find_legs
    config = with_settings(Config(), {
        'odometer.left': 'rear_left', 'odometer.right': 'rear_right'})
    topics = {'imu': '/imu/data_flu', 'odometer': '/wheel_states', 'fix': '/fix'}
    with open_bag(path) as bag:
        readers = {topic: make_reader(slot, bag.topics[topic].msgtype, config)
                   for slot, topic in topics.items()}
        recorder = LegRecorder()
        bag.read(readers, recorder.feed)
        recorder.form = readers[topics['odometer']].form
        (span,) = find_legs(recorder, bag, [], [], config)
    return recorder.close(*span), config, REAL_PITCH


def planar(leg, config, scale, pitch):
    """Return the leg in the plane, begun at the fixes about the start mark."""
    inputs, _ = screen(leg, config)
    origin = origin_amid(inputs.t_fix, inputs.geodetic)
    fixes_n = origin.to_n(inputs.geodetic)
    spans = standstills(inputs.t_imu, inputs.w_b, inputs.travel, scale, config.leg.standstill)
    a, _ = align(inputs, spans, scale, fixes_n, origin, config)
    pick = inputs.t_imu >= a.t - 1e-9
    t, q_nb = attitude(inputs.t_imu[pick], inputs.w_b[pick] - a.gyro_bias, a.q_nb,
                       earth_rate_n(origin.latitude))
    middle, left, right = (dead_reckon(t, q_nb, travel) for travel in (
        inputs.travel, inputs.travel_left, inputs.travel_right))
    begin = max(0.0, float(t[0]))
    d = scale * forward_b(0.0, pitch)
    start = fix_at(begin, standing_at(begin, spans), (inputs.t_fix, fixes_n, inputs.covariance_n),
                   lambda at: (middle.at(at) - middle.at(np.array(begin))) @ d, 0.0, MARK_WINDOW)
    between = inputs.t_fix <= inputs.t_stop
    return planar_leg(left, right, inputs.t_fix[between], fixes_n[between],
                      inputs.covariance_n[between], (begin, start.position_n), (scale, scale),
                      pitch)


def show(title, table):
    """Print the table and what stands behind it."""
    print(f'\n{title}')
    print(f'{"":22} {"left m":>9} {"right m":>9} {"head deg":>9} {"max m":>9} {"mean m":>9} '
          f'{"rms m":>9} {"course deg":>10}')
    for row in table.rows:
        c = row.criteria
        course = '' if c['course_mean_deg'] is None else f'{c["course_mean_deg"]:+10.3f}'
        print(f'{row.name:22} {row.left:+9.5f} {row.right:+9.5f} {row.heading_deg:+9.4f} '
              f'{c["max"]:9.3f} {c["mean"]:9.3f} {c["rms"]:9.3f} {course:>10}')
    r, d = table.refined, table.direct
    print(f'array of 81: counts of pairs off even by {table.imbalance:.2f} at most; an orthogonal '
          f'one needs a multiple of {table.least} rows')
    print(f'response surface: {r.iterations} fits, settled {r.settled}, on the edge of the range '
          f'{r.on_edge}; R^2 {r.first.r_squared:.6f} first, {r.last.r_squared:.9f} last')
    print(f'least squares: condition number {d.condition:.3g}, correlation of left and right '
          f'{d.correlation[0, 1]:+.7f}; right less left is known to {table.sigma_radius:.3g} m')
    if not table.told_apart:
        print('left and right are not told apart by these fixes: read the lines "wheels together"')


def main():
    """Run it on the simulated drive, and on the real one."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--fix-noise', default='white', choices=('white', 'correlated', 'rtk'))
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--real', nargs='?', type=Path, const=REAL, metavar='BAG')
    args = parser.parse_args()
    leg, config, pitch = simulated(args.fix_noise, args.seed)
    show(f'simulated town drive, fixes {args.fix_noise}',
         embodiment(planar(leg, config, RADIUS, pitch), RADIUS, FOUND))
    if args.real:
        leg, config, pitch = recorded(args.real)
        show('RAV4, rear wheels, one minute',
             embodiment(planar(leg, config, 1.0, pitch), REAL_RADIUS))


if __name__ == '__main__':
    main()
