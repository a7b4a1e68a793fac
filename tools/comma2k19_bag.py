# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A bag of one segment of comma2k19 (github.com/commaai/comma2k19, MIT), as that page describes it.

``python -m tools.comma2k19_bag SEGMENT --out FOLDER`` reads the folder of a minute, with
processed_log and global_pose in it, and writes FOLDER/bag, reference.csv (the global pose) and
truth.yaml: the scale of the car's speed by the pose. FOLDER is what the tests and .ci/run look for
under $ODOCAL_DATA as comma2k19_rav4, made of Example_1 there.
"""

from pathlib import Path
import sys

import numpy as np

from odocal_ros.bagio import encode
from odocal_ros.bagio.write import write_bag
from odocal_ros.data.samples import FixSamples, ImuSamples, OdometerSamples
from odocal_ros.errors import BadUsage
from odocal_ros.safe_io.atomic_files import write_text
from tools.converter import run

GPS_EPOCH, WEEK, LEAP = 315_964_800.0, 604_800.0, 18.0    # s; GPS ahead of UTC since 2017
MILLISECONDS = 1e11      # a time in UTC that is larger is none in seconds
FLU = np.array([1.0, -1.0, -1.0])                          # forward-right-down to ours
K0 = 0.01                # m, of a pulse derived from the speed
WHEELS = ('front_left', 'front_right', 'rear_left', 'rear_right')
PIECES = 12              # sections whose scatter gives the sigma of the scale
MIN_SIGMA = 6e-4       # of the scale: pose and fixes differ by half of it in Example_1
TRUTH = """\
bag: bag
imu_topic: /imu/data
nominal_rpy_deg: [180.0, 0.0, 0.0]      # imu (forward-right-down) -> body (FLU)
imu_flu_topic: /imu/data_flu
odometer: {{twist: /vehicle/twist, pulses: /odometer/pulses_derived, wheels: /wheel_states, \
k0_m_per_pulse: {k0}}}
fix_topic: /fix
scale: {{value: {scale:.5f}, sigma: {sigma:.5f}, accept: [{low:.5f}, {high:.5f}]}}
"""


def array(segment: Path, name: str, width: int = 0):
    """
    Return an array of a segment, (n,) or with a width (n, width or more).

    Raises
    ------
    BadUsage
        It is not there, or not as the page of comma2k19 says.

    """
    path = segment / name
    try:
        # mapped, so that a file that claims more than it holds is refused
        found = np.array(np.load(path, mmap_mode='r'), dtype=float)
    except OSError as error:
        raise BadUsage(f'{path}: {error.strerror or error}; want the folder of one segment, with '
                       'processed_log and global_pose in it') from None
    except (ValueError, EOFError) as error:
        raise BadUsage(f'{path}: no numpy array ({str(error).splitlines()[0]})') from None
    if found.ndim > 2 or (width and (found.ndim < 2 or found.shape[1] < width)) or not len(found):
        raise BadUsage(f'{path}: has shape {found.shape}, want (n{f", {width}" * bool(width)})')
    return found if width else found.reshape(len(found), -1)[:, 0]


def log(segment, name, width=0):
    """Return times of a log since boot, s, rising, and its values."""
    t, value = (array(segment, f'processed_log/{name}/{part}', wide)
                for part, wide in (('t', 0), ('value', width)))
    if len(t) != len(value):
        raise BadUsage(f'{segment / "processed_log" / name}: {len(t)} times for {len(value)} '
                       'values')
    order = np.argsort(t, kind='stable')
    return t[order], value[order]


class Clock:
    """The phone's time since boot as nanoseconds in UTC, by the frames of its camera."""

    def __init__(self, segment):
        self.boot = array(segment, 'global_pose/frame_times')
        week, second = array(segment, 'global_pose/frame_gps_times', 2)[:, :2].T
        self.utc = GPS_EPOCH + WEEK * week + second - LEAP
        if len(self.utc) != len(self.boot) or len(self.utc) < 2:
            raise BadUsage(f'{segment}/global_pose: frame_times and frame_gps_times are not of '
                           'one length')
        self.rate, _ = np.polyfit(self.boot - self.boot.mean(), self.utc - self.utc.mean(), 1)

    def __call__(self, t):
        """Return UTC in ns of times since boot, s."""
        since = (t - self.boot.mean()) * self.rate + (self.utc - self.utc[0]).mean()
        return round(self.utc[0] * 1e9) + np.round(since * 1e9).astype(np.int64)


def imu_topics(segment, clock):
    """Yield the phone's IMU as it is, turned to forward-left-up, and with the chip's own bias."""
    t_force, force = log(segment, 'IMU/accelerometer', 3)
    for topic, name, axes, frame in (
            ('/imu/data', 'gyro', 1.0, 'imu_link'), ('/imu/data_flu', 'gyro', FLU, 'imu_flu'),
            ('/imu/data_uncalibrated', 'gyro_uncalibrated', 1.0, 'imu_link')):
        t, rate = log(segment, f'IMU/{name}', 3)
        at_rates = np.stack([np.interp(t, t_force, column) for column in force.T[:3]], -1)
        stamp, n = clock(t), len(t)
        yield encode.imu(topic, ImuSamples(
            stamp, stamp, rate[:, :3] * axes, at_rates * axes,
            np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)), np.full(n, np.nan)), frame)


def odometer_topics(segment, clock):
    """Yield the speed on the CAN bus, pulses of K0 made of it, and the speeds of four wheels."""
    t, speed = log(segment, 'CAN/speed')
    stamp = clock(t)
    yield encode.twist('/vehicle/twist', OdometerSamples(stamp, stamp, speed))
    yield encode.counter('/odometer/pulses_derived', OdometerSamples(
        stamp, stamp, np.floor(way_of(t, speed) / K0).astype(np.int64)))
    t, speeds = log(segment, 'CAN/wheel_speed', 4)
    stamp = clock(t)
    yield encode.joints('/wheel_states', {
        name: OdometerSamples(stamp, stamp, column)
        for name, column in zip(WHEELS, speeds.T, strict=False)}, 'base_link', rates=True)


def fix_topics(segment, clock):
    """Yield the fixes of both receivers, if there: stamped by their UTC, at their arrival."""
    for topic, name, frame in (('/fix', 'live_gnss_ublox', 'gps'),
                               ('/fix_phone', 'live_gnss_qcom', 'gps_phone')):
        if not (segment / 'processed_log/GNSS' / name).exists():
            continue
        t, rows = log(segment, f'GNSS/{name}', 5)
        utc = np.where(rows[:, 3] > MILLISECONDS, rows[:, 3] / 1e3, rows[:, 3])
        whole = np.zeros(len(t), np.int64)
        yield encode.fix(topic, FixSamples(
            np.round(utc * 1e9).astype(np.int64), clock(t), *np.deg2rad(rows[:, :2]).T,
            rows[:, 4], np.zeros((len(t), 3, 3)), whole, whole), frame)


def scale_by_pose(segment, clock):
    """Return the ratio of path lengths, pose over speed, and its sigma from sections."""
    t, speed = log(segment, 'CAN/speed')
    v = np.linalg.norm(array(segment, 'global_pose/frame_velocities', 3)[:, :3], axis=1)
    if len(v) != len(clock.boot):
        raise BadUsage(f'{segment}/global_pose: frame_times and frame_velocities are not of one '
                       'length')
    edges = np.linspace(max(t[0], clock.boot[0]), min(t[-1], clock.boot[-1]), PIECES + 1)
    pose, said = (np.diff(np.interp(edges, at, way_of(at, v))) for at, v in (
        (clock.boot, v), (t, speed)))
    if not said.sum() > 0 or not np.isfinite(pose).all():
        raise BadUsage(f'{segment}: a pose or a speed is not a number, or the car does not move')
    scale = pose.sum() / said.sum()
    off = np.sqrt(((pose - scale * said)**2).sum() * PIECES / (PIECES - 1)) / said.sum()
    return scale, max(off, MIN_SIGMA)


def way_of(t, speed):
    """Return the path length since the first of speeds, m."""
    return np.append(0.0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t)))


def reference(segment, clock):
    """Return the global pose as text: WGS 84 and velocities east, north, up."""
    from pyproj import Transformer
    x = array(segment, 'global_pose/frame_positions', 3)[:, :3]
    v = array(segment, 'global_pose/frame_velocities', 3)[:, :3]
    longitude, latitude, height = Transformer.from_crs(4978, 4979, always_xy=True).transform(*x.T)
    (cos_a, cos_o), (sin_a, sin_o) = (f(np.deg2rad([latitude, longitude])) for f in (np.cos,
                                                                                   np.sin))
    C_en = np.array([[-sin_o, cos_o, 0 * cos_o], [-sin_a * cos_o, -sin_a * sin_o, cos_a],
                     [cos_a * cos_o, cos_a * sin_o, sin_a]])
    rows = np.column_stack([clock(clock.boot) * 1e-9, latitude, longitude, height,
                            np.einsum('ijk,kj->ki', C_en, v)])
    return 'unix_s,lat_deg,lon_deg,alt_m,ve,vn,vu\n' + ''.join(
        '{:.6f},{:.9f},{:.9f},{:.3f},{:.4f},{:.4f},{:.4f}\n'.format(*row) for row in rows)


def convert(segment: Path, out: Path, force: bool = False) -> Path:
    """
    Write the bag of a segment, its reference and its truth; return the bag.

    Raises
    ------
    BadUsage
        The segment lacks a file that is needed, or nothing can be written.

    """
    clock = Clock(segment)
    fixes = [*fix_topics(segment, clock)]
    if not fixes:
        raise BadUsage(f'{segment}/processed_log/GNSS has neither live_gnss_ublox nor '
                       'live_gnss_qcom: there are no fixes')
    scale, sigma = scale_by_pose(segment, clock)
    topics = [*imu_topics(segment, clock), *odometer_topics(segment, clock), *fixes]
    pose = reference(segment, clock)
    bag = write_bag(out / 'bag', topics, force=force)
    write_text(out / 'reference.csv', pose)
    write_text(out / 'truth.yaml', TRUTH.format(
        k0=K0, scale=scale, sigma=sigma, low=scale - 4 * sigma, high=scale + 4 * sigma))
    return bag


def main(argv=None) -> int:
    """Convert one segment; return 0, 2 on wrong use."""
    return run('comma2k19_bag', 'a segment of comma2k19: a folder with processed_log and '
               'global_pose', convert, argv)


if __name__ == '__main__':
    sys.exit(main())
