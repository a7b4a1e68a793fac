# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal patent: the embodiment of CN104359492A, printed and computed values."""

import argparse
import math
from typing import Any, TYPE_CHECKING

from odocal_reproductions.command import add_outputs, picture_of
from odocal_ros.offline.cli import print_text

if TYPE_CHECKING:
    from odocal_ros.calib.wheel_search.planar import PlanarLeg

FIXES = ('white', 'correlated', 'rtk')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument('--fix-noise', default='white', choices=FIXES,
                        help='errors of the simulated fixes (default white, 1.5 m)')
    parser.add_argument('--seed', type=int, default=1, help='random seed of the drive (default 1)')
    add_outputs(parser, 'the distances of all combinations and of each line')


def run(args: argparse.Namespace) -> int:
    """Simulate, compute, print, draw; return 0."""
    picture = picture_of(args)
    from odocal_reproductions.patent.embodiment import embodiment, PRINTED_BEST
    from odocal_reproductions.patent.text import text_of
    table = embodiment(planar_leg(args.fix_noise, args.seed), truth=PRINTED_BEST)
    if picture is not None:
        from odocal_reproductions.patent.plot import draw
        draw(table, picture)
    if args.json:
        import json
        print_text(json.dumps({'fix_noise': args.fix_noise, 'seed': args.seed} | table.as_dict(),
                              indent=2, allow_nan=False))
    else:
        print_text(text_of(table, args.fix_noise, PRINTED_BEST), end='')
        if picture is not None:
            print_text(f'\n{picture}: the distances of all combinations and of each line')
    return 0


def planar_leg(fix_noise: str, seed: int, **others: Any) -> 'PlanarLeg':
    """Return the embodiment's drive, ten minutes of town; others: options that replace these."""
    from odocal_reproductions.patent.embodiment import NOMINAL_RADIUS, PRINTED_BEST
    from odocal_ros.pipeline.prepare import prepare
    from odocal_ros.pipeline.smoother_run import planar_input
    from odocal_ros.screening.screen import screen
    from odocal_ros.settings.config import Config, with_settings
    from odocal_ros.sim.scenarios import SimOptions, simulate
    left, right = NOMINAL_RADIUS + PRINTED_BEST[0], NOMINAL_RADIUS + PRINTED_BEST[1]
    options: dict[str, Any] = {
        'scenario': 'town', 'seed': seed, 'imu_grade': 'tactical', 'odometer': 'angle',
        'two_wheels': True, 'scale': 2 / (1 / left + 1 / right),
        'wheel_difference': right / left - 1, 'yaw': 0.0, 'pitch': 0.0,
        'nominal_scale': NOMINAL_RADIUS, 'fix_noise': fix_noise}
    drive = simulate(SimOptions(**options | others))
    # the heading error of the patent rotates the track counter-clockwise, a heading is clockwise
    config = with_settings(Config(), {
        'imu.grade': 'tactical', 'wheels.radius': NOMINAL_RADIUS,
        'alignment.heading_source': 'fixed',
        'alignment.heading': drive.truth.heading + math.radians(PRINTED_BEST[2])})
    leg = drive.leg()
    inputs, _ = screen(leg, config)
    prepared, _ = prepare(leg, inputs, config)
    assert prepared is not None     # this drive is sufficient
    planar = planar_input(prepared, 0.0)
    assert planar is not None
    return planar
