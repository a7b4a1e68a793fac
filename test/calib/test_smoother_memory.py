# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a longer leg costs the smoother of memory: by the keyframe, in one pass."""

from pathlib import Path
import tracemalloc

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.data.mapped import HELD_BYTES, let_go, room
from odocal_ros.estimator.chain import solve
from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.factors.axle import rates_at
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.prepare import problem_of
from odocal_ros.estimator.start import first_state

# bytes a keyframe: the chain is 16e3, derivatives 13.4e3, sums and rows 8e3; the rest is for the
# blocks that are worked in at a time, 5e6 whatever the length
MOST = 41.5e3


def peak_of_a_pass(duration):
    """Return the number of keyframes and the peak, bytes, of a pass with slow fix errors."""
    _, config, leg = made(scenario='town', duration=duration, imu_rate=25.0, fix_rate=1.0)
    problem = problem_of(leg, config)
    state = first_state(leg, problem.imu, problem.priors).state
    levels = problem.first_levels.but(correlation_time=60.0)
    tracemalloc.start()
    weighted = Equations(problem, state).at(levels)
    solved = solve(weighted.normal())
    weighted.after(solved)
    near = solved.marginals()
    weighted.components(near)
    weighted[MotionRows].road_noise(near)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return len(state.t), peak


def test_a_longer_leg_costs_a_pass_little():
    keyframes, peak = peak_of_a_pass(1152.0)
    assert keyframes > 1100
    assert peak / keyframes == pytest.approx(MOST / 2, abs=MOST / 2)


def resident(peak=False):
    """Return the resident bytes of this process, or their peak since it was last asked."""
    name = 'VmHWM' if peak else 'VmRSS'
    found = Path('/proc/self/status').read_text().split(f'{name}:')[1].split()[0]
    Path('/proc/self/clear_refs').write_text('5')
    return 1024 * int(found)


def test_turn_rates_in_a_file_are_read_piece_by_piece():
    rows, step = 6_000_000, 1e-3        # 100 min at 1 kHz
    t, w_b = room(rows), room(rows, 3)
    t[:] = np.arange(rows) * step
    assert w_b.nbytes > HELD_BYTES
    let_go()
    before = resident()
    rates_at(t, w_b, np.arange(1.0, rows * step - 1.0))
    # all times are touched; the rates, if held as a whole, would add their own size
    assert resident(peak=True) - before - t.nbytes < w_b.nbytes / 2
