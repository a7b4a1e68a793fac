# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cold start of the smoother where the fixes do not get far: a vehicle that drives circles."""

import numpy as np
import pytest

from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import FixSamples, ImuSamples, OdometerForm, OdometerSamples
from odocal_ros.nav.earth import gravity
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.slow
LATITUDE, EARTH = 0.8, 6.378137e6      # rad; m, semi-major axis of WGS 84
SPEED, RADIUS, STRAIGHT = 9.0, 30.0, 60.0     # m/s, m, m
START_NS = 1_700_000_000_000_000_000


def circles(heading, seed, duration=300.0, rate=100.0):
    """Return a leg of left circles on level ground from a standstill, and the final yaw, rad."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 1 / rate)
    speed = np.clip(1.5 * np.minimum(t - 20.0, duration - 10.0 - t), 0.0, SPEED)
    path = np.cumsum(speed) / rate
    turn_rate = np.where(path > STRAIGHT, speed / RADIUS, 0.0)
    yaw = heading + np.cumsum(turn_rate) / rate
    east, north = (np.cumsum(speed * x) / rate for x in (np.cos(yaw), np.sin(yaw)))
    zero = np.zeros_like(t)
    white = rng.standard_normal((6, len(t)))
    w = np.stack([zero, zero, turn_rate], -1) + 8e-4 * white[:3].T
    f = np.stack([np.gradient(speed, t), speed * turn_rate, zero + gravity(LATITUDE, 0.0)], -1)
    stamps = START_NS + np.round(t * 1e9).astype(np.int64)
    at = np.arange(0, len(t), int(rate))      # of the fixes: 1 Hz
    sine2 = np.sin(LATITUDE)**2
    n = EARTH / np.sqrt(1 - 0.00669438 * sine2)
    m = n * (1 - 0.00669438) / (1 - 0.00669438 * sine2)
    off = 0.3 * rng.standard_normal((2, len(at)))
    fix = FixSamples(
        stamps[at], stamps[at], LATITUDE + (north[at] + off[0]) / m,
        (east[at] + off[1]) / n / np.cos(LATITUDE), 0.5 * rng.standard_normal(len(at)),
        np.tile(np.diag([0.3, 0.3, 0.5])**2, (len(at), 1, 1)), np.full(len(at), 3),
        np.zeros(len(at)))
    return Leg(
        START_NS + 15 * 10**9, int(stamps[-1]) - 4 * 10**9,
        imu=ImuSamples(stamps, stamps, w, f + 0.01 * white[3:].T,
                       np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1)), zero + np.nan),
        odometer=OdometerSamples(stamps[::2], stamps[::2],
                                 np.floor(path[::2] / 0.02).astype(np.int64)),
        fix=fix, form=OdometerForm('cumulative', 2**32, 'm/pulse')), yaw[-1]


@pytest.mark.parametrize('heading', [-1.6, 3.1])
def test_heading_of_circles_is_found_whatever_it_is(heading):
    leg, yaw = circles(heading, 1)
    method = calibrate(leg, with_settings(Config(), {
        'odometer.nominal_scale': 0.02, 'method': 'smoother'})).methods['smoother']
    forward = method.details['key_C_nb'][-1][:, 0]
    off = np.angle(np.exp(1j * (np.arctan2(forward[1], forward[0]) - yaw)))
    assert abs(off) < 0.05      # rad, 0.3 m of a fix at 30 m are 0.01
    assert Code.FIXES_NOISIER_THAN_SAID not in {reason.code for reason in method.reasons}
