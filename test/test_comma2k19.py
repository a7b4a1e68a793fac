# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The converter of comma2k19, on simulated folders with the documented layout."""

import json

import numpy as np
from pyproj import Transformer
import pytest
import yaml

from odocal_ros import read_bag, simulate
from odocal_ros.offline import against_truth, cli
from odocal_ros.sim import motion
from tools import comma2k19_bag

BOOT = 4321.0                        # s since the phone started, when the drive begins
GPS_EPOCH, LEAP = 315_964_800, 18    # s: 6 January 1980; GPS less UTC in 2018
SCALE, YAW = 1.0084, np.deg2rad(0.95)
FRAMES = 20.0                        # Hz


def put(folder, name, **arrays):
    """Write arrays as in the data set: in the format of numpy, without a file extension."""
    (folder / name).mkdir(parents=True, exist_ok=True)
    for part, rows in arrays.items():
        with (folder / name / part).open('wb') as file:
            np.save(file, rows)


def pose(latitude, longitude, height, v_enu):
    """Return positions and velocities in ECEF of rad, rad, m, and m/s: (n, 3) each."""
    to_e = Transformer.from_crs(4979, 4978, always_xy=True)
    x = np.stack(to_e.transform(*np.rad2deg([longitude, latitude]), height), -1)
    a, o = latitude, longitude
    east = np.stack([-np.sin(o), np.cos(o), 0 * o], -1)
    up = np.stack([np.cos(a) * np.cos(o), np.cos(a) * np.sin(o), np.sin(a)], -1)
    north = np.cross(up, east)
    return x, sum(v_enu[:, i, None] * axis for i, axis in enumerate((east, north, up)))


def put_frames(folder, utc, boot, x, v):
    gps = utc - GPS_EPOCH + LEAP
    put(folder, 'global_pose', frame_times=boot, frame_positions=x, frame_velocities=v,
        frame_gps_times=np.stack([gps // 604_800, gps % 604_800], -1))


@pytest.fixture(scope='module')
def drive():
    """Return a car's drive of two minutes: a phone's IMU, forward-right-down, speed, fixes."""
    return simulate('town', odometer='speed', duration=120.0, imu_rate=50.0, odometer_rate=40.0,
                    scale=SCALE, nominal_scale=1.0, yaw=YAW, mounting_rpy=(np.pi, 0.0, 0.0),
                    imu_grade='industrial', fix_sigma=0.5)


@pytest.fixture(scope='module')
def segment(drive, tmp_path_factory):
    """Return the folder of that drive, with the layout on the page of comma2k19."""
    folder = tmp_path_factory.mktemp('comma') / 'b0c9|2018-08-02--08-34-47' / '40'
    log = folder / 'processed_log'
    begin_ns = drive.options.start_ns

    def boot(ns):
        return (ns - begin_ns) * 1e-9 + BOOT
    t = boot(drive.imu.stamp_ns)
    put(log, 'IMU/gyro', t=t, value=drive.imu.w_i)
    put(log, 'IMU/gyro_uncalibrated', t=t, value=drive.imu.w_i + 0.067)
    # the accelerometer has its own times, a third of a step earlier, and one row less
    t_accelerometer = t[1:] - 0.006
    put(log, 'IMU/accelerometer', t=t_accelerometer, value=np.stack([
        np.interp(t_accelerometer, t, column) for column in drive.imu.f_i.T], -1))
    t = boot(drive.odometer.stamp_ns)
    put(log, 'CAN/speed', t=t, value=drive.odometer.value[:, None])
    put(log, 'CAN/wheel_speed', t=t, value=np.outer(drive.odometer.value, [1.0, 1.0, 0.99, 1.01]))
    fix = drive.fix
    rows = np.stack([np.rad2deg(fix.latitude), np.rad2deg(fix.longitude), 0 * fix.height,
                     fix.stamp_ns * 1e-9, fix.height, 0 * fix.height], -1)
    put(log, 'GNSS/live_gnss_ublox', t=boot(fix.stamp_ns) + 0.2, value=rows)
    since = np.arange(0.0, drive.motion.duration, 1 / FRAMES)
    state = drive.motion.at(since)
    put_frames(folder, begin_ns * 1e-9 + since, BOOT + since, *pose(
        state.latitude, state.longitude, state.height, motion.velocity_n(state)))
    return folder


@pytest.fixture(scope='module')
def made(segment, tmp_path_factory):
    out = tmp_path_factory.mktemp('data') / 'comma2k19_rav4'
    assert comma2k19_bag.main([str(segment), '--out', str(out)]) == 0
    return out


def test_the_bag_contains_the_data_of_the_folder(made, drive):
    topics = {'imu': '/imu/data', 'odometer': '/vehicle/twist', 'fix': '/fix'}
    bag = read_bag(made / 'bag', topics)
    imu, odometer, fix = (bag.samples(slot) for slot in topics)
    # UTC in float64 seconds, as in the data set, has a resolution of 0.25 us
    for got, sent in ((imu, drive.imu), (odometer, drive.odometer), (fix, drive.fix)):
        assert np.abs(got.stamp_ns - sent.stamp_ns).max() < 1000
    np.testing.assert_array_equal(imu.w_i, drive.imu.w_i)
    inner = slice(1, -1)      # linear between adjacent rows: within their difference
    jumps = np.abs(np.diff(drive.imu.f_i, axis=0))
    near = np.maximum(jumps[1:], jumps[:-1]) + 1e-9
    assert np.all(np.abs(imu.f_i - drive.imu.f_i)[inner] <= near)
    np.testing.assert_array_equal(odometer.value, drive.odometer.value)
    np.testing.assert_allclose(fix.latitude, drive.fix.latitude, rtol=1e-14)
    np.testing.assert_array_equal(fix.height, drive.fix.height)
    assert (fix.received_ns - fix.stamp_ns) * 1e-9 == pytest.approx(0.2, abs=1e-6)
    flu = read_bag(made / 'bag', topics | {'imu': '/imu/data_flu'}).samples('imu')
    np.testing.assert_array_equal(flu.w_i, imu.w_i * [1, -1, -1])
    np.testing.assert_array_equal(flu.f_i, imu.f_i * [1, -1, -1])
    raw = read_bag(made / 'bag', topics | {'imu': '/imu/data_uncalibrated'}).samples('imu')
    np.testing.assert_array_equal(raw.w_i, imu.w_i + 0.067)
    wheels = read_bag(made / 'bag', topics | {'odometer': '/wheel_states'},
                      {'odometer.left': 'rear_left', 'odometer.right': 'rear_right'})
    assert (wheels.form.quantity, wheels.form.scale_unit) == ('rate', 'm/rad')
    np.testing.assert_allclose(wheels.samples('odometer_right').value, 1.01 * drive.odometer.value)


def test_the_calibration_agrees_with_the_truth(made, drive, tmp_path, capsys):
    truth = yaml.safe_load((made / 'truth.yaml').read_text())
    assert truth['scale']['value'] == pytest.approx(SCALE, abs=3 * truth['scale']['sigma'])
    assert truth['scale']['sigma'] < 2e-3
    code = cli.main(['replay', str(made / 'bag'), '--imu-topic', '/imu/data_flu',
                     '--odometer-topic', '/odometer/pulses_derived', '--fix-topic', '/fix',
                     '--set', f'odometer.nominal_scale={truth["odometer"]["k0_m_per_pulse"]}',
                     '--set', 'output.formats=[params]', '--output', str(tmp_path / 'out')])
    assert code == 0
    result = tmp_path / 'out' / 'calibration.json'
    found = json.loads(result.read_text())['result']
    for name, true in (('scale_ratio', SCALE), ('yaw_mounting_angle', YAW)):
        assert abs(found[name]['value'] - true) < 4 * found[name]['sigma'], name
    capsys.readouterr()
    assert against_truth.main([str(result), str(made / 'truth.yaml')]) == 0
    assert 'DOES NOT AGREE' not in capsys.readouterr().out


def test_the_reference_is_the_pose(made, drive):
    rows = np.genfromtxt(made / 'reference.csv', delimiter=',', names=True)
    state = drive.motion.at(rows['unix_s'] - drive.options.start_ns * 1e-9)
    # 1e-9 deg are 0.1 mm, a stamp to a microsecond 0.02 mm
    np.testing.assert_allclose(rows['lat_deg'], np.rad2deg(state.latitude), atol=3e-9)
    np.testing.assert_allclose(rows['lon_deg'], np.rad2deg(state.longitude), atol=3e-9)
    np.testing.assert_allclose(rows['alt_m'], state.height, atol=1e-3)
    np.testing.assert_allclose(np.stack([rows[v] for v in ('ve', 'vn', 'vu')], -1),
                               motion.velocity_n(state), atol=2e-4)


@pytest.mark.parametrize(('spoil', 'says'), [
    (lambda log: (log / 'CAN/speed/t').unlink(), 'No such file.*want the folder of one segment'),
    (lambda log: (log / 'CAN/speed/t').write_bytes(b'no array'), 'speed/t: no numpy array'),
    (lambda log: (log / 'CAN/speed/t').write_bytes(b''), 'speed/t: no numpy array'),
    (lambda log: put(log, 'CAN/speed', t=np.arange(3.0)), '3 times for'),
    (lambda log: put(log, 'IMU/gyro', value=np.zeros(9)), r'has shape \(9,\), want \(n, 3\)'),
    (lambda log: put(log, 'CAN/speed', value=np.zeros((4800, 1)), t=np.arange(4800.0) / 40 + BOOT),
     'does not move'),
    (lambda log: (log / 'GNSS/live_gnss_ublox').rename(log / 'GNSS/other'), 'no fixes'),
    (lambda log: put(log.parent, 'global_pose', frame_times=np.arange(3.0)), 'not of one length'),
], ids=range(8))
def test_a_folder_with_another_layout_is_refused(segment, tmp_path, capsys, spoil, says):
    import re
    import shutil
    mine = tmp_path / '40'
    shutil.copytree(segment, mine)
    spoil(mine / 'processed_log')
    assert comma2k19_bag.main([str(mine), '--out', str(tmp_path / 'out')]) == 2
    printed = capsys.readouterr().err
    assert re.search(says, printed)
    assert len(printed.splitlines()) == 1
    assert not (tmp_path / 'out' / 'bag').exists()
