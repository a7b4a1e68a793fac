# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Standstill, level and gyro errors of a leg against the simulator's truth."""

from dataclasses import replace

from align_cases import Case, PLAIN, settings, TURNING
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.pipeline.align import attitude_of, choose_standstill, with_observed_walk
from odocal_ros.reasons import Code
from odocal_ros.settings.nominal import GRADES


@pytest.mark.parametrize(('spans', 'chosen'), [
    ([], None), ([[5.0, 9.0]], None), ([[-9.0, 3.0]], 0), ([[-9.0, -5.0], [-3.0, -1.0]], 1),
    ([[-9.0, -5.0], [0.4, 3.0]], 1), ([[-9.0, -5.0], [0.6, 3.0]], 0)])
def test_alignment_uses_the_standstill_at_the_mark_or_the_last_before(spans, chosen):
    found = choose_standstill(np.array(spans).reshape(-1, 2))
    assert found is None if chosen is None else found.tolist() == spans[chosen]


@pytest.fixture(scope='module')
def far():
    """Return a drive whose mark is set 3 km after its standstill."""
    return Case(replace(PLAIN, duration=500.0, heading_sigma=0.0, fix_sigma=0.0), later=300.0)


@pytest.mark.parametrize('source', ['heading_topic', 'gyrocompass', 'fixed'])
def test_a_standstill_far_from_the_mark_uses_level_and_north_of_its_place(far, source):
    a, _ = far.with_settings_of(alignment__heading_source=source,
                                alignment__heading=far.heading()).align()
    assert a.t < -250
    assert a.heading_source == source
    # fixes of 1 mm; the heading carried back is of an axis pitched by 0.01 rad, and the local
    # level has turned by 0.4 mrad meanwhile
    assert_allclose(far.miss(a), 0, atol=5e-6 if source == 'fixed' else 2e-7)


@pytest.mark.parametrize('seed', [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize('grade', ['consumer', 'tactical'])
def test_level_in_motion_is_within_its_sigma(seed, grade):
    case = Case(replace(TURNING, imu_grade=grade, seed=seed, yaw=0.0, pitch=0.0), forget=True,
                config=settings(imu__grade=grade), later=14.0)
    a, reasons = case.align(spans=np.empty((0, 2)))
    assert Code.NO_STANDSTILL in {r.code for r in reasons}
    assert a.standstill is None
    assert_allclose(a.gyro_bias_sigma, a.gyro_bias_sigma[0])
    tilt = (a.C_nb.T @ [0, 0, 1.0]) @ case.truth(a.t).T       # up as levelled, in the true n
    # four sigmas in twelve drives of two axes: 1.5e-3 to fail by chance
    assert np.abs(tilt[:2]).max() < 4 * a.level_sigma
    assert a.level_sigma < 0.03


@pytest.mark.parametrize('slope', [0.0, 2e-7])
def test_bias_walk_of_a_warming_gyro_is_taken_from_its_standstills(slope):
    case = Case(TURNING)
    alignment, _ = case.align()
    late = np.clip(case.inputs.t_imu - alignment.t, 0.0, None)
    inputs = replace(case.inputs, w_b=case.inputs.w_b + slope * late[:, None])
    epochs = attitude_of(inputs, case.origin, alignment.t, alignment.q_nb, alignment.gyro_bias)
    later = case.spans[case.spans[:, 0] > alignment.t]
    assert len(later) > 1
    observed = with_observed_walk(alignment, inputs, case.spans, epochs, case.origin.earth_rate_n)
    # the heading of a course has an error, and with it the Earth rate
    walk = slope * np.sqrt(np.median(later.mean(axis=1) - alignment.t))
    assert observed.gyro_bias_walk == pytest.approx(max(walk, alignment.gyro_bias_walk), rel=0.1)
    if slope:
        assert walk > 10 * alignment.gyro_bias_walk
    unknown = with_observed_walk(replace(alignment, standstill=None), inputs, case.spans, epochs,
                             case.origin.earth_rate_n)
    assert unknown.gyro_bias_walk == alignment.gyro_bias_walk


def test_an_imu_configured_with_a_better_grade_has_sigmas_of_its_noise():
    noisy = replace(PLAIN, imu_grade='consumer')
    alignment, _ = Case(noisy, settings(imu__grade='tactical')).align()
    consumer, _ = Case(noisy, settings(imu__grade='consumer')).align()
    grade = GRADES['consumer']
    assert alignment.gyro_bias_walk == consumer.gyro_bias_walk == grade.gyro_bias_walk
    assert alignment.gyro_scale_sigma == grade.gyro_scale_sigma
    assert alignment.gyro_axes_sigma == pytest.approx(np.sqrt(2) * grade.misalignment_sigma)
    # sold with a bias of 25 mg
    assert consumer.level_sigma == pytest.approx(
        np.hypot(25e-3, np.sqrt(2) * grade.misalignment_sigma), rel=0.01)


@pytest.mark.parametrize('rows', [2, 3])
def test_an_imu_without_rows_after_the_mark_is_still_aligned(rows):
    plain = Case(PLAIN)
    keep = plain.inputs.t_imu < 0
    keep[:np.flatnonzero(keep)[-rows]] = False
    short = {name: getattr(plain.inputs, name)[keep]
             for name in ('t_imu', 'w_b', 'f_b', 'q_ni', 'yaw_variance')}
    a, reasons = plain.align(spans=np.empty((0, 2)), **short)
    assert np.isfinite(a.C_nb).all()
    assert Code.NO_STANDSTILL in {r.code for r in reasons}
