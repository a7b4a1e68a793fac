# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Each source of the budget equals the effect of the same error on dead reckoning."""

from dataclasses import replace

from drives import changed, drive, settings, shifted, two_point
import numpy as np
import pytest

from odocal_ros.calib.budget import budget, drift_sources, PARAMETERS, Uncertainties
from odocal_ros.calib.marks import MarkFix
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.dead_reckoning import dead_reckon, forward_b, mounting_from_forward
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import exp_so3, matrix_from_quat, matrix_from_rpy, quat_from_matrix
from odocal_ros.nav.strapdown import attitude

pytestmark = pytest.mark.core
K, YAW, PITCH = 0.02, 0.05, -0.03
F = K * forward_b(YAW, PITCH)
C0 = matrix_from_rpy([0.02, -0.01, 0.7])
EARTH = np.zeros(3)      # Earth rotation within the leg is not part of the budget
SMALL = 1e-4             # errors so small that second-order terms are below a part in 1e3


def parameters(f):
    return np.array([np.log(np.linalg.norm(f)), *mounting_from_forward(f)])


class Reckoner:
    """A leg of 300 s with turns and a hill, dead reckoned by the product."""

    def __init__(self):
        self.t = np.arange(0.0, 300.0, 0.05)
        speed = 12.0 * np.clip(self.t / 20, 0, 1) * np.clip((300 - self.t) / 20, 0, 1)
        self.s = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.05)]) / K
        w = np.zeros((len(self.t), 3))
        for at, turn in ((80, 1.2), (150, -0.7), (220, 0.9)):
            w[:, 2] += turn / 8 * ((self.t > at) & (self.t < at + 8))
        w[:, 1] += 0.002 * np.sin(self.t / 30)
        self.w = w

    def track(self, phi_n=(0, 0, 0), w_error=0.0, late=0.0):
        """Return the track with an attitude error, gyro errors and an odometer delay."""
        q = quat_from_matrix(exp_so3(-np.asarray(phi_n, float)) @ C0)
        t, q_nb = attitude(self.t, self.w + w_error, q, EARTH)
        return dead_reckon(t, q_nb, Travel(self.t + late, self.s, 0.0))

    def solve(self, chord_n, off=0.0, **errors):
        """Return (ln K, yaw, pitch) solved from a chord with an error and a track with errors."""
        return parameters(np.linalg.solve(self.track(**errors).P[-1], chord_n + off))


@pytest.fixture(scope='module')
def leg():
    return Reckoner()


@pytest.fixture(scope='module')
def truth(leg):
    """Return the track, the true chord and the parameters solved from them."""
    track = leg.track()
    chord = track.P[-1] @ F
    return track, chord, leg.solve(chord)


def alignment(**figures):
    nothing = {'level_sigma': 0.0, 'heading_sigma': 0.0, 'gyro_bias_sigma': np.zeros(3),
               'gyro_noise': 0.0, 'gyro_bias_walk': 0.0}
    return Alignment(t=0.0, C_nb=np.eye(3), gyro_bias=np.zeros(3), heading_source='heading_topic',
                     heading_shared=True, **(nothing | figures))


def sources(track, *, standing=True, cov=0.0, fix_scale=(1.0, 1.0, 1.0), more=None, **figures):
    sigmas = {'quantum': 0.0, 'time_sigma': 0.0, 'lever_arm_sigma': 0.0,
              'odometer_time_sigma': 0.0} | (more or {})
    velocity_change = sigmas.pop('velocity_change', np.zeros(3))
    marks = [MarkFix(t, np.zeros(3), np.eye(3) * cov, standing, 9)
             for t in (track.t[0], track.t[-1])]
    found = budget(F, track.P[-1], *marks, track.t, track.P @ F, track.q_nb,
                   alignment(**figures), velocity_change,
                   Uncertainties(fix_scale=np.array(fix_scale), **sigmas))
    return {s.name: s for s in found}


def on_axis(leg, axis, about):
    """Return the error of a gyro axis that measures a share of the turn about another axis."""
    w = np.zeros_like(leg.w)
    w[:, axis] = SMALL * leg.w[:, about]
    return {'w_error': w}


CHANGE, ENDS = np.array([3.0, -5.0, 0.2]), np.diag([0.4, 0.4, 0.6])


@pytest.mark.parametrize(('name', 'figures', 'errors', 'tolerance'), [
    ('initial_level', {'level_sigma': SMALL},
     lambda *_: [{'phi_n': axis * SMALL} for axis in C0.T[:2]], 1e-3),
    ('initial_heading', {'heading_sigma': SMALL}, lambda *_: [{'phi_n': [0, 0, SMALL]}], 1e-3),
    *((f'gyro_bias_{axis}', {'gyro_bias_sigma': bias}, lambda *_, b=bias: [{'w_error': b}], 2e-3)
      for axis, bias in zip('xyz', np.eye(3) * 1e-6, strict=True)),
    ('gyro_scale', {'gyro_scale_sigma': SMALL},
     lambda leg, _: [on_axis(leg, i, i) for i in range(3)], 2e-3),
    ('gyro_axes', {'gyro_axes_sigma': SMALL},
     lambda leg, _: [on_axis(leg, i, k) for i in range(3) for k in range(3) if i != k], 2e-3),
    ('odometer_delay', {'more': {'odometer_time_sigma': 0.1}}, lambda *_: [{'late': 0.1}], 0.02),
    *((name, {'cov': 0.04, 'fix_scale': (2.0, 2.0, 3.0)},
       lambda *_: [{'off': e} for e in ENDS], 1e-3) for name in ('fix_start', 'fix_end')),
    ('fix_latency', {'more': {'time_sigma': 0.05, 'velocity_change': CHANGE}},
     lambda *_: [{'off': CHANGE * 0.05}], 1e-3),
    ('antenna_lever_arm', {'more': {'lever_arm_sigma': 0.1}},
     lambda _, C: [{'off': e} for e in (C[-1] - C[0]).T * 0.1], 1e-3)])
def test_budget_column_is_the_effect_of_its_error(leg, truth, name, figures, errors, tolerance):
    track, chord, _ = truth
    effects = sources(track, **figures)[name].effects
    real = np.stack([
        leg.solve(chord, **error) - leg.solve(chord, **{k: np.negative(v)
                                                        for k, v in error.items()})
        for error in errors(leg, matrix_from_quat(track.q_nb))], -1) / 2
    # the sign of a source is arbitrary, because only products enter, but common to its column
    real = real * np.sign((real * effects).sum())
    assert np.abs(effects).max() > 1e-5     # turns at speed make an odometer delay observable
    for found, column in zip(real.T, effects.T, strict=True):
        np.testing.assert_allclose(found, column,
                                   atol=tolerance * np.abs(column).max() + 1e-7 * SMALL)


def test_quantisation_column_equals_two_rounding_errors(truth):
    track, chord, _ = truth
    column = sources(track, more={'quantum': 0.02})['quantisation'].effects[:, 0]
    rng = np.random.default_rng(2)
    rounding = rng.uniform(-0.01, 0.01, (20000, 2))
    sigma = (rounding[:, 0] - rounding[:, 1]).std() / np.linalg.norm(chord)
    assert column[0] == pytest.approx(sigma, rel=0.03)       # 20000 draws: 0.5 %, plus curvature


def test_height_increases_the_earth_radius(truth):
    track, _, _ = truth
    found = sources(track, cov=100.0)['height']
    assert found.effects[0, 0] == pytest.approx(10.0 / 6378137, rel=1e-3)


@pytest.mark.parametrize('name', ['gyro_noise', 'gyro_bias_walk'])
def test_gyro_noise_and_walk_columns_agree_with_monte_carlo(leg, truth, name):
    """
    200 runs: variance within 5 * sqrt(2 / 200) = 50 %; sigmas within 0.71 to 1.22.

    The walk is drawn in b, the budget uses n: both have the same distribution for equal axes.
    """
    density = {'gyro_noise': 1e-4, 'gyro_bias_walk': 2e-6}[name]
    source = sources(truth[0], **{name: density})[name]
    rng, n, dt = np.random.default_rng(3), len(leg.t), 0.05
    _, chord, true = truth
    errors = []
    for _ in range(200):
        white = rng.standard_normal((n, 3))
        w = white * density / np.sqrt(dt) if name == 'gyro_noise' else np.cumsum(
            white * density * np.sqrt(dt), axis=0)
        errors.append(leg.solve(chord, w_error=w) - true)
    ratio = np.std(errors, axis=0) / np.sqrt((source.effects**2).sum(axis=1))
    assert ((ratio[1:] > 0.71) & (ratio[1:] < 1.22)).all(), ratio
    # ln K is affected only by the part along the chord, which the turn of the walk in b changes
    assert 0.6 < ratio[0] < 1.35, ratio


def test_gyro_errors_accumulate_from_the_alignment(leg, truth):
    """A minute of standstill before the leg adds its drift to the whole path."""
    track, _, _ = truth
    t = np.concatenate([np.arange(-60.0, 0.0, 0.05), track.t])
    D = np.concatenate([np.zeros((1200, 3)), track.P @ F])
    q = np.concatenate([np.tile(quat_from_matrix(C0), (1200, 1)), track.q_nb])
    figures = alignment(gyro_bias_sigma=np.full(3, 1e-6))
    whole = drift_sources(t, D, q, figures)['gyro_bias_z']
    part = drift_sources(t[1200:], D[1200:], q[1200:], figures)['gyro_bias_z']
    turned = np.cross(C0[:, 2] * 60.0 * 1e-6, D[-1])
    np.testing.assert_allclose(whole[:, 0] - part[:, 0], turned, rtol=2e-3, atol=1e-6)


class TestWhole:
    """The budget of calibrate() equals the effect of the same errors in a simulated leg."""

    @pytest.fixture
    def made(self):
        return drive(scenario='town', imu_grade='perfect', fix_sigma=0.0, duration=200.0, seed=3,
                     odometer='angle', antenna_lever_arm=(1.0, 0.3, 1.5))

    def solved(self, leg, config, **more):
        e = two_point(leg, config, **more).estimates
        return np.array([np.log(e[p].value) if p == 'scale_factor' else e[p].value
                         for p in PARAMETERS])

    def test_named_sources_sum_to_the_sigma(self, made):
        result = two_point(made.leg(), settings(made))
        total = sum(s.effects @ s.effects.T for s in result.sources)
        for i, p in enumerate(PARAMETERS):
            e = result.estimates[p]
            scale = e.value if p == 'scale_factor' else 1.0
            assert e.sigma / scale == pytest.approx(np.sqrt(total[i, i]))
            by_name = [row[p] for row in result.details['budget'].values()]
            assert np.linalg.norm(by_name) == pytest.approx(e.sigma)
        assert {s.name for s in result.sources if s.shared} == {
            'initial_heading', 'initial_level', 'fix_latency', 'antenna_lever_arm',
            'odometer_delay', 'height', 'gyro_scale', 'gyro_axes'}

    @pytest.mark.parametrize('start', [0.0, 40.0])       # s: start mark at rest, or in motion
    def test_budget_includes_the_odometer_delay_in_a_leg(self, made, start):
        leg, late = shifted(made.leg(), start=start), 40_000_000
        config = settings(made, odometer__time_sigma=late * 1e-9)
        source = next(s for s in two_point(leg, config).sources if s.name == 'odometer_delay')
        after, before = (self.solved(replace(leg, odometer=changed(
            made.odometer, stamp_ns=lambda a, by=by: a + by)), config) for by in (late, -late))
        real, column = (after - before) / 2, source.effects[:, 0]
        np.testing.assert_allclose(real * np.sign(real @ column), column,
                                   atol=0.05 * np.abs(column).max())
