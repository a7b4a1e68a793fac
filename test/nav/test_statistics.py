# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sigmas by a median are those of the normal law; the runs of a mask."""

import numpy as np
import pytest
from scipy.stats import norm, rayleigh

from odocal_ros.data.pieces import runs
from odocal_ros.nav.statistics import NORMAL_MEDIAN, RAYLEIGH_MEDIAN, robust_sigma


def test_the_medians_are_those_of_the_distributions():
    assert pytest.approx(norm.ppf(0.75), abs=1e-4) == NORMAL_MEDIAN
    assert pytest.approx(rayleigh.median(), abs=1e-4) == RAYLEIGH_MEDIAN


def test_a_tenth_of_wild_values_changes_little():
    x = np.random.default_rng(1).normal(0.0, 0.3, 30_000)
    # of 30,000 values a median is known to 0.8 %: three sigmas
    assert robust_sigma(x) == pytest.approx(0.3, rel=0.024)
    x[::10] = 1e6
    assert robust_sigma(x) < 0.36


def test_runs_are_the_begin_and_the_end_of_each():
    flags = np.array([True, True, False, False, True, False, True])
    assert runs(flags).tolist() == [[0, 2], [4, 5], [6, 7]]
    assert runs(np.zeros(3, bool)).shape == (0, 2)
    assert runs(np.zeros(0, bool)).shape == (0, 2)
    assert runs(np.ones(3, bool)).tolist() == [[0, 3]]
