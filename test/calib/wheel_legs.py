# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Simulated legs for the tests and the benchmark of the wheels: drive to WheelLeg."""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.marks import fix_at, standing_at
from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.nav.angles import wrap, yaw_from_heading
from odocal_ros.nav.dead_reckoning import dead_reckon, rough_scale
from odocal_ros.nav.earth import earth_rate_n
from odocal_ros.nav.standstill import standstills
from odocal_ros.nav.strapdown import attitude
from odocal_ros.pipeline.align import align
from odocal_ros.screening.fix_screen import origin_amid
from odocal_ros.screening.screen import screen


def wheel_leg(leg, config) -> WheelLeg:
    """Return what ``fit_wheels`` takes, of a raw leg, as the pipeline makes it."""
    inputs, _ = screen(leg, config)
    origin = origin_amid(inputs.t_fix, inputs.geodetic)
    fixes_n = origin.to_n(inputs.geodetic)
    sigma = float(np.sqrt(np.median(inputs.covariance_n[:, 0, 0])))
    rough = rough_scale(inputs.travel, inputs.t_fix, fixes_n, sigma)
    spans = standstills(inputs.t_imu, inputs.w_b, inputs.travel, rough, config.leg.standstill)
    a, _ = align(inputs, spans, rough, fixes_n, origin, config)
    pick = (inputs.t_imu >= a.t - 1e-9) & (inputs.t_imu <= inputs.t_stop + 1.0)
    t = inputs.t_imu[pick]
    rate = (len(t) - 1) / (t[-1] - t[0])
    epochs, q_nb = attitude(t, inputs.w_b[pick] - a.gyro_bias, a.q_nb,
                            earth_rate_n(origin.latitude), max(1, int(rate / 50.0)))
    left, right = (dead_reckon(epochs, q_nb, w) for w in (inputs.travel_left,
                                                          inputs.travel_right))
    lever_b = np.subtract(config.gnss.lever_arm, config.odometer.lever_arm)
    t_start = max(0.0, float(epochs[0]))
    start = fix_at(t_start, standing_at(t_start, spans), (inputs.t_fix, fixes_n,
                                                          inputs.covariance_n),
                   lambda times: np.zeros((len(times), 3)), np.nan, 1.0)
    return WheelLeg(
        origin, left, right, inputs.travel_left.quantum, inputs.t_fix, fixes_n,
        inputs.covariance_n, start, t_start, inputs.t_stop, a, lever_b,
        config.odometer.nominal_scale, rough, inputs.scale_unit,
        float(np.median(np.diff(inputs.travel_left.t))))


def true_heading_error(made, leg: WheelLeg):
    """Return heading error of the alignment plus mounting: what the heading is to be turned by."""
    at = leg.left.C_nb_at(np.array(leg.alignment.t))
    yaw = np.arctan2(at[1, 0], at[0, 0])
    return float(wrap(yaw_from_heading(made.truth.heading) - yaw - made.truth.yaw))


def held_out(leg: WheelLeg, share):
    """Return a leg whose fixes end after a share of its time."""
    return replace(leg, t_stop=leg.t_start + share * (leg.t_stop - leg.t_start))
