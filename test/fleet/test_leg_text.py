# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs kept as text are the legs: combined, they give every digit of what replay gives."""

from drives import drive, settings
import pytest

from odocal_ros.fleet.rows import leg_text, legs_from
from odocal_ros.output.files import as_json
from odocal_ros.pipeline.calibrate import calibrate, combine

pytestmark = pytest.mark.core


def test_legs_from_text_combine_to_the_same_digits():
    """Of the smoother too, whose legs are combined on their border."""
    legs = []
    for seed in (1, 2):
        made = drive(scenario='town', duration=135.0, fix_noise='rtk', imu_rate=25.0,
                     odometer_rate=10.0, fix_rate=2.0, seed=seed, start_ns=seed * 10**18)
        config = settings(made, heading_sigma=None, method='auto')
        legs.append(calibrate(made.leg(), config))
    text = leg_text(legs)
    again = legs_from(text)
    assert leg_text(again) == text
    kept = [leg.numbers() for leg in legs]      # what is drawn is left out
    told, known = (as_json(combine(some, config), config, [], '') for some in (again, kept))
    assert told == known
    assert told['result']['scale_factor']['method'] == 'smoother'
    assert again[0].methods['smoother'].border.information.tobytes() == \
        legs[0].methods['smoother'].border.information.tobytes()
