# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An axis that stops at the limit of its range is named; coarse steps and rest are not."""

import numpy as np
import pytest

from odocal_ros.reasons import Code
from odocal_ros.screening.saturation import saturated
from odocal_ros.settings.config import ImuConfig
from odocal_ros.settings.grades import G

N = 20_000
T = np.arange(N) * 0.01
NONE = np.zeros((N, 3))


def shaken(size, step=0.0):
    """Return forces about gravity: (N, 3) m/s^2, in steps."""
    f = np.random.default_rng(1).normal(0.0, size, (N, 3)) + [0.0, 0.0, G]
    return np.round(f / step) * step if step else f


def words(*signals, imu=None):
    """Return the sentences of what is found."""
    reasons = saturated(T, *signals, imu or ImuConfig())
    assert {reason.code for reason in reasons} <= {Code.IMU_SATURATED}
    return [reason.text for reason in reasons]


@pytest.mark.parametrize('step', [0.0, 0.125])
def test_force_cut_at_a_limit_is_named(step):
    f = np.clip(shaken(5.0, step), -2 * G, 19.5)
    count = int((f[:, 2] == 19.5).sum())
    first = T[np.argmax(f[:, 2] == 19.5)]
    assert words(NONE, f) == [
        f'accelerometer z stops at +19.5 m/s^2 in {count} of {N} messages, first at t = '
        f'{first:.1f} s']


def test_limits_are_those_of_the_scaled_unit():
    f = np.clip(shaken(5.0), -2 * G, 2 * G) / G
    assert 'stops at +19.61 m/s^2' in words(NONE, f, imu=ImuConfig(accel_scale=G))[0]
    assert not words(NONE, f)       # 2 m/s^2 is no range


def test_both_ends_of_a_gyro_are_counted():
    w = np.zeros((N, 3))
    w[:, 1] = np.clip(3.0 * np.sin(T), -2.18, 2.18)
    text, = words(w, NONE)
    assert text.startswith('gyro y stops at ')
    assert text.endswith('; 1 more such limits')


@pytest.mark.parametrize('signal', [
    shaken(5.0), shaken(5.0, 0.125), shaken(5.0, 1.0),         # not cut
    shaken(5.0)[np.arange(N) // 4],                            # each value sent four times
    np.round(shaken(0.01) / 0.1) * 0.1,                        # at rest, in coarse steps
], ids=['fine', 'steps', 'coarse', 'repeated', 'rest'])
def test_no_limit_is_found_where_none_is(signal):
    assert not words(NONE, signal)
    assert not words(signal * [1.0, 1.0, 0.0] / 5.0, NONE)
