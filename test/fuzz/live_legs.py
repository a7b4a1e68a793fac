# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Faulty messages in the calibrator without DDS: decoding, running estimate, calibration.

Seed and number define a leg: ``python benchmarks/live_faults.py --seed S --only N``.
"""

from dataclasses import dataclass
from functools import cache
from logging import getLogger
import math
import random
import warnings

import numpy as np
import semantic

from odocal_ros.bagio import encode
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import take
from odocal_ros.errors import OdocalError
from odocal_ros.forecast.progress import Progress
from odocal_ros.live import worker
from odocal_ros.live.health import Health
from odocal_ros.live.running_estimate import RunningEstimate
from odocal_ros.messages.decode import make_reader
from odocal_ros.messages.message_fields import FIX, IMU
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

DRIVES, PIECE_NS, START_NS, SECOND = 4, 500_000_000, 15 * 10**9, 10**9
COUNTER, JOINTS, SIGMAS = semantic.COUNTER, semantic.JOINTS, semantic.SIGMAS
ODD = (math.nan, math.inf, -math.inf, 1e150, 1e300, -1e300, 5e-324)
FIELDS = {IMU: (*semantic.RATES, *semantic.FORCES), JOINTS: ('position[0]',), COUNTER: ('data',),
          FIX: ('latitude', 'longitude', 'altitude', 'position_covariance[0]')}


@dataclass(frozen=True)
class Outcome:
    """Outcome of a leg; sigmas: the largest error of a value, over its sigma."""

    number: int
    faults: tuple[str, ...]
    verdict: str
    sigmas: float
    what: str
    reasons: tuple[str, ...]
    raised: str


@cache
def drive_of(number):
    return simulate(SimOptions(
        scenario='town', duration=240.0, seed=number + 1, imu_rate=25.0, odometer_rate=10.0,
        fix_rate=4.0, imu_grade='industrial', slope=0.03, sway=0.02, slip_walk=0.005,
        odometer=('counts', 'angle')[number % 2]))


def settings_of(drive):
    """Return settings with which a clean leg of this length is accepted."""
    return with_settings(Config(), {
        'imu.grade': 'industrial', 'alignment.heading': drive.truth.heading,
        'alignment.heading_sigma': 0.002, 'alignment.heading_source': 'fixed',
        'verdict.max_scale_sigma': 0.005, 'verdict.max_yaw_sigma': 0.05})


def rows_of(drive):
    """Return the messages by type: (arrival, message), in order."""
    wheel = (encode.counter('odometer', drive.odometer) if drive.options.odometer == 'counts'
             else encode.joints('odometer', {'wheel': drive.odometer}))
    topics = encode.imu('imu', drive.imu), wheel, encode.fix('fix', drive.fix)
    return {topic.msgtype: [(int(t), row.tobytes()) for t, row in zip(
        topic.time_ns, topic.pack(slice(0, len(topic.time_ns))), strict=True)] for topic in topics}


def some(rng, rows, kind, max_s=30.0):
    """Return a slice of consecutive rows of a type: one, a few, or some seconds."""
    n = len(rows[kind])
    rate = n / 240.0
    count = max(1, int(min(rng.choice([1, 2, 5, rng.uniform(0, max_s) * rate]), n // 3)))
    begin = rng.randrange(n - count)
    return slice(begin, begin + count)


def values(rng, rows):
    """Set a field to one value, or add a value to it, for a while."""
    kind = rng.choice(list(rows))
    field, which = rng.choice(FIELDS[kind]), some(rng, rows, kind)
    odd = 10**6 if kind == COUNTER else rng.choice(ODD)
    value = odd if rng.random() < 0.5 else rng.choice([-1, 1]) * 10**rng.uniform(-2, 4)
    add = rng.random() < 0.5
    whole = round if kind == COUNTER else float
    semantic.put_all(rows, kind, [field], lambda x: [whole(value + (x if add else 0))], which)
    return semantic.SAME


def axes_for_a_while(rng, rows):
    """Swap axes of gyro or accelerometer for a while."""
    order = rng.sample(range(3), 3)
    semantic.put_all(rows, IMU, rng.choice([semantic.RATES, semantic.FORCES]),
                     lambda *x: [x[k] for k in order], some(rng, rows, IMU, 100.0))
    return semantic.SAME


def burst(rng, rows):
    """Make messages of some seconds arrive at once."""
    kind = rng.choice(list(rows))
    which = some(rng, rows, kind)
    last = rows[kind][which][-1][0]
    rows[kind][which] = [(last, data) for _, data in rows[kind][which]]
    return semantic.SAME


def stuck(rng, rows):
    kind = rng.choice(list(rows))
    which = some(rng, rows, kind)
    first = rows[kind][which][0][1]
    head = 12 if kind != COUNTER else 0
    rows[kind][which] = [(t, data[:head] + first[head:]) for t, data in rows[kind][which]]
    return semantic.SAME


def missing(rng, rows):
    kind = rng.choice(list(rows))
    del rows[kind][some(rng, rows, kind)]
    return semantic.SAME


def far_stamps(rng, rows):
    """Shift the stamps of some messages far into the past or the future."""
    kind = rng.choice([one for one in rows if one != COUNTER])
    which, by_ns = some(rng, rows, kind), rng.choice([-1, 1]) * int(10**rng.uniform(8, 18))
    first = rows[kind][which][0][0]
    by_ns = min(max(by_ns, -first), (2**31 - 1) * SECOND - rows[kind][which][-1][0])
    rows[kind][which] = [(t, semantic.stamped(kind, d, by_ns)) for t, d in rows[kind][which]]
    return semantic.SAME


FAULTS = (values, values, values, axes_for_a_while, burst, stuck, missing, far_stamps,
          *semantic.ALL)


class AtOnce:
    """Runs the jobs of the running estimate immediately; keeps unexpected errors."""

    def __init__(self):
        self.raised = []

    def submit(self, job, then):
        """Run a job and pass on its result."""
        update = job()
        if update.error is not None and not isinstance(update.error, OdocalError):
            self.raised.append(repr(update.error))
        then(update, None)


def received(drive, rows, config):
    """Return recorder and marks of a leg of these messages, and errors of its running estimate."""
    readers = {kind: make_reader({IMU: 'imu', FIX: 'fix'}.get(kind, 'odometer'), kind, config)
               for kind in rows}
    health = {kind: Health() for kind in rows}
    recorder, progress, worker = LegRecorder(), Progress(False), AtOnce()
    watch, start_ns, at = RunningEstimate(worker, getLogger('odocal')), 0, dict.fromkeys(rows, 0)
    arrivals = {kind: np.array([t for t, _ in one]) for kind, one in rows.items()}
    first = drive.options.start_ns
    for edge in range(first, first + int(245e9), PIECE_NS):
        for kind, reader in readers.items():
            end = int(np.searchsorted(arrivals[kind], edge + PIECE_NS))
            part, at[kind] = rows[kind][at[kind]:end], max(at[kind], end)
            if not part:
                continue
            pairs = reader.rows([d for _, d in part], [t for t, _ in part], _no_other)
            for slot, block in pairs:
                sound = np.array(health[kind].check_stamps(
                    block.stamp_ns.tolist(), block.received_ns), bool) if (
                    slot == reader.slot) else None
                recorder.feed(slot, block)
                if sound is None:
                    continue
                block = block if sound.all() else take(block, sound)
                progress.feed(slot, block, config, readers_form(readers), 0.0)
                watch.feed(slot, block)
        newest = health[IMU].newest_ns
        if not start_ns and edge - first > START_NS and newest:
            start_ns = newest
            watch.begin(_snapshot(recorder, readers), start_ns, config)
        if start_ns:
            watch.update(newest)
            watch.faults()
        progress.distance_m()
    return _snapshot(recorder, readers), start_ns, health[IMU].newest_ns, worker.raised


def readers_form(readers):
    return next(one.form for one in readers.values() if one.slot == 'odometer')


def _snapshot(recorder, readers):
    copy = recorder.snapshot()
    copy.form = readers_form(readers) or copy.form
    return copy


def _no_other(_raw):
    raise ValueError('the columns of the layout are enough')


def leg(seed, number):
    rng = random.Random(f'{seed}:{number}')
    drive = drive_of(number % DRIVES)
    rows, config, done, truth = rows_of(drive), settings_of(drive), [], semantic.SAME
    for fault in [rng.choice(FAULTS) for _ in range(rng.choice([1, 1, 2]))] * (number >= DRIVES):
        least, largest = fault(rng, rows)
        truth = truth[0] * least, truth[1] * largest
        done.append(fault.__name__)
    for one in rows.values():
        one.sort(key=lambda row: row[0])
    with warnings.catch_warnings():
        warnings.simplefilter('error', RuntimeWarning)
        try:
            recorder, start_ns, stop_ns, raised = received(drive, rows, config)
            computed = worker.compute(recorder, start_ns, stop_ns, [], config)
        except OdocalError as error:
            return Outcome(number, tuple(done), 'refused', 0.0, '', (str(error),), '')
        except Exception as error:      # the test requires that there is none
            return Outcome(number, tuple(done), '', 0.0, '', (), repr(error))
    calibration = computed.calibration
    worst, what = semantic.worst_error({
        name: (e.value, e.sigma) for name, e in calibration.estimates.items()},
        semantic.ranges(drive.truth, truth))
    return Outcome(number, tuple(done), calibration.verdict.value, worst, what,
                   tuple(r.code.name for r in calibration.reasons), '; '.join(raised))
