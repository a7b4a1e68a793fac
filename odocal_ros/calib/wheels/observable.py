# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Observability of the wheels' parameters: condition and correlation, refusals with the reason."""

import numpy as np

from odocal_ros.calib.check import NOISIER_WORTH
from odocal_ros.calib.mounting import BACKWARDS_YAW, FAR_YAW
from odocal_ros.calib.two_point import PITCH_PRIOR
from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.calib.wheels.model import PARAMETERS
from odocal_ros.calib.wheels.solution import Solution
from odocal_ros.calib.wheels.track_width import TRACK_WIDTH
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.angles import wrap
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import INFORMED_SHARE, REMARK_SIGMAS, TYRE_SPREAD


def correlation(covariance: Floats, names: tuple[str, ...] = PARAMETERS) -> dict[str, float]:
    """Return the correlation of each pair of parameters, for calibration.json."""
    sigma = np.sqrt(np.diag(covariance))
    rho = covariance / np.outer(sigma, sigma)
    return {f'{names[i]},{names[j]}': float(rho[i, j])
            for i in range(len(names)) for j in range(i + 1, len(names))}


def without_turns(solution: Solution) -> tuple[float, float]:
    """
    Return the observability of left and right by the fixes alone: docs/method.md (W18).

    Returns
    -------
    condition : condition number of left, right and heading, each in units of what it does alone,
    so that it tells how alike two of them act.   sigma : of ln(right / left).

    """
    n = len(solution.eq.turn)
    use = solution.fit.use & (np.arange(3 * n) < 2 * n)
    V = solution.covariance()
    X = solution.X[use][:, :5]
    normal = X.T @ np.linalg.solve(V[np.ix_(use, use)], X)
    start = normal[3:, 3:]
    normal = normal[:3, :3] - normal[:3, 3:] @ np.linalg.solve(start, normal[3:, :3])
    ratio = np.exp(solution.state.log_ratio)
    to = np.linalg.inv(np.array([[1, -1 / (1 + ratio), 0], [1, ratio / (1 + ratio), 0],
                                 [0, 0, 1]]))       # (ln left, ln right) to (ln scale, ln ratio)
    wheels = to.T @ normal @ to
    size = np.sqrt(np.diag(wheels))
    values = np.linalg.eigvalsh(wheels / np.outer(size, size))
    size = np.sqrt(np.diag(normal))
    size = np.maximum(size, 1e-9 * size.max())      # of one counter for both: no ratio at all
    rest = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-13, hermitian=True)
    variance = rest[1, 1] if rest[1, 1] > 0 else np.nan       # not observable at all
    return float(values[-1] / max(values[0], 1e-15)), float(np.sqrt(variance) / size[1])


def separable(solution: Solution, sigma_ratio: float, config: Config,
              turn_rate: bool) -> tuple[Reason, ...]:
    """Return why left and right are not observable apart, empty if they are."""
    limit = INFORMED_SHARE * (config.wheels.radius_range or TYRE_SPREAD)
    if turn_rate and sigma_ratio <= limit:
        return ()
    condition, _ = without_turns(solution)
    if not turn_rate:
        return (Reason(Code.WHEELS_NOT_SEPARABLE, "without the gyro's turn rate the fixes see "
                       f'only the mean of both wheels (condition number {condition:.0e}): left '
                       'and right are not stated'),)
    return (Reason(Code.WHEELS_NOT_SEPARABLE, 'the ratio of right to left is known to '
                   f'{100 * sigma_ratio:.2g} %, {100 * limit:.2g} % is the limit: '
                   'left and right are not stated'),)


def width_observable(solution: Solution, sigma: float,
                     given: float) -> tuple[bool, tuple[Reason, ...]]:
    """Tell whether the drive determines the track width, and why not where none is given."""
    width = solution.state.width
    if solution.width_observable and width <= TRACK_WIDTH.least:
        return False, (Reason(Code.TRACK_WIDTH_NOT_DETERMINED, 'the difference of the wheels does '
                              'not follow the turns by gyro: as if less than '
                              f'{TRACK_WIDTH.least:g} m lay between them'),)
    determined = solution.width_observable and sigma < TRACK_WIDTH.determined_share * width
    if determined or given:
        learned = sigma < INFORMED_SHARE * TRACK_WIDTH.taped_share * given
        return determined and (not given or learned), ()
    away = solution.eq.yaw
    return False, (Reason(Code.TRACK_WIDTH_NOT_DETERMINED, 'the heading ranges over '
                          f'{np.rad2deg(np.ptp(away)):.1f} deg: too little for the track width'),)


def judge_width(width: float, sigma: float, given: float) -> tuple[Reason, ...]:
    """Return what is to be said of a track width by the drive beside the one given, m."""
    if not given or abs(width - given) <= REMARK_SIGMAS * np.hypot(
            TRACK_WIDTH.taped_share * given, sigma):
        return ()
    return (Reason(Code.TRACK_WIDTH_FAR_FROM_GIVEN, f'the drive tells a track width of '
                   f'{width:.4f} +- {sigma:.4f} m, odometer.track_width says {given:.4g} m'),)


def judge_heading(leg: WheelLeg, heading: float, config: Config) -> tuple[Reason, ...]:
    """Return what is to be said of the yaw mounting angle."""
    a = leg.alignment
    if not a.heading_separable:
        return (Reason(Code.YAW_NOT_SEPARABLE, 'the only heading is the course over ground, which '
                       'holds the mounting angle: the heading error is the sum of both'),)
    reasons: tuple[Reason, ...] = ()
    if a.heading_sigma > config.verdict.max_yaw_sigma:
        reasons = (Reason(Code.YAW_NOT_SEPARABLE, f'the heading ({a.heading_source}) is known to '
                          f'{np.rad2deg(a.heading_sigma):.3f} deg, the yaw is asked to '
                          f'{np.rad2deg(config.verdict.max_yaw_sigma):.3f} deg: the heading error '
                          'is their sum'),)
    nominal = config.imu.nominal_yaw
    off = abs(float(wrap(-heading - (0.0 if np.isnan(nominal) else nominal))))
    if off > BACKWARDS_YAW:
        reasons += (Reason(Code.ODOMETER_REVERSED, 'the track runs against the fixes: positive '
                           'counts mean backwards, or the Imu faces backwards (yaw '
                           f'{np.rad2deg(-heading):+.1f} deg)'),)
    elif off > FAR_YAW:
        reasons += (Reason(Code.YAW_FAR_FROM_NOMINAL, f'heading ({a.heading_source}) and course '
                           f'make a yaw mounting of {np.rad2deg(-heading):+.1f} deg, '
                           f'{np.rad2deg(off):.1f} deg from the nominal one'),)
    return reasons


def judge_fit(solution: Solution) -> tuple[Reason, ...]:
    """Return what is to be said of fixes, heights and convergence."""
    reasons: tuple[Reason, ...] = ()
    noise = np.sqrt(solution.noise.white + solution.noise.slow)
    if noise > NOISIER_WORTH:
        reasons += (Reason(Code.FIXES_NOISIER_THAN_SAID, f'the fixes stray {noise:.1f} times as '
                           'far from the track as their covariance says'),)
    n = len(solution.eq.turn)
    residual = solution.residual[:2 * n][solution.fit.use[:2 * n]]
    rms, way = np.sqrt(2 * (residual**2).mean()), solution.eq.length.sum()
    # times the stated sigma, and of the way: judgement, it is no track at all
    if noise > 5.0 and rms > 0.01 * way:
        reasons += (Reason(Code.TRACK_MISMATCH, f'with the best factors the track is {rms:.1f} m '
                           f'rms from the fixes on {way:.0f} m, {noise:.1f} times as far as they '
                           'say: the gyro does not turn as the vehicle does, or the fixes are '
                           'bad'),)
    if not solution.height.known:
        reasons += (Reason(Code.PITCH_NOT_DETERMINED, 'the fixes give no height good enough for '
                           f'the pitch; taken as 0 +- {np.rad2deg(PITCH_PRIOR):.1f} deg'),)
    if not solution.settled:
        reasons += (Reason(Code.MODEL_MISMATCH, 'the fit of the wheels still moves by more than a '
                           'tenth of its sigma after its last round'),)
    return reasons
