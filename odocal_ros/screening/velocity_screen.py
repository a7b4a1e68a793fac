# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Consistency test of a GNSS velocity (east and north, m/s, of the antenna) with the fixes."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.earth import radii
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS

# s, length of compared displacements: judgement, longer than delays of receivers
WINDOW = 10.0
# relative to the displacements between fixes. Judgement: errors of wheel speeds are a few per
# cent, errors from wrong axes, units and frames are far larger
MOST_UNLIKE = 0.1


def contradicted(t: Floats, velocity_n: Floats, t_fix: Floats, geodetic: Floats,
                 covariance_n: Floats) -> tuple[Reason, ...]:
    """
    Return VELOCITY_UNUSABLE if the velocity contradicts the fixes, otherwise nothing.

    Displacements between fixes, complex numbers D, are z times those from the velocity, V, with
    z = sum(conj(V) D) / sum(|V|^2), 1 for a correct velocity. Swapped axes, vehicle axes, a speed
    without direction, and km/h have another z.

    t, velocity_n : (m,) s, (m, 3) m/s.   t_fix, geodetic, covariance_n : (k,) s, (k, 3) rad and m,
    (k, 3, 3) m^2.
    """
    inside = (t_fix >= t[0]) & (t_fix <= t[-1]) if len(t) else np.zeros(len(t_fix), bool)
    t_fix, geodetic, covariance = t_fix[inside], geodetic[inside], covariance_n[inside]
    if len(t_fix) < 2:
        return ()
    pick = np.unique(np.searchsorted(t_fix, np.arange(t_fix[0], t_fix[-1], WINDOW)))
    meridian, normal = radii(geodetic[0, 0])
    east, north = (geodetic[pick, 1] * normal * np.cos(geodetic[0, 0]),
                   geodetic[pick, 0] * meridian)
    step = np.diff(t)[:, None] * (velocity_n[1:, :2] + velocity_n[:-1, :2]) / 2
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    V = np.diff(np.interp(t_fix[pick], t, path[:, 0]) + 1j * np.interp(t_fix[pick], t, path[:, 1]))
    D = np.diff(east + 1j * north)
    power = float((abs(V)**2).sum())
    if not power:
        return ()
    z = complex((V.conj() * D).sum() / power)
    sigma = float(np.sqrt(2 * np.median(covariance[:, 0, 0]) / power))
    if abs(z - 1) < MOST_UNLIKE + REMARK_SIGMAS * sigma:
        return ()
    return (Reason(Code.VELOCITY_UNUSABLE, 'GNSS velocity contradicts the fixes and is not '
                   f'used: displacements between fixes are {abs(z):.2f} times those from the '
                   f'velocity, rotated by {np.degrees(np.angle(z)):+.0f} deg'),)
