# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Drives with reversing; and counters and speeds without direction."""

from dataclasses import replace
import math

import numpy as np

from odocal_ros.data.samples import OdometerSamples
from odocal_ros.sim import options, routes, scenarios
from odocal_ros.sim.profile import hold, ramp, turn


def there_and_back(back, seconds):
    """Return a route: forwards, in reverse at ``back`` m/s for ``seconds``, forwards."""
    def route(duration, rng):
        pieces = (hold(30) + _run(10, 12, 30, 5) + _run(4, -back, seconds, 5)
                  + _run(10, 12, 60, 20))
        return routes._route([(pieces, hold(_length(pieces)))])
    return route


def three_point_turn(duration, rng):
    """Return a route with turns, two of them three-point turns."""
    stretches = [(hold(30), hold(30))]
    for up, top, before, turning, angle, after, stop in (
            (8, 11, 10, 8, 80, 20, 6), (3, -2, 2, 6, 35, 2, 4), (8, 10, 15, 9, -70, 15, 6),
            (8, 12, 20, 8, 60, 25, 6), (3, -2.5, 6, 6, -40, 3, 4), (8, 12, 20, 8, -80, 25, 15)):
        stretches.append((_run(up, top, before + turning + after, stop),
                          hold(up + before) + turn(turning, math.radians(angle), 1.5)
                          + hold(after + up + stop)))
    return routes._route(stretches)


def made(route, **choices):
    name = 'by_hand'
    routes.ROUTES[name] = route
    options.DEFAULTS[name] = {'duration': 300.0, 'imu_grade': 'industrial'}
    try:
        return scenarios.simulate(scenarios.SimOptions(**(
            {'scenario': name, 'imu_rate': 50.0, 'odometer_rate': 20.0} | choices)))
    finally:
        del routes.ROUTES[name], options.DEFAULTS[name]


def without_direction(leg):
    """Return a leg whose counters, one or two, or speeds have no direction."""
    def one(samples):
        value = samples.value
        if leg.form.quantity == 'rate':
            value = np.abs(value)
        elif len(value):
            steps = np.abs(np.diff(value))
            value = value[0] + np.concatenate([[0], np.cumsum(steps)]).astype(value.dtype)
        return OdometerSamples(samples.stamp_ns, samples.received_ns, value)
    return replace(leg, odometer=one(leg.odometer), odometer_right=one(leg.odometer_right))


def _run(up, top, cruise, stop):
    return ramp(up, top, 1.0) + hold(cruise) + ramp(up, -top, 1.0) + hold(stop)


def _length(pieces):
    return sum(seconds for seconds, _ in pieces)
