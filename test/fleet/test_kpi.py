# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal fleet --kpi: rates counted by hand, and by the normal law of drawn legs."""

import json
import math
from statistics import NormalDist

import numpy as np
import pytest

from odocal_ros.fleet.kpi import FEWEST, kpi
from odocal_ros.fleet.tables import VALUES
from odocal_ros.offline.cli import main

pytestmark = pytest.mark.slow
LIMITS = {'scale_ratio': (0.99, 1.01)}
NONE = {f'{name}{part}': None for name in VALUES for part in ('', '_sigma')}


def row(vehicle, value, sigma, **more):
    return {'vehicle': vehicle, 'verdict': 'accepted', **NONE, 'scale_ratio': value,
            'scale_ratio_sigma': sigma} | more


def leg(vehicle, value, sigma=1e-3, minutes=1.0, period=1, **more):
    return row(vehicle, value, sigma, duration_s=60 * minutes, period=period, **more)


def test_rates_are_those_counted_by_hand():
    vehicles = [row('good', 1.0, 1e-4), row('bad', 1.02, 1e-4), row('edge', 1.01, 1e-4),
                row('few', 1.0, 1e-4)]
    legs = [leg('good', 1.0), leg('good', 1.001), leg('good', 1.02), leg('good', 1.009),
            leg('good', 1.0, verdict='rejected'), leg('bad', 1.02), leg('bad', 1.02),
            leg('bad', 1.02), leg('bad', 1.0, minutes=4), leg('bad', None, None),
            *[leg('edge', 1.0)] * 3, leg('few', 1.0)]
    found = kpi(vehicles, legs, LIMITS)
    assert found['vehicles'] == {'good': 1, 'bad': 1, 'on_the_limit': 2}
    whole = found['all']
    assert (whole['legs_of_good'], whole['legs_of_bad']) == (5, 5)
    assert whole['precision'] == pytest.approx(2 / 3)
    assert whole['recall'] == pytest.approx(2 / 5)
    assert whole['false_accept'] == pytest.approx(1 / 5)
    assert whole['false_reject'] == pytest.approx(1 / 5)
    assert whole['undecided'] == pytest.approx(3 / 10)
    assert [(one['up_to'], one['legs']) for one in found['by_minutes']] == [(2.0, 9), (5.0, 1)]
    assert found['by_minutes'][1]['false_accept'] == 1.0


def test_only_the_legs_since_the_last_change_count():
    legs = [leg('a', 1.02, period=1)] * 4 + [leg('a', 1.0, period=2)] * FEWEST
    found = kpi([row('a', 1.0, 1e-4)], legs, LIMITS)['all']
    assert (found['legs'], found['recall']) == (FEWEST, 1.0)


def test_a_vehicle_that_wanders_across_the_limit_is_on_it():
    """Its last result is surely bad; half of its drives were not."""
    legs = [leg('a', value, 1e-5) for value in (1.0097, 1.0098, 1.0102, 1.0103)]
    found = kpi([row('a', 1.0103, 2e-5)], legs, LIMITS)
    assert found['vehicles'] == {'good': 0, 'bad': 0, 'on_the_limit': 1}
    steady = [leg('a', 1.0103, 1e-5)] * 4
    assert kpi([row('a', 1.0103, 2e-5)], steady, LIMITS)['vehicles']['bad'] == 1


def test_drawn_legs_have_the_rates_of_the_normal_law():
    """A vehicle 3 sigma within its limit, one 1 sigma beyond; legs drawn for each."""
    rng, sigma, n = np.random.default_rng(1), 1e-3, 20000
    truth = {'good': 1.01 - 3 * sigma, 'bad': 1.01 + sigma}
    vehicles = [row(name, value, sigma / math.sqrt(n)) for name, value in truth.items()]
    legs = [leg(name, float(value), sigma) for name, middle in truth.items()
            for value in rng.normal(middle, sigma, n)]
    found = kpi(vehicles, legs, LIMITS)['all']
    # binomial: 4 sigma of n draws
    share = NormalDist().cdf
    assert found['recall'] == pytest.approx(share(1), abs=4 * 0.5 / math.sqrt(n))
    assert found['false_accept'] == pytest.approx(share(-3), abs=4 * math.sqrt(0.0014 / n))


def test_the_command_writes_them(fleet, tmp_path, capsys):
    command = ['fleet', fleet.manifest, '--output', str(tmp_path / 'out'), '--method',
               'two_point', '--workers', '1', '--reports', 'none', '--kpi']
    assert main(command) == 2
    assert '--accept' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
    main([*command, '--accept', 'scale_ratio=0.9:1.1'])
    out = capsys.readouterr().out
    found = json.loads((tmp_path / 'out' / 'kpi.json').read_text())
    assert found['limits'] == {'scale_ratio': [0.9, 1.1]}
    assert sum(found['vehicles'].values()) == len(fleet.truth)
    assert f'written: {tmp_path / "out" / "kpi.json"}' in out
