# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Comparison of methods on one leg: differences beyond the sigmas, with their likely cause."""

from itertools import combinations
import math

from odocal_ros.calib.choice import ORDER
from odocal_ros.calib.judge import share
from odocal_ros.calib.result import MethodResult
from odocal_ros.nav.angles import wrap
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.settings.levels import REMARK_SIGMAS

# differences are tested as if methods were independent: methods that share data differ less
# each value as a word, and the likely cause in two_point, the later method of ORDER
VALUES = {
    'scale_factor': ('scale', 'slip or bad fixes at one of the marks'),
    'yaw_mounting_angle': ('yaw', 'an error of the configured heading (alignment.heading_source) '
                           'of about this size'),
    'pitch_mounting_angle': ('pitch', 'heights at the marks, hills, or an accelerometer bias')}


def disagreements(methods: dict[str, MethodResult]) -> list[Reason]:
    """
    Compare the estimates of the methods on one leg.

    methods : by name; rejected ones are left out.

    Returns
    -------
    METHODS_DISAGREE for each parameter of a pair that differs by more than three times the root
    of the sum of both variances, with the likely cause.

    """
    sound = [methods[n] for n in ORDER if n in methods
             and methods[n].verdict is not Verdict.REJECTED]
    found = []
    for name, (word, cause) in VALUES.items():
        for better, other in combinations(sound, 2):
            a, b = (m.estimates.get(name) for m in (better, other))
            if a is None or b is None or a.value is None or b.value is None \
                    or a.sigma is None or b.sigma is None:
                continue
            sigma = math.hypot(a.sigma, b.sigma)
            apart = b.value - a.value if name == 'scale_factor' else float(wrap(b.value - a.value))
            if abs(apart) > REMARK_SIGMAS * sigma:
                off = (share(apart / a.value, '+') if name == 'scale_factor' else
                       f'{math.degrees(apart):+z.3f} deg')
                found.append(Reason(
                    Code.METHODS_DISAGREE, f'{word}: {other.name} and {better.name} differ by '
                    f'{off}, {abs(apart) / sigma:.1f} sigma; likely cause: '
                    f'{cause}'))
    return found
