# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Fixes that go astray for a while and come back: found, left out, said, and no other is bad."""

from dataclasses import replace
import math
import re

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.calib.smoother.astray import _stretches
from odocal_ros.calib.smoother.smoother import smooth
from odocal_ros.reasons import Code

ESTIMATES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')


@pytest.mark.parametrize(('levels', 'expected'), [
    ({10: 5.0, 20: 0.0}, [(10, 20)]),
    ({10: 5.0}, []),                                        # is there to stay
    ({10: 5.0, 20: 10.0}, []),                              # a staircase
    ({10: 5.0, 200: 0.0}, []),                              # too long to tell which is right
    ({10: 5.0, 30: 0.0, 50: -5.0, 60: 0.0}, [(50, 60), (10, 30)]),     # between them all is well
    ({10: 5.0, 20: 14.0, 26: 6.0, 40: 0.0}, [(20, 26), (10, 40)])])    # one in another
def test_what_jumps_and_is_back_is_a_stretch(levels, expected):
    t = np.arange(301.0)
    slow, factor = np.zeros((301, 3)), np.ones(300)
    for at, level in levels.items():
        slow[at:, 0] = level
        factor[at - 1] = 100.0
    found = _stretches(t, slow, factor)
    # from before the jump to after the one back
    assert [(s.begin + 1, s.end) for s in found] == expected


def off(drive, method):
    found = [method.estimates[name] for name in ESTIMATES]
    true = drive.truth.scale, drive.truth.yaw, drive.truth.pitch
    return np.array([(e.value - x) / e.sigma for e, x in zip(found, true, strict=True)])


def seen(leg, which):
    """Return a leg with some of its fixes."""
    return replace(leg, t_fix=leg.t_fix[which], fixes_n=leg.fixes_n[which],
                   covariance_n=leg.covariance_n[which])


def moved(leg, which, by):
    """Return a leg with some of its fixes elsewhere, by m."""
    return replace(leg, fixes_n=leg.fixes_n + np.outer(which, by))


@pytest.mark.parametrize(('fixes', 'by', 'ends'), [
    ('rtk', (0.4, -0.3, 0.6), [(100.0, 160.0)]),                      # wrong whole cycles
    ('white', (9.0, -8.0, 10.0), [(60.0, 68.0), (150.0, 163.0)])])    # multipath
def test_a_leg_is_worth_what_its_other_fixes_are(fixes, by, ends):
    drive, config, leg = made(duration=300.0, imu_grade='industrial', fix_noise=fixes)
    wrong = np.zeros(len(leg.t_fix), bool)
    for begin, end in ends:
        wrong |= (leg.t_fix > begin) & (leg.t_fix < end)
    method, without = (smooth(x, config) for x in (moved(leg, wrong, by), seen(leg, ~wrong)))
    assert np.abs(off(drive, method)).max() < 3.3
    for name in ESTIMATES:
        # a second beside each jump goes too, and a slow error may be thought of: a tenth
        assert method.estimates[name].sigma < 1.1 * without.estimates[name].sigma, name
    said = [r.text for r in method.reasons if r.code is Code.FIXES_ASTRAY]
    assert len(said) == 1
    at = [float(x) for x in re.search(r't = (\d+) to (\d+) s', said[0]).groups()]
    assert any(np.abs(np.subtract(at, end)).max() <= 1.0 for end in ends)
    assert Code.FIXES_ASTRAY not in {r.code for r in without.reasons}


@pytest.mark.parametrize('by', [(0.0, 0.0, 3.0), (2.0, -1.5, 3.0), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize('seconds', [5.0, 60.0])
def test_a_receiver_that_is_elsewhere_after_a_gap_bends_no_track(by, seconds):
    drive, config, leg = made(duration=300.0, imu_grade='industrial', fix_noise='rtk')
    leg = seen(leg, (leg.t_fix < 150.0 - seconds) | (leg.t_fix > 150.0))
    method = smooth(moved(leg, leg.t_fix > 150.0, by), config)
    assert np.abs(off(drive, method)).max() < 3.3
    if not any(by):     # a gap alone is no jump
        assert method.details['noise']['correlation_time'] == 0.0
    elif seconds > 10.0:
        # m: what the fixes wander by in a second; the jump spread over the gap would be 0.3
        noise = method.details['noise']
        assert noise['slow'] / math.sqrt(noise['correlation_time'] / 2) < 0.02
