# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A unicycle follows each pattern: lengths and turns in closed form, inside the rectangle."""

from collections import deque
import math

import numpy as np
import pytest

from odocal_ros.errors import BadConfig
from odocal_ros.pattern import command, Progress, rectangle_of, route_of, stop_cause
from odocal_ros.settings.node_configs import PatternConfig

pytestmark = pytest.mark.core
DT = 0.05
BOX = (-1.0, -2.0, 5.0, 3.0)       # 6 m by 5 m
INNER = 0.5                        # margin


def settings(**given):
    return PatternConfig(**({'speed': 0.5, 'rectangle': BOX, 'rest': 1.0} | given))


def drive(config, start=(0.3, 0.4, 2.0), late=0, scale=1.0, noise=0.0):
    """
    Return (n, 6) t, x, y, heading, speed, turn rate until the route is driven.

    late : commands in steps.   scale : motion of the robot over the command.
    noise : m, of the pose.
    """
    route, rng = route_of(config, start[:2]), np.random.default_rng(1)
    x, y, heading = start
    waiting = deque([(0.0, 0.0)] * late)
    progress, rows, t = Progress(), [], 0.0
    while progress.piece < len(route):
        assert t < 2000, 'the route does not end'
        seen = x + noise * rng.normal(), y + noise * rng.normal(), heading
        speed, rate, progress = command(route, progress, seen, t, config)
        waiting.append((speed, rate))
        speed, rate = (scale * c for c in waiting.popleft())
        rows.append((t, x, y, heading, speed, rate))
        # exact for constant rates
        middle = heading + rate * DT / 2
        x += speed * DT * math.cos(middle)
        y += speed * DT * math.sin(middle)
        heading += rate * DT
        t += DT
    return np.array(rows), route


@pytest.mark.parametrize('pattern', ['straight', 'square', 'figure_eight'])
@pytest.mark.parametrize(('late', 'scale', 'noise'), [
    (0, 1.0, 0.0), (2, 1.0, 0.0), (2, 1.05, 0.005), (1, 0.9, 0.01)])
def test_a_robot_stays_near_the_route_and_keeps_the_limits(pattern, late, scale, noise):
    config = settings(pattern=pattern, rounds=2)
    rows, route = drive(config, late=late, scale=scale, noise=noise)
    _, x, y, _, speed, rate = rows.T
    near = 0.015 + 3 * noise        # m: a step beyond the end, and 0.1 s late at the last speed
    assert (x > BOX[0] + INNER - near).all()
    assert (x < BOX[2] - INNER + near).all()
    assert (y > BOX[1] + INNER - near).all()
    assert (y < BOX[3] - INNER + near).all()
    assert 0 <= speed.min() <= speed.max() <= scale * config.speed
    assert np.abs(rate).max() <= scale * config.turn_rate + 1e-12
    assert speed.max() > 0.9 * scale * min([config.speed, *(
        config.turn_rate / 1.5 / abs(p.curvature) for p in route if p.curvature)])
    grows = np.diff(speed) / DT
    if not late:
        assert grows.max() < scale * (config.acceleration + 0.03 / DT) + 1e-9


@pytest.mark.parametrize(('pattern', 'length', 'left', 'right'), [
    # 5 m by 4 m inside the margin: path, m, and turns, in full turns. The square has
    # three corners to each side, and half turns in between to the left, right, left
    ('straight', 4 * 5.0, 2 / 2, 1 / 2),
    ('square', 2 * 8 * 4.0, 2 * 3 / 4 + 2 / 2, 2 * 3 / 4 + 1 / 2),
    ('figure_eight', 8 * math.pi * 1.25, 2, 2)])
def test_length_and_turns_agree_with_the_closed_form(pattern, length, left, right):
    config = settings(pattern=pattern, rounds=2)
    route = route_of(config, (0.3, 0.4))[1:]
    assert sum(piece.length for piece in route) == pytest.approx(length)
    rows, _ = drive(config, (route[0].x, route[0].y, route[0].heading))
    # each piece ends within a step or an acceleration from its end
    assert rows[:, 4].sum() * DT == pytest.approx(length, abs=0.02 * len(route))
    steps = np.diff(rows[:, 3]) / (2 * math.pi)
    found = steps[steps > 0].sum(), -steps[steps < 0].sum()
    assert found == pytest.approx((left, right), abs=0.05)
    assert rows[-1, 1:3] == pytest.approx((route[0].x, route[0].y), abs=0.05)
    still = (rows[:, 4] == 0) & (rows[:, 5] == 0)
    assert still.sum() * DT >= (sum(p.stops for p in route) - 1) * config.rest - 1e-9


def test_positions_on_arcs_are_located_by_geometry():
    for piece in route_of(settings(pattern='figure_eight'), (0.0, 0.0))[1:]:
        radius = 1 / piece.curvature
        centre = (piece.x - radius * math.sin(piece.heading),
                  piece.y + radius * math.cos(piece.heading))
        for share, left in ((0.0, 0.0), (0.3, 0.1), (1.0, -0.2)):
            at = piece.heading + piece.curvature * share * piece.length
            x = centre[0] + (radius - left) * math.sin(at)
            y = centre[1] - (radius - left) * math.cos(at)
            expected = share * piece.length, left
            assert piece.along_and_left(x, y) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(('given', 'message'), [
    ({'rectangle': (0.0, 0.0, 1.4, 9.0)}, 'the pattern has 0.40 m, required: 0.5 m'),
    ({'rectangle': (0.0, 0.0, 1.0)}, 'rectangle has 3 values'),
    ({'rectangle': ()}, 'rectangle has 0 values')])
def test_an_impossible_rectangle_is_refused(given, message):
    with pytest.raises(BadConfig, match=message):
        route_of(settings(**given), (0.0, 0.0))


@pytest.mark.parametrize(('change', 'message'), [
    ({}, ''), ({'bumped': True}, 'the bumper is pressed'), ({'pose': None}, 'no pose for 0.5 s'),
    ({'age_s': 0.51}, 'no pose for 0.5 s'), ({'age_s': math.nan}, 'no pose for 0.5 s'),
    ({'pose': (5.01, 0.0, 0.0)}, 'outside the rectangle, at x 5.01 m'),
    ({'pose': (0.0, -2.01, 0.0)}, 'outside'), ({'pose': (math.nan, 0.0, 0.0)}, 'outside'),
    ({'pose': (0.0, 0.0, math.nan)}, 'no heading'), ({'driven_s': 600.1}, 'timeout of 600 s')])
def test_a_robot_stops_with_a_reason(change, message):
    given = {'pose': (0.0, 0.0, 0.0), 'age_s': 0.1, 'rectangle': rectangle_of(settings()),
             'bumped': False, 'driven_s': 1.0, 'timeout_s': 600.0} | change
    assert message in stop_cause(**given)
    assert bool(stop_cause(**given)) == bool(message)


def test_corners_in_any_order_give_the_same_rectangle():
    assert rectangle_of(settings(rectangle=(5.0, -2.0, -1.0, 3.0))) == BOX
