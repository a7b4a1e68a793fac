# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Calibrate legs of faulty messages as the live calibrator does, and compare with the truth.

    python benchmarks/live_faults.py [--legs 300] [--seed 1] [--only N]

Each leg is a drive of four minutes with one or two faults at random places and of random sizes
(``test/fuzz/live_legs.py``): values, axes, bursts, stamps, lost messages, second publishers,
clocks that are set. The messages are read, watched, forecast and calibrated as in the node,
without DDS. Printed: legs whose accepted values are off by more than five sigma, or that raise an
error or a warning; and how many legs are accepted, cautious, rejected and refused.
"""

from collections import Counter

from harness import parsed
from live_legs import leg, SIGMAS


def main():
    """Run legs and print those that are wrong."""
    args = parsed(__doc__, legs=300, seed=1, only=int)
    found = []
    for number in range(args.legs) if args.only is None else [args.only]:
        one = leg(args.seed, number)
        found.append(one)
        off = one.sigmas > SIGMAS and one.verdict in ('accepted', 'caution')
        if off or one.raised or args.only is not None:
            print(f'{number} ({", ".join(one.faults)}): {one.verdict}, {one.sigmas:.3g} sigma: '
                  f'{one.what}; {", ".join(one.reasons)} {one.raised}', flush=True)
    verdicts = Counter(one.verdict for one in found)
    for verdict in ('accepted', 'caution'):
        sigmas = [one.sigmas for one in found if one.verdict == verdict]
        print(f'{verdict}: {sum(x > SIGMAS for x in sigmas)} of {len(sigmas)} beyond {SIGMAS:g} '
              f'sigma, worst {max(sigmas, default=0.0):.3g}')
    print(f'{len(found)} legs: {dict(verdicts)}; {sum(bool(one.raised) for one in found)} errors')


if __name__ == '__main__':
    main()
