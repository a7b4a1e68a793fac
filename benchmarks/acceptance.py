# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Pass or fail by --accept: false accepts and false rejects of drawn results, beside theory.

Results are drawn about true values at places against the limits, with the sigma that they state:
python benchmarks/acceptance.py --draws 20000
"""

from math import erf, sqrt

from harness import parsed
import numpy as np

from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.pipeline.acceptance import accept, Decision, LIMIT_SIGMAS
from odocal_ros.settings.config import Config, with_settings

LOW, HIGH = 0.995, 1.005


def below(z):
    """Return the normal law."""
    return (1 + erf(z / sqrt(2))) / 2


def theory(truth, sigma):
    """Return the chances of PASS and of FAIL of a true value."""
    above, under = (truth - LOW) / sigma, (HIGH - truth) / sigma       # the limits, in sigmas
    passes = below(under - LIMIT_SIGMAS) - below(LIMIT_SIGMAS - above)
    fails = below(-under - LIMIT_SIGMAS) + below(-above - LIMIT_SIGMAS)
    return max(0.0, passes), fails


def decision_of(value, sigma, config):
    """Return the decision on a result."""
    return accept(Calibration((), {'scale_ratio': Estimate(value, sigma, '1')}, {}, ()),
                  config).decision


def decisions(truth, sigma, draws, config, rng):
    """Return the shares of PASS and of FAIL among results drawn about true values."""
    count = dict.fromkeys(Decision, 0)
    for value in truth + sigma * rng.standard_normal(draws):
        count[decision_of(value, sigma, config)] += 1
    return count[Decision.PASS] / draws, count[Decision.FAIL] / draws


def main():
    """Print the table."""
    args = parsed(__doc__, draws=20_000, seed=1)
    config = with_settings(Config(), {'accept.scale_ratio_min': LOW, 'accept.scale_ratio_max':
                                      HIGH})
    rng = np.random.default_rng(args.seed)
    print(f'limits {LOW} to {HIGH}, {args.draws} draws a row; noise of a share '
          f'{100 * sqrt(0.0225 * 0.9775 / args.draws):.2f} % at 2.3 %')
    print('sigma, ppm  truth                      PASS, %  theory    FAIL, %  theory')
    for sigma in (200e-6, 500e-6, 1000e-6, 2000e-6):
        for place in (-4, -2, -1, 0, 1, 2, 4):
            truth = HIGH + place * sigma
            found = decisions(truth, sigma, args.draws, config, rng)
            told = [f'{100 * a:9.2f} {100 * b:7.2f}' for a, b in
                    zip(found, theory(truth, sigma), strict=True)]
            where = ('on the limit' if not place else f'{abs(place)} sigma '
                     + ('beyond' if place > 0 else 'within'))
            print(f'{1e6 * sigma:9.0f}  {truth:.4f} {where:16} {"  ".join(told)}')
    spread = 0.0025      # of a population: 4.6 % of the vehicles are bad
    for sigma in (200e-6, 1000e-6):
        truth = 1 + spread * rng.standard_normal(args.draws)
        bad = (truth < LOW) | (truth > HIGH)
        passed = np.array([decision_of(v, sigma, config) is Decision.PASS
                           for v in truth + sigma * rng.standard_normal(args.draws)])
        print(f'a line with {100 * bad.mean():.1f} % bad vehicles, sigma {1e6 * sigma:.0f} ppm: '
              f'of those that pass {1e6 * (bad & passed).sum() / passed.sum():.0f} in a million '
              f'are bad, {100 * passed[~bad].mean():.1f} % of the good ones pass')


if __name__ == '__main__':
    main()
