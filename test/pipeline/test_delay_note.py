# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A delay of a sensor is said with the setting that takes it out, where it matters."""

import re
from types import SimpleNamespace

from drives import drive, everything_said, settings
import numpy as np
import pytest

from odocal_ros.nav.odometer import Travel
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.pipeline.delay_note import delay_notes
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config

pytestmark = pytest.mark.slow
ROUTE = {'scenario': 'town', 'duration': 180.0, 'seed': 6, 'two_wheels': True}
SAID = re.compile(r'(\w+) stamps are ([\d.]+) s \(\+-([\d.]+) s\) (late|early).*? '
                  r'set (gnss|odometer)\.time_offset to (-?[\d.]+)')


def said(made, method, **changes):
    """Return what is said of a delay: (sensor, seconds late, sigma, setting, its value)."""
    result = calibrate(made.leg(), settings(made, method=method, heading_sigma=None, **changes))
    text = everything_said(result).get(Code.DELAY_SEEN)
    if text is None:
        return None
    what, size, sigma, way, name, offset = SAID.search(text).groups()
    return what, float(size) * (1 if way == 'late' else -1), float(sigma), name, float(offset)


@pytest.mark.parametrize('late', [0.12, -0.12])
def test_late_and_early_fixes_are_said(late):
    made = drive(**ROUTE, fix_delay=late)
    what, size, sigma, name, offset = said(made, 'smoother')
    assert (what, name) == ('fix', 'gnss')
    # a belief of 50 ms (gnss.time_sigma) pulls it towards none by (sigma / prior)^2 of itself
    pull = abs(late) * (sigma / 0.05)**2
    assert abs(size - late) < 4 * sigma + pull + 0.001
    assert offset == pytest.approx(-size, abs=0.001)
    assert said(made, 'smoother', gnss__time_offset=offset) is None


def test_a_late_odometer_is_said():
    made = drive(**ROUTE, odometer_delay=0.04, fix_noise='rtk')
    what, size, sigma, name, offset = said(made, 'smoother')
    assert (what, name) == ('odometer', 'odometer')
    assert abs(size - 0.04) < 4 * sigma + 0.04 * (sigma / 0.01)**2 + 0.001
    assert said(made, 'smoother', odometer__time_offset=offset) is None


def test_what_is_set_already_is_counted_in():
    made = drive(**ROUTE, fix_delay=0.12)
    *_, offset = said(made, 'smoother', gnss__time_offset=0.05)
    assert said(made, 'smoother', gnss__time_offset=offset) is None


def test_of_no_delay_nothing_is_said():
    assert said(drive(**ROUTE), 'smoother') is None


@pytest.mark.parametrize(('late', 'sigma', 'fix_sigma', 'is_said'), [
    (0.02, 0.005, 0.02, True),       # 0.2 m at 10 m/s, 4 sigmas
    (0.02, 0.008, 0.02, False),      # 2.5 sigmas
    (-0.009, 0.001, 0.02, False),    # 9 cm: a lever arm need not be known better
    (0.02, 0.005, 1.5, False),       # fixes of 1.5 m do not show 0.2 m
    (-0.04, 0.005, 1.5, True)])
def test_it_must_be_there_and_matter(late, sigma, fix_sigma, is_said):
    t = np.arange(0.0, 60.0, 0.1)
    run = SimpleNamespace(config=Config(), fix_sigma=fix_sigma, inputs=SimpleNamespace(
        travel=Travel(t, 20.0 * t, 0.0), t_stop=60.0))       # 10 m/s
    assert bool(delay_notes(run, {'gnss': (late, sigma)}, scale=0.5)) == is_said


def test_one_method_says_it_once():
    made = drive(**ROUTE, fix_delay=0.12)
    result = calibrate(made.leg(), settings(made, method='all', heading_sigma=None))
    assert [r.code for r in result.reasons].count(Code.DELAY_SEEN) == 1
