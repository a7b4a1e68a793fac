# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A counter stamped on arrival: estimated times of its rows, and the delay of the IMU."""

from dataclasses import replace

from faulty_streams import columns_of, run, started
import numpy as np
import pytest

from odocal_ros.apply.delay_search import DelaySearch, MIN_DELAY_ROWS
from odocal_ros.apply.errors import GRAVITY
from odocal_ros.apply.row_times import RowTimes
from odocal_ros.data.samples import take
from odocal_ros.settings.node_configs import ApplyConfig
from odocal_ros.sim.scenarios import SimOptions, simulate

RATE, COUNT = 50.0, 0.02      # Hz, m
PIECE_NS = 50_000_000
FORWARD = (1.0, 0.0, 0.0)
REPORT = 'relative to the odometer'


def placed(arrivals, travel, speed=10.0, quantum=0.0):
    """Return the estimated times of rows, s, and the estimator after them."""
    row_times = RowTimes()
    return np.array([row_times.next_time(t, s, speed, quantum) for t, s in zip(
        arrivals.tolist(), travel.tolist(), strict=True)]), row_times


def in_order(t):
    """Return arrivals in increasing order, s."""
    order = 2e-5 * np.arange(len(t))
    return np.maximum.accumulate(t - order) + order


@pytest.fixture(scope='module')
def even():
    """Return periodic times, and arrivals that are late by 5 ms on average."""
    t = np.arange(3000) / RATE
    return t, in_order(t + np.random.default_rng(1).exponential(5e-3, len(t)))


def test_late_rows_get_periodic_times(even):
    t, arrivals = even
    times, row_times = placed(arrivals, 10.0 * t)
    off = (times - t)[500:]
    # delays of 5 ms on average: the smallest of 500 is 0.01 ms, of 50 it is 0.1 ms
    assert np.std(off) < 2e-4
    assert np.median(np.abs(np.diff(off))) < 5e-5
    assert (np.diff(times) > 0).all()
    assert row_times.error_s < 1e-3


def starved(t, stalls, seed):
    """Return arrivals from a sender that stalls for up to 0.4 s, one row after the other."""
    rng, arrivals = np.random.default_rng(seed), np.empty(len(t))
    takes = 1e-3 + np.where(rng.random(len(t)) < stalls, rng.uniform(0.05, 0.4, len(t)), 0.0)
    free = -np.inf
    for k in range(len(t)):
        arrivals[k] = free = max(t[k], free) + takes[k]
    return arrivals


@pytest.mark.parametrize('stalls', [0.02, 0.05])
def test_rows_of_a_stalling_sender_get_periodic_times(even, stalls):
    t, _ = even
    arrivals = starved(t, stalls, 5)
    assert np.quantile(arrivals - t, 0.9) > 0.2
    times, row_times = placed(arrivals, 10.0 * t)
    assert np.abs(times - t)[500:].max() < 2e-3
    assert row_times.error_s < 1e-3


# lost rows, rows that are late until a time, speed, first tested row and largest error
LOST = {
    # four rows at once follow the last late one: 0.1 s are five intervals
    'a delay at rest that ends is no lost row': (
        [], slice(1000, 1050), lambda t: t + 0.1, 0.0, 1055, 0.25 / RATE),
    # a burst, of which none is lost
    'travel shows the rows that are lost and those that are late': (
        [700, 701, 1500, 2200], slice(1000, 1006), lambda t: t[-1] + 1 / RATE, 10.0, 500, 4e-3),
    'rows lost at rest shift the line within half a second': (
        [1000, 1001, 1002], slice(0, 0), lambda t: t, 0.0, 1040, 0.25 / RATE)}


@pytest.mark.parametrize('case', LOST)
def test_lost_rows_and_late_rows_are_distinguished(even, case):
    (t, arrivals), (lost, rows, until_s, speed, first, most) = even, LOST[case]
    kept, late = np.delete(np.arange(len(t)), lost), arrivals.copy()
    late[rows] = np.maximum(late[rows], until_s(t[rows]))
    times, _ = placed(in_order(late)[kept], speed * t[kept], speed, 0.0 if speed else COUNT)
    off = times - t[kept]
    off -= np.median(off) if lost else 0.0
    assert np.abs(off[first:]).max() < most


def test_the_times_follow_a_change_of_the_rate(even):
    t, arrivals = even
    slow = t[-1] + 1.0 + np.arange(1000) / (RATE / 2)
    after = in_order(slow + np.random.default_rng(2).exponential(5e-3, len(slow)))
    both = np.append(t, slow)
    times, _ = placed(np.append(arrivals, after), 10.0 * both)
    assert np.std((times - both)[-500:]) < 2e-3


def test_uneven_times_and_even_stamps_are_kept():
    rng = np.random.default_rng(3)
    t = np.sort(np.arange(3000) / RATE + rng.uniform(-5e-3, 5e-3, 3000))
    times, row_times = placed(t, 10.0 * t)
    np.testing.assert_array_equal(times[500:], t[500:])
    assert row_times.error_s < 1e-5
    t = np.arange(1000) / RATE
    times, _ = placed(t, 10.0 * t)
    np.testing.assert_array_equal(times, t)


def test_the_error_covers_delays_of_irregular_rows():
    rng = np.random.default_rng(4)
    t = np.cumsum(rng.uniform(0.01, 0.03, 3000))            # irregular and late
    late = in_order(t + rng.exponential(3e-3, len(t)))
    times, row_times = placed(late, 10.0 * t)
    assert np.mean(times == late) > 0.98      # chance may favour a line for some rows
    # the deviation from the neighbours differs slightly from that of evenly spaced rows
    assert row_times.error_s == pytest.approx(3e-3, rel=0.4)


def twists(mean_late_s, seed):
    """Return error and sigma of the forward speed of a drive whose counter is late, m/s."""
    drive = simulate(SimOptions(scenario='town', duration=135.0, seed=seed, imu_rate=100.0,
                                odometer_rate=RATE, imu_grade='industrial'))
    begin_ns, rows = drive.options.start_ns, drive.odometer
    late = np.random.default_rng(seed).exponential(mean_late_s, len(rows.stamp_ns))
    stamps = begin_ns + np.rint(1e9 * in_order((rows.stamp_ns - begin_ns) * 1e-9 + late)).astype(
        np.int64)
    counter = replace(rows, stamp_ns=stamps, received_ns=stamps)
    odometry, poses = started(drive, seed, publish__rate=ApplyConfig().publish.rate), []
    for edge in range(begin_ns, int(stamps[-1]), PIECE_NS):
        for slot, block in (('imu', drive.imu), ('odometer', counter)):
            a, b = np.searchsorted(block.received_ns, [edge, edge + PIECE_NS])
            odometry.feed(slot, take(block, slice(a, b)), drive.form)
        poses += odometry.poses()
    assert odometry.take_notes() == []
    t = (np.array([pose.stamp_ns for pose in poses]) - begin_ns) * 1e-9
    fine = np.arange(0.0, drive.motion.duration, 1e-3)
    path = np.concatenate([[0.0], np.cumsum(drive.motion.at(fine).speed[1:] * 1e-3)])
    true = np.diff(np.interp(t, fine, path)) / np.diff(t)
    error = np.array([pose.velocity[0] for pose in poses])[1:] - true
    sigma = np.sqrt([pose.twist_cov[0, 0] for pose in poses])[1:]
    moving = true > 0.3
    return error[moving], sigma[moving]


@pytest.mark.slow
@pytest.mark.parametrize('late_s', [0.0, 1e-3, 5e-3, 20e-3])
def test_the_twist_of_a_late_counter_is_within_its_covariance(late_s):
    error, sigma = twists(late_s, seed=1)
    assert len(error) > 500
    assert np.mean(np.abs(error) < 2 * sigma) >= 0.95
    # little more than the effect of one count in 50 ms
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert np.median(sigma) < 0.25


def test_times_rise_far_from_zero():
    """A counter stamped on arrival has times of 1.7e9 s if the IMU clock starts at zero."""
    rng, row_times = np.random.default_rng(1), RowTimes()
    arrival = np.maximum.accumulate(1.7e9 + np.arange(0, 60, 0.02) + rng.exponential(0.02, 3000))
    placed = [row_times.next_time(t, 0.2 * k, 10.0, 0.01) for k, t in enumerate(arrival.tolist())]
    assert (np.diff(placed) > 0).all()


def searched(late, bias=0.1, seconds=200):
    """Search the delay of the force, late in s, with an acceleration of 9 s period."""
    notes = []
    search = DelaySearch(0.0, 0.01)

    def speed(t):
        return 10.0 + 2.0 * np.sin(2 * np.pi * t / 9.0)

    for t in np.arange(1.0, seconds):
        change = [speed(t) - speed(t - 1), 0.0, 0.0]
        force = speed(t - late) - speed(t - 1 - late) + bias
        notes.append(search.add(FORWARD, np.array(change), (force, 0.0, GRAVITY), 1.0))
    return search, [note for note in notes if note]


@pytest.mark.parametrize('late', [0.1, -0.2])
def test_a_delay_is_found_in_the_presence_of_a_bias(late):
    """
    Of a sine of w the slope is off by w / sin(w), of which CHANGE_SMOOTHED is taken off.

    w = 2 pi / 9 a second: 1.09 for 1.2; to first order in w late.
    """
    search, notes = searched(late)
    w = 2 * np.pi / 9.0
    expected = late * w / np.sin(w) / 1.2
    found = float(notes[-1].split('are ')[1].split(' s')[0])
    assert found == pytest.approx(abs(expected), abs=0.01)
    assert ('late' if late > 0 else 'early') in notes[-1]
    assert search.sigma_s >= abs(expected) - 0.01


def test_no_delay_is_reported_without_one_or_from_less_than_a_minute():
    search, notes = searched(0.0)
    assert not notes
    assert search.sigma_s == 0.01
    assert not searched(0.2, seconds=MIN_DELAY_ROWS)[1]
    search = DelaySearch(0.0, 0.01)
    assert not any(search.add(FORWARD, None, (0.0, 0.0, GRAVITY), 1.0) for _ in range(500))


@pytest.mark.parametrize('late', [0.0, 0.15])
def test_late_stamps_of_a_drive_are_reported(late):
    drive = simulate(SimOptions(scenario='town', duration=240.0, seed=5, imu_rate=100.0,
                                odometer_rate=20.0, imu_grade='industrial'))
    topics = columns_of(drive)
    for column in ('stamp', 'arrival'):
        topics['imu'][column] = topics['imu'][column] + round(late * 1e9)
    _, texts = run(drive, started(drive, 5), topics)
    reports = [text for text in texts if REPORT in text]
    if late:
        assert float(reports[-1].split('are ')[1].split(' s')[0]) == pytest.approx(late, abs=0.04)
    else:
        assert not reports
