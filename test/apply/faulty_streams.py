# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Drives with random faults, fed to ``odometry`` and compared with the truth.

Seed and number define a stream: ``python benchmarks/stream_faults.py --seed S --only N``.
"""

from functools import cache
import random

import numpy as np
from streams import odometry_of

from odocal_ros.calib.result import Estimate
from odocal_ros.data.samples import ImuSamples, OdometerSamples, take
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.rotations import matrix_from_quat
from odocal_ros.sim.motion import attitude
from odocal_ros.sim.scenarios import SimOptions, simulate

PIECE_NS, SIGMAS, DRIVES = 200_000_000, 5.0, 6
TOPICS = ('imu', 'odometer')
FLOOR = np.repeat([0.02, 1e-3], 3)      # m, rad: accuracy of the simulation and of sums
KINDS = ('counts', 'speed', 'angle')
ODD = (np.nan, np.inf, -np.inf, 1e150, 1e300, -1e300, 5e-324)


def calibration(truth, rng):
    """Return estimates with random errors according to their sigmas."""
    true = {'scale_factor': (truth.scale, 3e-4 * truth.scale),
            'yaw_mounting_angle': (truth.yaw, 2e-3), 'pitch_mounting_angle': (truth.pitch, 2e-3)}
    return {name: Estimate(value + sigma * rng.standard_normal(), sigma, '')
            for name, (value, sigma) in true.items()}


def started(drive, seed, **changes):
    """Return the odometry of a drive with calibration errors drawn by a seed."""
    estimates = calibration(drive.truth, np.random.default_rng(seed))
    return odometry_of(drive, estimates, **{'publish__rate': 5.0} | changes)


@cache
def drive_of(number):
    return simulate(SimOptions(
        scenario='town', duration=120.0, seed=number + 1, imu_rate=(50.0, 100.0)[number % 2],
        odometer_rate=25.0, imu_grade='consumer', slope=0.03, slip_walk=0.005, sway=0.02,
        odometer=KINDS[number % 3]))


def columns_of(drive):
    """Return the columns that faults change: arrays by topic, in order of arrival."""
    imu, odometer = drive.imu, drive.odometer
    return {'imu': {'arrival': imu.stamp_ns.copy(), 'stamp': imu.stamp_ns.copy(),
                    'w': imu.w_i.copy(), 'f': imu.f_i.copy()},
            'odometer': {'arrival': odometer.stamp_ns.copy(), 'stamp': odometer.stamp_ns.copy(),
                         'value': odometer.value.copy()}}


def some_rows(rng, topic, max_s=3.0):
    """Return a slice of consecutive rows: one row up to some seconds."""
    n = len(topic['stamp'])
    rate = 1e9 / np.median(np.diff(topic['arrival']))
    count = int(min(rng.choice([1, 1, 2, 3, 5, 10, rng.uniform(0, max_s) * rate]), n // 4)) or 1
    begin = rng.randrange(int(3 * rate), n - count)
    return slice(begin, begin + count)


def size(rng, low, high):
    """Return a number of random sign, its magnitude log-uniform between two limits."""
    return rng.choice([-1, 1]) * 10**rng.uniform(np.log10(low), np.log10(high))


def imu_values(rng, topics):
    """Add to or replace a turn rate or a specific force."""
    imu = topics['imu']
    name, low, high = rng.choice([('w', 0.1, 1e4), ('f', 1.0, 1e7)])
    value = rng.choice(ODD) if rng.random() < 0.2 else size(rng, low, high)
    at = some_rows(rng, imu), rng.choice([0, 1, 2, slice(None)])
    imu[name][at] = value + (imu[name][at] if rng.random() < 0.5 else 0.0)
    return f'imu {name} {value:.3g} in {at[0].stop - at[0].start} rows'


def imu_stuck(rng, topics):
    rows = some_rows(rng, topics['imu'], 5.0)
    for name in 'wf':
        topics['imu'][name][rows] = topics['imu'][name][rows.start]
    return f'imu stuck for {rows.stop - rows.start} rows'


def stamps(rng, topics):
    """Shift or replace stamps of some rows, or shift all that follow."""
    name = rng.choice(TOPICS)
    topic = topics[name]
    rows = some_rows(rng, topic)
    if rng.random() < 0.2:
        topic['stamp'][rows] = value = rng.choice([0, -1, 2**63 - 1, -2**63, 2**62, 1])
        return f'{name} stamp {value} in {rows.stop - rows.start} rows'
    seconds = size(rng, 0.01, 1e3)
    stays = rng.random() < 0.2
    rows = slice(rows.start, None) if stays else rows
    if stays and name == 'imu':      # the clock of the poses
        topics['set'] = int(topic['stamp'][rows.start]), int(seconds * 1e9)
    topic['stamp'][rows] += int(seconds * 1e9)
    where = 'for good' if stays else f'in {rows.stop - rows.start} rows'
    return f'{name} stamp {seconds:+.3g} s {where}'


def missing(rng, topics):
    name = rng.choice(TOPICS)
    rows = some_rows(rng, topics[name], 15.0)
    topics[name] = {k: np.delete(v, rows, axis=0) for k, v in topics[name].items()}
    return f'{name} misses {rows.stop - rows.start} rows'


def mixed(rng, topics):
    """Repeat rows, or reverse their order."""
    name = rng.choice(TOPICS)
    rows = some_rows(rng, topics[name])
    order = np.arange(len(topics[name]['stamp']))
    part = order[rows].copy()
    if rng.random() < 0.5:
        order = np.insert(order, rows.stop, part)
    else:
        order[rows] = part[::-1]
    arrival = topics[name]['arrival']
    topics[name] = {k: v[order] for k, v in topics[name].items()}
    topics[name]['arrival'] = np.sort(np.resize(arrival, len(order)))
    return f'{name} rows mixed {len(part)}'


def counter(rng, topics):
    """Change values of the odometer."""
    value = topics['odometer']['value']
    rows = some_rows(rng, topics['odometer'])
    whole = np.issubdtype(value.dtype, np.integer)
    usual = float(np.percentile(np.abs(np.diff(value)), 90)) if whole else 1.0
    kind = rng.choice(['add', 'add', 'put', 'reset'])
    by = size(rng, 3 * usual, 1e6 * usual) if whole or rng.random() < 0.8 else rng.choice(ODD)
    if kind == 'reset' and not whole:
        kind = 'add'            # a speed is not reset
    if kind == 'reset':
        value[rows.start:] -= value[rows.start]
        return 'counter reset'
    value[rows] = by + (value[rows] if kind == 'add' else 0)
    return f'counter {kind} {by:.3g} in {rows.stop - rows.start} rows'


def counter_stuck(rng, topics):
    rows = some_rows(rng, topics['odometer'], 5.0)
    topics['odometer']['value'][rows] = topics['odometer']['value'][rows.start]
    return f'counter stuck for {rows.stop - rows.start} rows'


FAULTS = (imu_values, imu_values, imu_stuck, stamps, stamps, missing, mixed, counter, counter,
          counter_stuck)


def blocks_of(topics):
    imu, odometer = topics['imu'], topics['odometer']
    n = len(imu['stamp'])
    return {'imu': ImuSamples(imu['stamp'], imu['arrival'], imu['w'], imu['f'], np.zeros((n, 4)),
                              np.full(n, np.nan)),
            'odometer': OdometerSamples(odometer['stamp'], odometer['arrival'], odometer['value'])}


def run(drive, odometry, topics):
    """Return (restarts so far, pose) of a stream, and the notes."""
    blocks, out, notes = blocks_of(topics), [], []
    begin, end = topics['imu']['arrival'][[0, -1]]
    for edge in range(int(begin), int(end) + 1, PIECE_NS):
        for slot, block in blocks.items():
            a, b = np.searchsorted(block.received_ns, [edge, edge + PIECE_NS])
            if b > a:
                odometry.feed(slot, take(block, slice(a, b)), drive.form)
        path = odometry.restarts          # of poses before a restart in this piece
        out += [(path, pose) for pose in odometry.poses()]
        notes += odometry.take_notes()
    return out, notes


def worst_of(drive, poses, topics, path=0):
    """Return the largest error over sigma of the poses, and its axis, time and size as text."""
    set_ns, by_ns = topics.get('set', (0, 0))
    stamp_ns = np.array([p.stamp_ns for p in poses])
    # a pose has the clock of its IMU row: after a clock step the new one
    stepped = (stamp_ns >= set_ns + max(by_ns, 0)) | (path > 0 and stamp_ns[0] >= set_ns + by_ns)
    t = (stamp_ns - by_ns * stepped - drive.options.start_ns) * 1e-9
    inside = (t > 0) & (t < drive.motion.duration)
    if not inside.all():
        return np.inf, 'a stamp outside of the drive'
    if not all(p.is_valid() for p in poses):
        return np.inf, 'not finite'
    state = drive.motion.at(t)
    origin = Origin(state.latitude[0], state.longitude[0], state.height[0])
    place_n = origin.to_n(np.stack([state.latitude, state.longitude, state.height], -1))
    heads = matrix_from_quat(poses[0].q)[:, 0]      # it may turn at the start
    yaw = state.yaw[0] - np.arctan2(heads[1], heads[0])
    c, s = np.cos(yaw), np.sin(yaw)
    C_on = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    off_p = np.array([p.position for p in poses]) - poses[0].position - place_n @ C_on.T
    turned = np.einsum('kij,klj->kil', matrix_from_quat(np.array([p.q for p in poses])),
                       C_on @ attitude(state))
    off = np.stack([turned[:, 2, 1] - turned[:, 1, 2], turned[:, 0, 2] - turned[:, 2, 0],
                    turned[:, 1, 0] - turned[:, 0, 1]], -1) / 2
    sigma = np.sqrt([np.diag(p.pose_cov) + FLOOR**2 for p in poses])
    ratio = np.abs(np.concatenate([off_p, off], axis=1)) / sigma
    k, axis = np.unravel_index(np.argmax(ratio), ratio.shape)
    error = np.concatenate([off_p, off], 1)[k, axis]
    return float(ratio[k, axis]), (f'{("x", "y", "z", "roll", "pitch", "yaw")[axis]} at '
                                   f't = {t[k]:.1f} s: {error:.3g} +- {sigma[k, axis]:.2g}')


def stream(seed, number):
    """Return (number, faults, worst, its text, restarts, whether there were notes) of a stream."""
    rng = random.Random(f'{seed}:{number}')
    drive = drive_of(number % DRIVES)
    topics = columns_of(drive)
    with np.errstate(all='ignore'):
        faults = [rng.choice(FAULTS)(rng, topics) for _ in range(
            rng.choice([1, 1, 2, 3]))] if number >= DRIVES else ['none']
    odometry = started(drive, number)
    try:
        poses, notes = run(drive, odometry, topics)
    except Exception as error:       # the test requires that there is none
        return number, faults, np.inf, repr(error), 0, True
    worst = max([worst_of(drive, [p for r, p in poses if r == restart], topics, restart)
                 for restart in {r for r, _ in poses}], default=(0.0, ''))
    return number, faults, *worst, odometry.restarts, bool(notes)
