# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two IMUs under one frame_id whose messages alternate, and one IMU whose rows do not."""

from drives import changed, drive
import numpy as np
import pytest

from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen
from odocal_ros.screening.several_imus import alternating
from odocal_ros.settings.config import Config

BIAS = np.array([3e-3, -2e-3, 1e-3])     # rad/s: 0.17 deg/s, a consumer gyro has 1 deg/s


@pytest.fixture(scope='module')
def leg():
    return drive(scenario='town', duration=200.0, imu_grade='consumer', seed=8).leg()


def second(x, by):
    """Return rows of which every second one is changed."""
    return np.where((np.arange(len(x)) % 2 == 1)[:, None], by(x), x)


@pytest.mark.parametrize(('column', 'by'), [
    ('w_i', lambda w: w + BIAS), ('f_i', lambda f: f + 100 * BIAS),
    ('w_i', lambda w: w @ matrix_from_rpy([0.1, 0.0, 0.0]).T)], ids=['gyro', 'force', 'axes'])
def test_rows_that_alternate_between_two_imus_reject_the_leg(leg, column, by):
    mixed = changed(leg.imu, **{column: lambda x: second(x, by)})
    _, reasons = screen(leg.__class__(**{**vars(leg), 'imu': mixed}), Config())
    assert 'every second message' in {r.code: r for r in reasons}[Code.SEVERAL_IMUS].text


@pytest.mark.parametrize('grade', ['consumer', 'perfect'])
@pytest.mark.parametrize('rate', [10.0, 25.0, 100.0])
@pytest.mark.parametrize('repeat', [1, 2])
def test_one_imu_is_one_at_any_rate_and_with_rows_that_repeat(grade, rate, repeat):
    imu = drive(scenario='yard', duration=250.0, imu_grade=grade, imu_rate=rate, seed=9).leg().imu
    assert not alternating(*(np.repeat(x[::repeat], repeat, axis=0) for x in (imu.w_i, imu.f_i)))


def test_a_spike_is_no_second_imu(leg):
    w = leg.imu.w_i.copy()
    w[len(w) // 2] += 50.0
    assert not alternating(w, leg.imu.f_i)
