# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""docs/recipes.md names parameters that the other projects have, and its figures are right."""

import math
import re

from foreign_keys import ARDUPILOT, LIDAR_INERTIAL, RECIPES
from pages import fenced, ROOT
import yaml

PAGE = (ROOT / 'docs' / 'recipes.md').read_text(encoding='utf-8')


def blocks():
    """Return the blocks of settings: of ROS nodes, and of ArduPilot as name -> value."""
    texts = ['\n'.join(lines) for language, lines in fenced(PAGE) if language == 'text']
    ros = [yaml.safe_load(text) for text in texts if 'ros__parameters' in text]
    plain = [dict(line.split() for line in text.splitlines()) for text in texts
             if text.startswith('WENC')]
    return ros, plain


def test_each_parameter_is_one_that_was_read_in_the_source():
    ros, plain = blocks()
    ours = yaml.safe_load((ROOT / 'config' / 'ekf_odocal.yaml').read_text())
    ros.append({name.rpartition('/')[2]: block for name, block in ours.items()})
    found = {node: set(block['ros__parameters']) for one in ros for node, block in one.items()}
    assert set(found) == set(RECIPES)
    for one in ros:
        for node, block in one.items():
            assert set(block['ros__parameters']) <= RECIPES[node], node
    named = set(re.findall(r'\b(?:WENC|EK3)\w+', PAGE))
    assert named <= ARDUPILOT
    assert {name for one in plain for name in one} <= ARDUPILOT
    assert set(re.findall(r'`(extrinsic\w+)`', PAGE)) == LIDAR_INERTIAL


def test_a_twist_config_has_the_fifteen_states():
    ros, _ = blocks()
    config = ros[0]['ekf_filter_node']['ros__parameters']['twist0_config']
    assert [i for i, fused in enumerate(config) if fused] == [6, 7, 11]       # vx, vy, vyaw
    assert len(config) == 15


def test_the_radius_gives_the_travel_of_the_factor():
    """By ArduPilot's own line: distance = 2 pi counts / CPR * radius."""
    _, (settings,) = blocks()
    travel = 2 * math.pi / float(settings['WENC_CPR']) * float(settings['WENC_RADIUS'])
    assert abs(travel - 0.0213) < 1e-7
