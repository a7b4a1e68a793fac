# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Data of the report plots: residuals by direction, scale by section, excluded fixes."""

from dataclasses import replace

import numpy as np
import pytest

from odocal_ros.calib.evidence import KEPT_ROWS, make_evidence
from odocal_ros.calib.marks import MarkFix
from odocal_ros.calib.scale_variation import sections
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import FixSamples
from odocal_ros.nav.dead_reckoning import dead_reckon
from odocal_ros.nav.odometer import Travel
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
START_NS = 1_700_000_000_000_000_000
END = 100.0                                  # s; 10 m/s, east for half of it, then north


def path_n(t):
    """Return a drive at 10 m/s: at rest for 10 s, east until t = 60, then north: (n, 3)."""
    s = 10.0 * np.clip(t - 10.0, 0.0, None)
    return np.stack([np.minimum(s, 500.0), np.maximum(s - 500.0, 0.0), 0.0 * t], -1)


def drive(off=(0.0, 0.0), bad=(), sigma=0.5, config=None, set_ns=0, **streams):
    """Return evidence of that drive; fixes are ``off`` to the east and north of the path."""
    config = config or Config()
    t = np.arange(0.0, END, 0.02)
    yaw = np.where(t < 60.0, 0.0, np.pi / 2)
    q_nb = np.stack([0 * t, 0 * t, np.sin(yaw / 2), np.cos(yaw / 2)], -1)
    track = dead_reckon(t, q_nb, Travel(t, 10.0 * np.clip(t - 10.0, 0.0, None), 0.0))
    t_fix = np.arange(0.0, END, 0.2)
    n = len(t_fix)
    status = np.zeros(n, int)
    covariance = np.tile(np.eye(3) * sigma**2, (n, 1, 1))
    for row, what in bad:
        status[row] = -1 if what == 'status' else status[row]
        covariance[row] *= {'sigma': 100.0**2, 'negative': -1.0}.get(what, 1.0)
    stamp = START_NS + np.round(t_fix * 1e9).astype(np.int64)
    sent = stamp + set_ns * (t_fix > END / 2)
    fix = FixSamples(sent, stamp, np.full(n, 0.8), np.full(n, 0.1), np.zeros(n), covariance,
                     np.full(n, 2), status)
    leg = Leg(START_NS, START_NS + round(END * 1e9), fix=fix)
    inputs, _ = screen(leg, config)
    inputs = replace(inputs, **streams)
    fixes_n = path_n(inputs.t_fix) + [*off, 0.0]
    kept = np.ones(len(inputs.t_fix), bool)
    kept[[row for row, what in bad if what == 'far']] = False
    anchor = MarkFix(0.0, np.zeros(3), np.eye(3), True, 1)
    return make_evidence(leg, inputs, track, fixes_n, kept, anchor,
                         (lambda t: 1.1 * path_n(t) + 7.0, lambda t: path_n(t) - 3.0), config)


def test_residuals_are_split_by_the_direction_of_travel():
    found = drive(off=(2.0, 1.0))            # the track is 2 m west and 1 m south of the fixes
    east = (found.t_fix > 12) & (found.t_fix < 58)
    north = (found.t_fix > 62) & (found.t_fix < 98)
    np.testing.assert_allclose(found.residual[east], [[-2.0, -1.0]] * east.sum(), atol=1e-9)
    np.testing.assert_allclose(found.residual[north], [[-1.0, 2.0]] * north.sum(), atol=1e-9)
    # as configured the scale is 10 % too large: error of 0.1 of the path length along the path
    late = found.t_fix > 62
    np.testing.assert_allclose(found.residual_before[late, 0],
                               -1.0 + 0.1 * (10.0 * (found.t_fix[late] - 10) - 500), atol=1e-9)


def test_path_length_speed_and_turn_rate():
    found = drive()
    assert found.distance[-1] == pytest.approx(10.0 * (found.t[-1] - 10.0), rel=1e-12)
    steady = (found.t > 12) & (found.t < 58)
    np.testing.assert_allclose(found.speed[steady], 10.0, rtol=1e-12)
    np.testing.assert_allclose(found.speed[found.t < 9], 0.0, atol=1e-12)
    assert found.yaw_rate.sum() * 0.02 == pytest.approx(np.pi / 2, rel=0.001)
    np.testing.assert_allclose(found.yaw_rate[steady], 0.0, atol=1e-12)
    assert len(found.t) <= KEPT_ROWS
    assert found.t[[0, -1]] == pytest.approx([0.0, 99.98])      # decimated, both ends kept


def test_excluded_fixes_are_named_with_the_reason():
    found = drive(bad=((3, 'status'), (5, 'sigma')))
    assert found.excluded == 2
    np.testing.assert_allclose(found.t_excluded, [0.6, 1.0])
    assert found.excluded_because == ('status below 0', 'sigma above 3 m')
    assert found.fixes == 498
    assert drive(bad=((7, 'far'),)).excluded_because == ('far off the track',)


def straight(path):
    return np.outer(path, [1.0, 0.0, 0.0])


def test_section_scale_is_independent_of_the_heading():
    path = np.arange(0.0, 1000.0, 2.0)
    z = straight(path) + np.outer(30 * np.sin(path / 80), [0.0, 1.0, 0.0])
    turn = np.array([[np.cos(1.0), -np.sin(1.0), 0], [np.sin(1.0), np.cos(1.0), 0], [0, 0, 1]])
    found = sections(path, z, 1.003 * z @ turn.T + [5.0, 6.0, 7.0], np.full(len(path), 0.02))
    np.testing.assert_allclose(found.ratio, 1.003, rtol=1e-9)
    np.testing.assert_allclose([found.begin[0], found.end[-1]], [0.0, 998.0])
    # closed form of a straight line through n points: sigma sqrt(12 / n) / length; with 100
    # residuals per section and ten sections the median is accurate to some per cent
    z = straight(path)
    noisy = z + np.random.default_rng(1).normal(0.0, 0.02, z.shape)
    found = sections(path, z, noisy, np.full(len(path), 1.0))
    assert np.median(found.sigma) == pytest.approx(0.02 * np.sqrt(12 / 50) / 100, rel=0.1)
    # fixes without error: the lower limit is a hundredth of the stated sigma
    found = sections(path, z, z, np.full(len(path), 2.0))
    assert (found.sigma >= 0.99 * 0.02 * np.sqrt(12 / 50) / 100).all()


@pytest.mark.parametrize(('memory', 'white'), [(0.0, 0.0), (0.8, 0.0), (0.95, 0.0), (0.95, 1.0)])
def test_sigma_of_a_section_holds(memory, white):
    # first-order process of 1 m plus white noise; 100 drives of 10 sections of 60 fixes
    rng = np.random.default_rng(20261101)
    path = np.arange(0.0, 6000.0, 10.0)
    z, pulls = straight(path), []
    root = np.linalg.cholesky(memory**(np.abs(np.subtract.outer(path, path)) / 10.0))
    for _ in range(100):
        noise = root @ rng.standard_normal((len(path), 2))
        noise += white * rng.standard_normal(noise.shape)
        found = sections(path, z, z + np.pad(noise, ((0, 0), (0, 1))), np.full(len(path), 3.0))
        pulls += list((found.ratio - 1.0) / found.sigma)
    # 1000 pulls: 2.2 % statistical error. The process is estimated from one drive, where 600
    # fixes with memory 0.95 count as 15: sqrt(1 / (2 * 2 * 15)) = 13 % of its sigma. The longer
    # of two memories is used: error bars may be too long by a half, but not too short
    assert 0.6 < np.std(pulls) < 1.2
    assert abs(np.mean(pulls)) < 0.1


def test_undetermined_section_scale_is_nan_and_too_few_fixes_give_no_sections():
    path = np.linspace(0.0, 200.0, 20)
    z = straight(path)
    for n in (0, 5):
        assert len(sections(path[:n], z[:n], z[:n], np.ones(n)).ratio) == 0
    with np.errstate(all='raise'):      # a path without motion
        assert np.isnan(sections(path, 0 * z, z, np.ones(20)).ratio).all()
    found = sections(path, z, z, np.full(20, 5e4))
    assert len(found.ratio) == 2
    assert np.isnan(found.ratio).all()


@pytest.mark.filterwarnings('error')
def test_negative_variance_of_a_fix_causes_no_warning():
    assert drive(bad=[(7, 'negative')]).fixes == drive().fixes


def test_gaps_of_imu_and_odometer_are_kept_if_the_vehicle_moves():
    t = np.arange(0.0, END, 0.02)
    imu = t[(t <= 30.0) | (t >= 32.0)]
    rows = t[((t < 3.0) | (t >= 8.0)) & ((t <= 70.0) | (t >= 71.0))]     # at rest until t = 10
    found = drive(t_imu=imu, travel=Travel(rows, 10.0 * np.clip(rows - 10.0, 0.0, None), 0.0))
    assert [name for name, _, _ in found.gaps] == ['IMU', 'odometer']
    np.testing.assert_allclose([gap[1:] for gap in found.gaps], [(30.0, 32.0), (70.0, 71.0)],
                               atol=0.021)
    assert drive(t_imu=t, travel=Travel(t, t, 0.0)).gaps == ()


def test_clock_offsets_and_clock_steps_are_applied():
    config = with_settings(Config(), {'gnss.time_offset': 0.1, 'imu.time_offset': 0.03})
    found = drive(bad=((3, 'status'),), config=config)
    np.testing.assert_allclose(found.t_excluded, [0.67])
    np.testing.assert_allclose(found.t_fix[:2], [0.07, 0.27])
    alone, moved = drive(), drive(set_ns=10**9)
    np.testing.assert_allclose(moved.t_fix, alone.t_fix, atol=1e-6)
    np.testing.assert_array_equal(moved.fix_status, alone.fix_status)
    assert moved.excluded == alone.excluded == 0
