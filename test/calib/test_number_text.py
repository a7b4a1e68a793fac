# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numbers as text: significant digits, one unit beside a limit, changes in per cent."""

import math

import pytest

from odocal_ros.calib import number_text

pytestmark = pytest.mark.core


@pytest.mark.parametrize(('x', 'text'), [
    (0.0, '0'), (1205.3, '1200'), (0.0266, '0.027'), (-3.04, '-3.0'), (2e-6, '2e-06'),
    (math.inf, 'unknown')])
def test_number_has_two_significant_digits(x, text):
    assert number_text.significant(x) == text


@pytest.mark.parametrize(('sigma', 'limit', 'text'), [
    (1205e-6, 1e-3, '1200 ppm; the limit is 1000 ppm'),
    (1004e-6, 1e-3, '1004 ppm; the limit is 1000 ppm'),
    (18828e-6, 1e-3, '1.9 %; the limit is 0.1 %'),
    (0.025, 0.02, '2.5 %; the limit is 2 %')])
def test_sigma_and_its_limit_have_one_unit_and_differ(sigma, limit, text):
    assert number_text.relative_with_limit(sigma, limit) == text


def test_value_just_beyond_its_limit_gets_more_digits():
    assert number_text.with_limit(0.49861, 0.49847, 'deg') == '0.499 deg; the limit is 0.498 deg'


@pytest.mark.parametrize(('change', 'text'), [
    (2143e-6, '+0.214 %'), (-0.9018, '-90.2 %'), (-1e-8, '+0 %')])
def test_change_is_in_per_cent(change, text):
    assert number_text.format_change(change) == text
