# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs too short to show slow errors of the fixes: the sigma holds them all the same."""

from dataclasses import replace
import re

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.estimator import smooth
from odocal_ros.sim.real import Real

pytestmark = pytest.mark.slow
WINDOW, WINDOWS = 45.0, 6      # s, of one drive
TOWN = {'scenario': 'town', 'duration': 420.0, 'imu_grade': 'consumer', 'seed': 3}


def results(noise):
    """Return the smoother's results of a drive's windows, and the truth."""
    drive, config, leg = made(**TOWN, fix_noise=noise)
    begins = 20.0 + WINDOW * np.arange(WINDOWS)
    return drive.truth, [smooth(replace(leg, t_begin=begin, t_stop=begin + WINDOW), config)
                         for begin in begins]


def test_slow_errors_are_in_the_sigma_of_scale_and_pitch():
    truth, found = results('correlated')
    for name, true in (('scale_factor', truth.scale), ('pitch_mounting_angle', truth.pitch)):
        out = [(e.value - true) / e.sigma for e in (r.estimates[name] for r in found)]
        # chi2 of 6, 1 in 1000; taken for white they are some 5 sigmas off each
        assert np.square(out).sum() < 22.5


def test_a_slow_error_is_believed_of_white_fixes_too():
    truth, found = results('white')
    for name, true in (('scale_factor', truth.scale), ('pitch_mounting_angle', truth.pitch)):
        out = [(e.value - true) / e.sigma for e in (r.estimates[name] for r in found)]
        assert np.square(out).sum() < 22.5
    for noise in (r.details['noise'] for r in found):
        # of 450 values 3 sigmas of their rms; of the slow error 45 s tell little: not more of it
        # than the receiver states
        assert noise['fix'] == pytest.approx(1.0, abs=0.1)
        assert 0.0 < noise['slow'] < 1.5
        assert noise['correlation_time'] > 0


@pytest.mark.parametrize('stated', [0.5, 2.0])
def test_white_noise_is_what_fixes_show_whatever_the_receiver_says(stated):
    _, config, leg = made(**TOWN, fix_noise='white')
    one, other = (smooth(replace(leg, t_begin=20.0, t_stop=20.0 + WINDOW,
                                 covariance_n=leg.covariance_n * by**2), config)
                  for by in (1.0, stated))
    white = [r.details['noise']['fix'] for r in (one, other)]
    assert white[1] * stated == pytest.approx(white[0], rel=0.05)
    # the slow error's first level counts as one value, beside six 45 s apart at most
    assert other.estimates['scale_factor'].sigma == pytest.approx(
        one.estimates['scale_factor'].sigma, rel=0.25)


def test_a_slow_error_too_small_to_be_seen_is_in_the_sigma_of_the_scale():
    out = []
    for seed in range(1, 7):
        # 2 % of the variance of white fixes
        drive, config, leg = made(**TOWN | {'duration': 300.0, 'seed': seed},
                                  real=Real(slow_errors=((0.21, 60.0),)))
        found = smooth(leg, config)
        assert found.details['noise']['correlation_time'] > 0
        scale = found.estimates['scale_factor']
        out.append((scale.value - drive.truth.scale) / scale.sigma)
    # chi2 of 6, 1 in 100 either way; taken for white it is 20.6
    assert 0.87 < np.square(out).sum() < 16.8


@pytest.mark.filterwarnings('error')
def test_fixes_where_the_imu_is_silent_are_none():
    """Of no fix there is no median: numpy warned of it on the node's terminal."""
    _, config, leg = made(**TOWN)
    imu, fix = leg.t_imu < 60.0, leg.t_fix > 100.0
    leg = replace(leg, t_begin=30.0, t_imu=leg.t_imu[imu], f_b=leg.f_b[imu], w_b=leg.w_b[imu],
                  t_fix=leg.t_fix[fix], fixes_n=leg.fixes_n[fix],
                  covariance_n=leg.covariance_n[fix])
    (reason,) = smooth(leg, config).reasons
    assert reason.text.startswith('0 fixes and ')
    assert re.search(r' (29\.9|30\.0) s of data; the smoother needs', reason.text)
