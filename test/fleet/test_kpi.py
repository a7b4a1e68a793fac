# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal fleet: --kpi, changes of a vehicle by the normal law, and remarks."""

from datetime import datetime, UTC
import json
import math
from statistics import NormalDist

import numpy as np
import pytest

from odocal_ros.fleet.kpi import kpi, MIN_LEGS
from odocal_ros.fleet.page import remarks
from odocal_ros.fleet.statistics import covariance, history, MODEL_OUTLIER_SIGMAS, population
from odocal_ros.fleet.tables import VALUES
from odocal_ros.offline.cli import main

pytestmark = pytest.mark.slow
LIMITS = {'scale_ratio': (0.99, 1.01)}
NONE = {f'{name}{part}': None for name in VALUES for part in ('', '_sigma')}
N = 10
DAYS = 7.0 * np.arange(N)
V = covariance(np.full(N, 1e-5**2), [], DAYS, 1e-4)      # dominated by the walk: 265 ppm in a week


def row(vehicle, value, sigma, **more):
    return {'vehicle': vehicle, 'verdict': 'accepted', **NONE, 'scale_ratio': value,
            'scale_ratio_sigma': sigma} | more


def leg(vehicle, value, sigma=1e-3, minutes=1.0, period=1, **more):
    return row(vehicle, value, sigma, duration_s=60 * minutes, period=period, **more)


def test_rates_agree_with_a_manual_count():
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


def test_rates_use_only_the_legs_since_the_last_change():
    legs = [leg('a', 1.02, period=1)] * 4 + [leg('a', 1.0, period=2)] * MIN_LEGS
    found = kpi([row('a', 1.0, 1e-4)], legs, LIMITS)['all']
    assert (found['legs'], found['recall']) == (MIN_LEGS, 1.0)


def test_a_vehicle_that_drifts_across_the_limit_is_on_the_limit():
    """Its last result is outside the limit; half of its drives are inside."""
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


def test_the_command_writes_the_kpi(fleet, tmp_path, capsys):
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


def drawn(rng):
    return np.linalg.cholesky(V) @ rng.standard_normal(N)


def test_false_changes_and_outliers_have_the_stated_rate():
    rng = np.random.default_rng(4)
    found = [history(drawn(rng), V) for _ in range(2000)]
    # one in 1000 at most, by Bonferroni: 2 of 2000, and 3 sigma of that count
    assert sum(bool(h.changes or h.outliers) for h in found) <= 2 + 3 * 2**0.5


def test_a_change_is_found_at_its_leg_with_a_correct_sigma():
    rng, off = np.random.default_rng(5), []
    for k in range(300):
        leg = 1 + k % (N - 1)
        change, = history(drawn(rng) + 0.005 * (np.arange(N) >= leg), V).changes
        assert change.leg == leg
        off.append((change.size - 0.005) / change.sigma)
        # uncertainty of a step between adjacent legs of a random walk: the walk of a week
        assert change.sigma == pytest.approx(np.hypot(1e-4 * 7**0.5, 2**0.5 * 1e-5), rel=0.03)
    assert abs(np.mean(off)) < 3 / 300**0.5
    assert abs(np.std(off) - 1) < 3 / 600**0.5


def test_two_changes_and_an_outlier_leg_are_distinguished():
    y = 0.004 * (np.arange(N) >= 3) - 0.006 * (np.arange(N) >= 7) + 0.02 * (np.arange(N) == 5)
    found = history(y, V)
    assert [(c.leg, round(c.size, 4)) for c in found.changes] == [(3, 0.004), (7, -0.006)]
    assert found.outliers == (5,)
    # the last leg may be a change: no leg follows that shows it as an outlier
    assert history(0.02 * (np.arange(N) == N - 1), V).changes[0].leg == N - 1


def test_an_error_shared_by_all_legs_does_not_affect_a_change():
    """It changes the level and no step: an error common to all legs cancels exactly."""
    variances = np.full(N, 1e-5**2)
    y = 2e-4 * (np.arange(N) >= 4)
    alone, = history(y, covariance(variances)).changes
    shared, = history(y, covariance(variances, [np.full((N, 1), 1e-2)])).changes
    assert shared.sigma == pytest.approx(alone.sigma, rel=1e-6)
    # the mean of 4 against that of 6
    assert alone.sigma == pytest.approx(1e-5 * (1 / 4 + 1 / 6)**0.5, rel=1e-12)
    # an error of half of the legs only may be the step
    half = np.where(np.arange(N) >= 4, 1e-2, 0.0)[:, None]
    assert history(y, covariance(variances, [half])).changes == ()


def test_the_slope_of_a_drift_has_the_sigma_of_the_regression():
    variances = np.full(N, 1e-5**2)
    t = DAYS / 365.25
    found = history(1e-3 * t, covariance(variances), t)
    assert found.slope == pytest.approx(1e-3, rel=1e-9)
    assert found.slope_sigma == pytest.approx(1e-5 / np.sqrt(((t - t.mean())**2).sum()), rel=1e-9)


def test_population_describes_most_vehicles_and_lists_the_outliers():
    rng = np.random.default_rng(6)
    means, spreads = [], []
    for _ in range(60):
        sigma = rng.uniform(0.2, 1.0, 60)
        x = 5 + np.hypot(sigma, 1.0) * rng.standard_normal(60)
        x[:2] = 40.0
        found = population(x, sigma)
        outliers = np.flatnonzero(np.abs(found.deviates) > MODEL_OUTLIER_SIGMAS)
        assert {0, 1} <= set(outliers)
        assert len(outliers) <= 3           # 4 sigma: one of 16,000 by chance
        means.append((found.mean - 5) / found.sigma)
        spreads.append(found.spread)
    assert MODEL_OUTLIER_SIGMAS == 4
    # Huber's mean yields to 2 of 60 by HUBER * 2 / 60 of a spread, 0.4 of its sigma
    assert abs(np.mean(means)) < 0.4 + 3 / 60**0.5
    assert abs(np.std(means) - 1) < 3 / 120**0.5
    # the median of |x| has 2 of 60 more above it: 5 % wider; a draw scatters by 0.18
    assert np.mean(spreads) == pytest.approx(1.05, abs=3 * 0.18 / 60**0.5)
    few = population(np.array([1.0, 9.0]), np.array([0.1, 0.1]))
    assert np.isnan(few.deviates).all()


def test_rejected_legs_are_stated_once():
    legs = {'decision': 'UNDECIDED', 'changes': '[]', 'outlier': '', 'odd_legs': '', 'legs': 4,
            'legs_good': 2, 'rejected_for': 'ODOMETER_STILL', 'bags_failed': 0,
            'rejected_since': datetime(2025, 6, 29, tzinfo=UTC)}
    why = 'rejected: ODOMETER_STILL: the last 2 legs, since 2025-06-29, are all rejected'
    assert remarks(legs | {'why': why}) == ['UNDECIDED', why]
    assert remarks(legs | {'why': ''})[1] == (
        '2 of 4 legs rejected (ODOMETER_STILL), all since 2025-06-29')
