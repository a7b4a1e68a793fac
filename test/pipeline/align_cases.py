# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Inputs of ``align`` from simulated drives, and the true attitude."""

from copy import copy
from dataclasses import replace

from drives import kept, shifted
import numpy as np

from odocal_ros.nav.geodesy import C_en
from odocal_ros.nav.rotations import heading_from_yaw, matrix_from_rpy, rpy_from_matrix, transpose
from odocal_ros.pipeline.align import align
from odocal_ros.screening.inputs import locate_fixes
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.motion import attitude
from odocal_ros.sim.scenarios import SimOptions, simulate

PLAIN = SimOptions(scenario='straight', duration=240.0, imu_grade='perfect', imu_rate=50.0,
                   yaw=0.02, pitch=0.01)
TURNING = replace(PLAIN, scenario='town', duration=300.0)


def settings(**changes):
    return with_settings(Config(), {k.replace('__', '.'): v for k, v in changes.items()})


class Case:
    """Inputs of ``align`` from a drive, with the start mark ``later`` by so many seconds."""

    def __init__(self, options, config=None, later=0.0, forget=False):
        self.drive = simulate(options)
        self.config = config or settings(imu__grade='navigation')
        leg = shifted(self.drive.leg(), start=later)
        start_ns = leg.start_ns
        if forget:     # no pre-roll: the recording begins at the mark
            for slot in ('imu', 'odometer', 'fix', 'heading'):
                leg = kept(leg, slot, leg.rows(slot).stamp_ns >= start_ns)
        self.mark = (start_ns - self.drive.options.start_ns) * 1e-9     # s of the motion
        self.inputs, _ = screen(leg, self.config)
        located = locate_fixes(self.inputs, self.config)
        self.origin, self.fixes_n = located.origin, located.fixes_n
        self.scale = self.drive.truth.scale
        self.spans = self.inputs.standstills(self.scale, self.config)

    def align(self, spans=None, **changes):
        inputs = replace(self.inputs, **changes)
        return align(inputs, self.spans if spans is None else spans, self.scale, self.fixes_n,
                     self.origin, self.config)

    def truth(self, t):
        """Return the true C_nb at t, with n of the origin."""
        state = self.drive.motion.at(np.array([self.mark + t]))
        o = self.drive.options
        C_vb = matrix_from_rpy([o.roll, o.pitch, o.yaw])
        C_np = transpose(C_en(self.origin.latitude, self.origin.longitude)) @ C_en(
            state.latitude[0], state.longitude[0])
        return C_np @ attitude(state)[0] @ C_vb

    def miss(self, alignment):
        """Return the attitude error of the alignment, a rotation vector in n, rad."""
        return rpy_from_matrix(alignment.C_nb @ self.truth(alignment.t).T)

    def heading(self):
        """Return the true compass heading of b's x axis at the mark, rad."""
        return float(heading_from_yaw(np.arctan2(*self.truth(0.0)[[1, 0], 0])))

    def with_settings_of(self, **changes):
        """Return the case with other settings (those that the screening does not use)."""
        other = copy(self)
        other.config = settings(**{'imu__grade': 'navigation'} | changes)
        return other
