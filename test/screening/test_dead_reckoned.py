# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fixes that a receiver reckons in a tunnel are found, and no measured ones."""

from drives import configured
import numpy as np
import pytest

from odocal_ros.reasons import Code
from odocal_ros.screening.fix_screen import reckoned
from odocal_ros.screening.screen import screen
from odocal_ros.sim.noise import stream
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real import Real
from odocal_ros.sim.scenarios import simulate

pytestmark = pytest.mark.core
at_s = np.arange(0.0, 400.0, 1.0)


def turned(t):
    """Return the angle of a drive on a winding road, rad."""
    return 0.8 * np.sin(0.03 * np.asarray(t))


def drive(sigma, tunnel, scale=0.02):
    """Return what a receiver sends at 15 m/s: (n, 3) m; in the tunnel by its own odometer."""
    fine = np.arange(0.0, 400.0, 0.01)
    path = np.cumsum(15 * 0.01 * np.exp(1j * turned(fine)))
    true = np.interp(at_s, fine, path.real) + 1j * np.interp(at_s, fine, path.imag)
    noise = sigma * stream(3, 'fixes').standard_normal((len(at_s), 2)) @ [1, 1j]
    inside = (at_s >= tunnel[0]) & (at_s < tunnel[1])
    if inside.any():
        begin = np.flatnonzero(inside)[0]
        noise[inside] = noise[begin] + scale * (true[inside] - true[begin])
    place = true + noise
    return np.stack([place.real, place.imag, 0 * place.real], -1)


@pytest.mark.parametrize('length', [20, 60, 120])
@pytest.mark.parametrize('sigma', [0.05, 0.5])
def test_a_tunnel_is_found_with_its_ends(sigma, length):
    begin = 150.0
    found, why = reckoned(at_s, drive(sigma, (begin, begin + length)), 15 * at_s, turned)
    inside = (at_s >= begin) & (at_s < begin + length)
    assert [r.code for r in why] == [Code.FIXES_DEAD_RECKONED]
    assert f'to {begin + length - 1:.0f} s' in why[0].text
    # the window holds three rows of noise at most
    assert not found[at_s < begin - 5].any()
    assert not found[at_s >= begin + length].any()
    assert found[inside].mean() > 0.8


@pytest.mark.parametrize('sigma', [0.01, 0.05, 0.5])
def test_noise_and_a_wrong_fix_are_none(sigma):
    fixes = drive(sigma, (0, 0))
    fixes[200:230, 0] += 20.0          # a false fix, and back
    found, why = reckoned(at_s, fixes, 15 * at_s, turned)
    assert not found.any()
    assert not why


def test_fixes_of_a_tunnel_are_not_used_and_said():
    real = Real(tunnels=((120.0, 60.0),), tunnel_odometer=0.02)
    made = simulate(SimOptions(scenario='motorway', duration=300.0, imu_grade='industrial',
                               imu_rate=50.0, real=real))
    inputs, reasons = screen(made.leg(), configured(made))
    off = (made.truth.start_ns - made.imu.stamp_ns[0]) * 1e-9
    said = [r for r in reasons if r.code is Code.FIXES_DEAD_RECKONED]
    assert len(said) == 1
    inside = (inputs.t_fix > 125.0 - off) & (inputs.t_fix < 175.0 - off)
    assert not inside.any()
    assert inputs.fixes_rejected == len(made.fix.stamp_ns) - len(inputs.t_fix)
