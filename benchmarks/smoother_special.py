# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What ``smoother_cells.py --special`` prints: sigmas of dull drives, and starts from afar."""

from dataclasses import replace
import math

import numpy as np
from smoother_legs import leg_of, truth

from odocal_ros.estimator import cramer_rao_bound, smooth
from odocal_ros.estimator.fit import fit
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.nav.dead_reckoning import forward_b
from odocal_ros.settings.config import with_settings

FIRST_SEED = 55_000_000
DULL = (({'scenario': 'straight', 'imu_grade': 'industrial'},
         'reference bound of the yaw 0.105 deg'),
        ({'scenario': 'straight', 'imu_grade': 'industrial', 'sway': 0.05},
         'sideways 0.05 m/s at 10 Hz, as in the reference bounds'),
        ({'scenario': 'paper', 'imu_grade': 'navigation', 'fix_noise': 'white'},
         'reference bound of the yaw 0.008 deg'))
DULL_DRIVES, STARTS_DRIVES = 20, 3      # unless --drives says otherwise
ROAD = 0.05**2 / 10      # m^2/s: 0.05 m/s at 10 Hz, as in the reference bounds
IN_MOTION = 5.0          # m/s at the start mark moved into the drive
NAMES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')


def special(simulated, true_levels, drives, parts):
    """Print both tables; functions of smoother_cells.py, drives of each kind (None: as above)."""
    if not parts or 'dull' in parts:
        _print_dull(simulated, true_levels, drives or DULL_DRIVES)
    if not parts or 'starts' in parts:
        _print_starts(simulated, drives or STARTS_DRIVES)


def _print_dull(simulated, true_levels, drives):
    print('Sigma of the yaw against bounds at the truth, deg. bound: levels of the simulation,\n'
          'none below the lower limit on such a drive. sliding: as in the reference bounds\n'
          '(docs/decisions/0005), 0.05 m/s sideways at 10 Hz, but not at rest '
          '(with that too, 0.101 and 0.0070 deg)')
    for number, (options, promise) in enumerate(DULL):
        first = FIRST_SEED + 1000 * number
        _dull(simulated, true_levels, range(first, first + drives), options, promise)


def _print_starts(simulated, drives):
    print('The same leg from afar: change of scale, yaw, pitch in sigmas (asked: below 0.1)')
    for number, grade in enumerate(('consumer', 'industrial', 'tactical')):
        for noise in ('white', 'rtk'):
            worst = {}
            for k in range(drives):
                _starts(simulated, FIRST_SEED + 10_000 * (number + 1) + k, grade, noise, worst)
            for what, change in worst.items():
                print(f'{what:68} worst {np.round(change, 3)}', flush=True)


def _dull(simulated, true_levels, seeds, options, promise):
    rows, refused = [], 0
    for seed in seeds:
        drive, config = simulated(seed, **options)
        leg = leg_of(drive.leg(), config)
        result = smooth(leg, config)
        yaw, scale = (result.estimates[n] for n in ('yaw_mounting_angle', 'scale_factor'))
        problem, state = make_problem(leg, config), truth(drive, config, leg)
        levels = true_levels(problem, drive)
        slides = levels.replaced(**dict.fromkeys(('side', 'side_turn', 'up'), ROAD))
        least, sliding = (math.sqrt(cramer_rao_bound(leg, config, state, x)[1, 1])
                          for x in (levels, slides))
        if yaw.value is None:
            refused += 1
            print(f'    seed {seed}: {[r.text for r in result.reasons]}')
            continue
        rows.append([yaw.value - drive.truth.yaw, yaw.sigma, least, sliding,
                     scale.value / drive.truth.scale - 1, scale.sigma / scale.value])
    if not rows:
        print(f'{options["scenario"]}: all {refused} refused')
        return
    error, sigma, least, sliding, off, scale_sigma = np.array(rows).T
    kind = ', '.join(str(x) for x in options.values())
    print(f'{kind}, {len(rows)} drives, refused {refused}: '
          f'stated {np.degrees(np.median(sigma)):.4f} ({np.degrees(sigma.min()):.4f} to '
          f'{np.degrees(sigma.max()):.4f}), bound {np.degrees(np.median(least)):.4f}, sliding '
          f'{np.degrees(np.median(sliding)):.4f}; {promise}\n'
          f'    stated over bound {(sigma / least).min():.3f} to {(sigma / least).max():.3f}; '
          f'RMS error {np.degrees(np.sqrt((error**2).mean())):.4f} deg, over stated '
          f'{np.sqrt((error**2 / sigma**2).mean()):.2f}; scale over stated '
          f'{np.sqrt((off**2 / scale_sigma**2).mean()):.2f}', flush=True)


def _starts(simulated, seed, grade, noise, worst):
    drive, config = simulated(seed, scenario='town', imu_grade=grade, fix_noise=noise)
    # priors of accelerometer scale errors are by axis: a rotated IMU has others
    config = with_settings(config, {'imu.accel_scale_sigma': 0.0})
    leg = leg_of(drive.leg(), config)
    usual = smooth(leg, config)
    for factor in (0.7, 1.3):
        _note(worst, f'scale wrong by {factor:g}, {grade} {noise}', usual,
              smooth(replace(leg, rough_scale=factor * leg.rough_scale), config))
    for angle in (-40.0, 40.0):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])       # old b by the new
        turned = smooth(replace(leg, w_b=leg.w_b @ turn, f_b=leg.f_b @ turn), config)
        _note(worst, f'IMU turned by {angle:g} deg, {grade} {noise}', usual, turned, turn)
    moving, state = _in_motion(drive, config)
    late = smooth(moving, config)
    problem = make_problem(moving, config)
    noise_found = dict(late.details['noise'])
    tau = noise_found.pop('correlation_time')
    levels = problem.initial_levels.replaced(correlation_time=tau,
                                           **{k: v**2 for k, v in noise_found.items()})
    best = fit(problem, state, levels)
    change = [(math.log(late.estimates[NAMES[0]].value) - best.state.constants[0]),
              *(late.estimates[n].value - best.state.constants[i]
                for i, n in enumerate(NAMES) if i)]
    sigma = np.sqrt(np.diag(best.solution.covariance))[:3]
    _keep(worst, f'starts in motion: nothing or truth, {grade} {noise}', np.array(change) / sigma)
    # the rest of the drive adds to it: the difference of both is what the rest is worth
    # (levels differ from fit to fit, so that a difference of equals may be below zero)
    more = [max(late.estimates[n].sigma**2 - usual.estimates[n].sigma**2,
                (0.1 * late.estimates[n].sigma)**2) for n in NAMES]
    differences = [late.estimates[n].value - usual.estimates[n].value for n in NAMES]
    _keep(worst, f'starts in motion or whole, of the difference, {grade} {noise}',
          np.array(differences) / np.sqrt(more))


def _in_motion(drive, config):
    """Return the leg with its start mark in motion, and the truth at its keyframes."""
    t = np.arange(0.0, drive.motion.duration, 0.5)
    at = t[np.flatnonzero(np.abs(drive.motion.speed(t)) > IN_MOTION)[0]]
    start = drive.options.start_ns + round(at * 1e9)
    leg = leg_of(_cut(replace(drive.leg(), start_ns=start), start), config)
    return leg, truth(replace(drive, truth=replace(drive.truth, start_ns=start)), config, leg)


def _cut(leg, start):
    """Return a leg without what came before: a recorder that was switched on in motion."""
    from odocal_ros.data.samples import take
    return replace(leg, **{name: take(getattr(leg, name), getattr(leg, name).stamp_ns >= start)
                           for name in ('imu', 'odometer', 'fix')})


def _note(worst, what, usual, other, turn=None):
    """Keep the change from one result to another, of an IMU turned by C (old b by the new)."""
    if other.estimates[NAMES[1]].value is None:
        _keep(worst, what, np.full(3, np.inf))
        return
    values = [np.array([m.estimates[n].value for n in NAMES]) for m in (usual, other)]
    if turn is not None:
        # the forward axis in the turned frame, and the angles that it means there, roll 0
        x, y, z = turn.T @ forward_b(*values[0][1:])
        values[0][1:] = -math.asin(y), math.atan2(z, x)
    _keep(worst, what, (values[1] - values[0]) / [usual.estimates[n].sigma for n in NAMES])


def _keep(worst, what, change):
    if what not in worst or np.abs(change).max() > np.abs(worst[what]).max():
        worst[what] = change
