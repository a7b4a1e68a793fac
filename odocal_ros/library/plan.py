# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How good a calibration will be, before it is driven, and what would help."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
import math
from pathlib import Path
from typing import Any

from odocal_ros.errors import BadUsage
from odocal_ros.forecast.planned_drive import PlannedDrive
from odocal_ros.forecast.planned_methods import Plan, plan_methods
from odocal_ros.forecast.predict import Sigmas
from odocal_ros.library import planned_drives
from odocal_ros.library.asked import config_of, Settings
from odocal_ros.library.what_helps import Change, changes, SCALE, YAW
from odocal_ros.reasons import Reason, Verdict

PITCH = 'pitch_mounting_angle'
PARAMETERS = (SCALE, YAW, PITCH)


@dataclass(frozen=True, eq=False)
class Planned:
    """
    What a drive will give.

    drive : the motion.   sigmas : what errs, and the settings.   plan : by each method.
    """

    drive: PlannedDrive
    sigmas: Sigmas
    plan: Plan

    @property
    def verdict(self) -> Verdict:
        """Return the predicted verdict of such a drive."""
        return self.plan.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Return the reasons of the prediction."""
        return self.plan.reasons

    def sigma(self, parameter: str) -> float | None:
        """Return the sigma of scale_factor (relative) or of a mounting angle (rad)."""
        return self.plan.sigma(parameter)

    @cached_property
    def helps(self) -> list[Change]:
        """Return the computed improvements; this takes some seconds."""
        return changes(self.drive, self.sigmas, self.plan)

    def to_dict(self) -> dict[str, Any]:
        """Return the output of ``odocal plan --json``; sigmas of the scale are relative."""
        plan, sigmas = self.plan, self.sigmas
        two_point, alignment = plan.two_point, plan.two_point.alignment
        return {
            'drive': {'distance': two_point.distance, 'chord': two_point.chord,
                      'duration': two_point.duration, 'standing': list(two_point.standing)},
            'sigmas': {'imu_grade': sigmas.config.imu.grade,
                       'heading_source': alignment.heading_source,
                       'heading_sigma': alignment.heading_sigma, 'fix_sigma': sigmas.fix,
                       'fix_rate': sigmas.fix_rate, 'correlation_time': sigmas.correlation_time,
                       'pulse': sigmas.quantum, 'sway': sigmas.sway, 'slip_walk': sigmas.slip},
            'verdict': plan.verdict.value, 'reasons': [r.as_dict() for r in plan.reasons],
            'estimates': {name: {'sigma': plan.sigma(name), 'method': plan.by(name) or None}
                          for name in PARAMETERS},
            'methods': {name: {
                'estimates': {name: {'sigma': e.sigma, 'unit': e.unit}
                              for name, e in method.estimates.items() if name != 'scale_ratio'},
                'reasons': [r.as_dict() for r in plan.reasons_of(name)],
                'budget': method.details.get('budget', {})}
                for name, method in plan.methods.items()},
            'changes': [{'text': c.text, 'scale_factor': c.scale, 'yaw_mounting_angle': c.yaw}
                        for c in self.helps]}


def plan(*, distance: float | None = None, speed: float | None = None,
         turns: int | None = None, standstill: float | None = None, acceleration: float = 1.0,
         scenario: str | None = None, duration: float | None = None,
         gpx: Path | str | None = None, bag: Path | str | None = None,
         topics: Mapping[str, str] | None = None, config: Settings = None,
         **figures: float) -> Planned:
    """
    Predict the sigmas of one drive.

    Parameters
    ----------
    distance, speed, turns, standstill, acceleration
        m, m/s, turns of 90 deg, s at rest at either end, m/s^2: a drive by its figures.
    scenario, duration
        That of a simulated one, s.
    gpx
        That of a GPX track; one without times is driven at ``speed``.
    bag, topics
        That of a recorded bag, with the figures of its own fixes.
    config : Config, mapping of dotted names, or a parameter file, optional
        Settings: IMU grade, heading source and the like.
    figures
        As ``plan.predict.Sigmas`` has them: fix, fix_up m, fix_rate Hz, quantum m a count,
        sway m/s, slip m/sqrt(s).

    Raises
    ------
    BadUsage, BadConfig
        Not one drive is given, or it makes no sense.

    """
    kinds = {'scenario': scenario, 'gpx': gpx, 'bag': bag, 'distance': distance}
    given = [kind for kind, value in kinds.items() if value is not None]
    if len(given) != 1:
        raise BadUsage('plan: give one drive: --scenario NAME, --gpx FILE, --bag BAG, or '
                       f'--distance with --speed{"; not " if given else ""}'
                       f'{" and ".join("--" + k for k in given)}')
    if duration is not None and not scenario:
        raise BadUsage('--duration requires --scenario; otherwise distance and speed give it')
    if given[0] != 'distance' and (standstill is not None or turns is not None):
        raise BadUsage(f'--standstill and --turns require --distance, not --{given[0]}')
    if speed is not None and not (math.isfinite(speed) and speed > 0):
        raise BadUsage(f'--speed {speed:g}: required: a number above 0')
    settings = config_of(config)
    own: dict[str, Any] = {}
    if scenario:
        drive = planned_drives.from_scenario(scenario, duration)
    elif gpx:
        drive = planned_drives.from_gpx(Path(gpx), speed)
    elif bag:
        drive, own = planned_drives.from_bag(Path(bag), settings, dict(topics or {}))
    else:
        assert distance is not None
        drive = _of_figures(distance, speed, standstill, turns, acceleration)
    if 'fix' in figures:
        own |= {'fix_up': None}
    sigmas = Sigmas(config=settings, **(own | figures))
    return Planned(drive, sigmas, plan_methods(drive, sigmas))


def _of_figures(distance: float, speed: float | None, standstill: float | None, turns: int | None,
                acceleration: float) -> PlannedDrive:
    if speed is None:
        raise BadUsage('--distance needs --speed, m/s')
    return planned_drives.from_figures(speed, distance, 30.0 if standstill is None else standstill,
                                       turns or 0, acceleration)
