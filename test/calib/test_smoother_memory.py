# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What a longer leg costs the smoother of memory: by the keyframe, in one pass."""

import tracemalloc

import pytest
from smoother_legs import made

from odocal_ros.calib.smoother.chain import solve
from odocal_ros.calib.smoother.equations import Equations
from odocal_ros.calib.smoother.motion_rows import MotionRows
from odocal_ros.calib.smoother.problem import Problem
from odocal_ros.calib.smoother.start import first_state

MOST = 36e3     # bytes a keyframe: the chain and its covariances are 12e3, sums and rows the rest


def peak_of_a_pass(duration):
    """Return keyframes and peak, bytes, of a pass with slow fix errors."""
    _, config, leg = made(scenario='town', duration=duration, imu_rate=25.0, fix_rate=1.0)
    problem = Problem.of(leg, config)
    state = first_state(leg, problem.imu, problem.priors).state
    levels = problem.first_levels.but(correlation_time=60.0)
    sums = problem.sums(state)
    tracemalloc.start()
    weighted = Equations(problem, state, sums).at(levels)
    solved = solve(weighted.normal())
    weighted.after(solved)
    near = solved.neighbours()
    weighted.components(near)
    weighted[MotionRows].road_noise(near)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return len(state.t), peak


def test_a_longer_leg_costs_a_pass_little(monkeypatch):
    # what is made of a short leg is kept, what is made of a long one is not
    for module in ('motion_rows', 'chain'):
        monkeypatch.setattr(f'odocal_ros.calib.smoother.{module}.SHORT_LEG', 0)
    (few, small), (many, large) = peak_of_a_pass(400.0), peak_of_a_pass(1200.0)
    assert many - few > 700
    assert (large - small) / (many - few) == pytest.approx(MOST / 2, abs=MOST / 2)
