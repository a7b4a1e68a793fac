# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Convert a session of a CANedge logger with a CANmod.gps and OBD-II to a bag.

``python -m tools.canedge_bag SESSION --out FOLDER`` reads the .MF4 files of a session with asammdf
(``pip install asammdf``) and writes FOLDER/bag. The session of the tests is 3BA199E2/00000165 in
github.com/CSS-Electronics/api-examples (MIT), examples/other/matlab-basics/LOG_datastore.
"""

import math
from pathlib import Path
import sys

import numpy as np

from odocal_ros.bagio import encode
from odocal_ros.bagio.write import write_bag
from odocal_ros.data.samples import FixSamples, ImuSamples, OdometerSamples
from odocal_ros.errors import BadData, BadUsage
from tools.comma2k19_bag import way_of
from tools.converter import run

# canmod-gps.dbc of the data set: frame -> signal -> first bit, bits, factor, offset
POSITION, HEIGHT, SPEED, IMU = 3, 4, 7, 9
SIGNALS = {
    POSITION: {'valid': (0, 1, 1.0, 0.0), 'latitude': (1, 28, 1e-6, -90.0),
               'longitude': (29, 29, 1e-6, -180.0), 'accuracy': (58, 6, 1.0, 0.0)},
    HEIGHT: {'height': (1, 18, 0.1, -6000.0), 'accuracy': (19, 13, 1.0, 0.0)},
    SPEED: {'speed': (1, 20, 1e-3, 0.0)},
    IMU: {**{f'f{axis}': (1 + 10 * n, 10, 0.125, -64.0) for n, axis in enumerate('xyz')},
          **{f'w{axis}': (31 + 11 * n, 11, 0.25, -256.0) for n, axis in enumerate('xyz')}}}
REPLY, SPEED_REPLY = 0x7E8, [0x41, 0x0D]    # ISO 15765-4, SAE J1979: of the engine, mode 1, speed
KMH = 3.6                # definition: of 1 m/s
DIAGONAL = 2             # format: COVARIANCE_TYPE_DIAGONAL_KNOWN of sensor_msgs/NavSatFix
K0 = 0.1                 # m, of a pulse derived from the speed


def frames(session: Path):
    """Return stamps in ns, identifiers and bytes (n, 8) of all frames of a session."""
    try:
        from asammdf import MDF
    except ImportError:
        raise BadUsage('needs asammdf: pip install asammdf') from None
    parts = []
    for file in sorted(session.rglob('*.[mM][fF]4')):
        with MDF(file) as mdf:
            begin_ns = round(mdf.start_time.timestamp() * 1e9)
            for group, channel in mdf.channels_db.get('CAN_DataFrame.ID', ()):
                ids = mdf.get('CAN_DataFrame.ID', group, channel)
                data = mdf.get('CAN_DataFrame.DataBytes', group).samples
                bytes_8 = np.zeros((len(data), 8), np.uint8)
                bytes_8[:, :data.shape[1]] = data[:, :8]
                parts.append((begin_ns + np.round(ids.timestamps * 1e9).astype(np.int64),
                              ids.samples.astype(int), bytes_8))
    if not parts:
        raise BadData(f'{session}: no .MF4 file with CAN frames')
    stamp, ids, data = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(stamp, kind='stable')
    return stamp[order], ids[order], data[order]


def signals(stamp, ids, data, frame):
    """Return stamps and signals of one frame of the CANmod."""
    rows = ids == frame
    bits = data[rows].view('<u8')[:, 0]
    return stamp[rows], {
        name: (bits >> np.uint64(first) & np.uint64(2**width - 1)) * factor + offset
        for name, (first, width, factor, offset) in SIGNALS[frame].items()}


def topics(stamp, ids, data):
    """Yield the topics of a session."""
    t, value = signals(stamp, ids, data, IMU)
    n = len(t)
    yield encode.imu('/imu/data', ImuSamples(
        t, t, np.deg2rad(np.stack([value[f'w{axis}'] for axis in 'xyz'], -1)),
        np.stack([value[f'f{axis}'] for axis in 'xyz'], -1),
        np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)), np.full(n, np.nan)), 'canmod')
    rows = (ids == REPLY) & (data[:, 1:3] == SPEED_REPLY).all(axis=1)
    t, speed = stamp[rows], data[rows, 3] / KMH
    yield encode.twist('/vehicle/twist', OdometerSamples(t, t, speed))
    yield encode.counter('/odometer/pulses_derived', OdometerSamples(
        t, t, np.floor(way_of((t - t[:1]) * 1e-9, speed) / K0).astype(np.int64)))
    t, value = signals(stamp, ids, data, SPEED)
    yield encode.twist('/fix_speed', OdometerSamples(t, t, value['speed']), 'gps')
    yield _fixes(stamp, ids, data)


def _fixes(stamp, ids, data):
    """Return the valid fixes, with the last height before each."""
    t, value = signals(stamp, ids, data, POSITION)
    t_height, height = signals(stamp, ids, data, HEIGHT)
    last = np.searchsorted(t_height, t, 'right') - 1
    good = (value['valid'] > 0) & (last >= 0)
    t, last = t[good], last[good]
    covariance = np.zeros((len(t), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = (
        value['accuracy'][good] / math.sqrt(2.0))**2        # of the distance: half for each axis
    covariance[:, 2, 2] = height['accuracy'][last]**2
    return encode.fix('/fix', FixSamples(
        t, t, np.deg2rad(value['latitude'][good]), np.deg2rad(value['longitude'][good]),
        height['height'][last], covariance, covariance_type=np.full(len(t), DIAGONAL),
        status=np.zeros(len(t), np.int64)), 'gps')


def convert(session: Path, out: Path, force: bool) -> Path:
    """Write the bag of a session."""
    return write_bag(out / 'bag', [*topics(*frames(session))], force=force)


def main(argv=None) -> int:
    """Convert one session; return 0, 2 for unusable files."""
    return run('canedge_bag', 'a session of a CANedge logger: a folder with .MF4 files', convert,
               argv)


if __name__ == '__main__':
    sys.exit(main())
