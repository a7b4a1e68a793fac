# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Predicted accuracy of a calibration before the drive, and possible improvements."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
import math
from pathlib import Path
from typing import Any

import numpy as np

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.errors import BadUsage
from odocal_ros.forecast import planned_drive
from odocal_ros.forecast.planned_drive import PlannedDrive, REST_SPEED
from odocal_ros.forecast.planned_methods import keyframe_spacing, Plan, plan_methods
from odocal_ros.forecast.predict import predict, Sigmas
from odocal_ros.library import drive_sources
from odocal_ros.library.arguments import config_of, Settings
from odocal_ros.output.value_text import duration_text, length_text
from odocal_ros.pipeline.combination import combine_results
from odocal_ros.settings.config import GRADES, with_settings

SCALE, YAW, _ = PARAMETERS
RTK_SIGMA = 0.02                  # m, physical: of a fix, by receivers' data sheets
DEFAULT_REST = 30.0               # s, judgement: standstill at a mark, if not given


@dataclass(frozen=True)
class TestedChange:
    """A change of the planned drive or its sensors, and the sigmas that result."""

    text: str
    sigmas: dict[str, float | None]     # of scale, relative, and yaw, rad; None: not determined

    def gain(self, before: Plan, parameter: str) -> float:
        """Return the ratio of the old to the new sigma; inf if there was none before."""
        new_sigma, old_sigma = self.sigmas[parameter], before.sigma(parameter)
        if new_sigma is None:
            return 1.0 if old_sigma is None else 0.0
        return math.inf if old_sigma is None else old_sigma / new_sigma


def _tested_changes(plan: 'Planned') -> list[TestedChange]:
    """Return the changes of drive and sensors, each with the sigmas that it leads to."""
    # with the keyframe spacing of this drive: a wider one alone makes a sigma larger
    spacing = keyframe_spacing(plan.drive)
    variants = [(text, drive, plan.sigmas) for text, drive in _other_drives(plan)]
    variants += [(text, plan.drive, sigmas) for text, sigmas in _better_sensors(plan)]
    results = []
    for text, drive, sigmas in variants:
        after = plan_methods(drive, sigmas, spacing)
        results.append(TestedChange(text, {name: after.sigma(name) for name in (SCALE, YAW)}))
    return results + _second_leg(plan)


def _other_drives(plan: 'Planned') -> Iterator[tuple[str, PlannedDrive]]:
    """Yield (text, drive) of drives that are longer or have more manoeuvres."""
    drive = plan.drive
    yield f'{length_text(drive.distance)} more, straight ahead', drive.lengthen(drive.distance)
    min_rest = 60.0    # s
    rest = max(min_rest, *plan.two_point.rests)
    yield f'standing {duration_text(rest)} longer at both marks', drive.lengthen_rests(rest)
    yield 'one more stop and start', planned_drive.add_stop_and_start(drive)
    yield 'one more left turn and right turn', planned_drive.add_left_and_right_turns(drive)
    town_minutes = 5
    yield (f'{town_minutes} min more, stop and go with turns',
           planned_drive.add_town_driving(drive, town_minutes))
    farthest = _until_farthest(drive, plan.sigmas.config.leg.standstill)
    if farthest is not None:
        yield f'end mark at the farthest point ({length_text(farthest.distance)})', farthest


def _better_sensors(plan: 'Planned') -> Iterator[tuple[str, Sigmas]]:
    """Yield (text, sigmas) with better fixes, heading and IMU."""
    sigmas, alignment = plan.sigmas, plan.two_point.alignment
    if sigmas.fix > 2 * RTK_SIGMA:
        yield (f'RTK fixes ({RTK_SIGMA:g} m)',
               replace(sigmas, fix=RTK_SIGMA, fix_up=2 * RTK_SIGMA))
    heading_sigma = alignment.heading_sigma if alignment.heading_separable else math.inf
    two_antennas = math.radians(0.1)    # sigma of a heading with a base line of 1 to 2 m
    better_sigma = two_antennas if heading_sigma > 2 * two_antennas else heading_sigma / 2
    config = with_settings(sigmas.config, {'alignment.heading_source': 'heading_topic',
                                           'alignment.heading_sigma': better_sigma})
    yield (f'a heading with {math.degrees(better_sigma):.2g} deg uncertainty',
           replace(sigmas, config=config))
    better_grades = GRADES[GRADES.index(sigmas.config.imu.grade) + 1:]
    if better_grades:
        config = with_settings(sigmas.config, {'imu.grade': better_grades[0]})
        yield f'an IMU of {better_grades[0]} grade', replace(sigmas, config=config)


def _until_farthest(drive: PlannedDrive, min_rest: float) -> PlannedDrive | None:
    """Return the drive up to its farthest point, None: its end; min_rest : s of a standstill."""
    inside = drive.t >= 0
    # east + i north, from steps of travel in the direction of the yaw
    position = np.cumsum(np.gradient(drive.travel[inside]) * np.exp(1j * drive.yaw[inside]))
    from_start = np.abs(position - position[0])
    farthest = int(np.argmax(from_start))
    end_share = 0.9    # of the largest distance, at which the end is far enough
    if from_start[-1] > end_share * from_start[farthest]:
        return None
    t_farthest = drive.t[inside][farthest]
    rest = max((end - begin for begin, end in drive.standstills(min_rest)
                if begin <= t_farthest <= end), default=DEFAULT_REST)
    moving = np.flatnonzero((np.abs(drive.speed) > REST_SPEED) & (drive.t <= t_farthest))
    return drive.cut_at(float(drive.t[min(moving[-1] + 1, len(drive.t) - 1)]), rest)


def _second_leg(plan: 'Planned') -> list[TestedChange]:
    """Return the change to two legs, the second in the opposite direction; [] without a scale."""
    if plan.sigma(SCALE) is None:
        return []
    opposite = predict(plan.drive.turn_around(), plan.sigmas).method
    combined: dict[str, float | None] = {SCALE: None, YAW: None}
    for parameter in combined:
        name = plan.method_of(parameter)
        if not name:
            continue
        first = plan.methods[name]
        # the smoother works in body axes: the direction of the drive does not matter
        second = opposite if name == 'two_point' else first
        legs = [_with_dummy_values(leg) for leg in (first, second)]
        both = combine_results(name, legs, (0, round(plan.drive.duration * 1e9)),
                               plan.sigmas.config)
        combined[parameter] = both.estimates[parameter].sigma
    return [TestedChange('a second leg in the other direction', combined)]


def _with_dummy_values(method: MethodResult) -> MethodResult:
    """Return the method with 0 +- 0 for missing values, without which legs are not combined."""
    return replace(method, estimates={
        name: estimate if estimate.value is not None else Estimate(0.0, 0.0, estimate.unit)
        for name, estimate in method.estimates.items()})


@dataclass(frozen=True, eq=False)
class Planned(Plan):
    """The prediction of a drive by each method, with the drive and its errors and settings."""

    drive: PlannedDrive
    sigmas: Sigmas      # errors of the sensors, and settings

    @cached_property
    def improvements(self) -> list[TestedChange]:
        """Return changes of the drive and its sensors; this takes some seconds."""
        return _tested_changes(self)

    def best_improvements(self, parameter: str) -> list[TestedChange]:
        """Return the changes that reduce the sigma of a parameter by over 2 %, best first."""
        gains = [(change.gain(self, parameter), change) for change in self.improvements]
        helpful = [(gain, change) for gain, change in gains if gain > 1 / 0.98]
        helpful.sort(key=lambda pair: (-pair[0], pair[1].sigmas[parameter]))
        return [change for _, change in helpful]

    def to_dict(self) -> dict[str, Any]:
        """
        Return the output of ``odocal plan --json``; sigmas of the scale are relative.

        With ``improvements``, which takes some seconds at the first call.
        """
        sigmas, two_point, alignment = self.sigmas, self.two_point, self.two_point.alignment
        return {
            'drive': {'distance': two_point.distance, 'chord': two_point.chord,
                      'duration': two_point.duration, 'standing': list(two_point.rests)},
            'sigmas': {'imu_grade': sigmas.config.imu.grade,
                       'heading_source': alignment.heading_source,
                       'heading_sigma': alignment.heading_sigma, 'fix_sigma': sigmas.fix,
                       'fix_rate': sigmas.fix_rate, 'correlation_time': sigmas.correlation_time,
                       'pulse': sigmas.quantum, 'sway': sigmas.sway, 'slip_walk': sigmas.slip},
            'verdict': self.verdict.value,
            'reasons': [reason.as_dict() for reason in self.reasons],
            'estimates': {name: {'sigma': self.sigma(name), 'method': self.method_of(name) or None}
                          for name in PARAMETERS},
            'methods': {name: {
                'estimates': {name: {'sigma': e.sigma, 'unit': e.unit}
                              for name, e in method.estimates.items() if name != 'scale_ratio'},
                'reasons': [reason.as_dict() for reason in self.reasons_of(name)],
                'budget': method.details.get('budget', {})}
                for name, method in self.methods.items()},
            'changes': [{'text': change.text, **change.sigmas} for change in self.improvements]}


def plan(*, distance: float | None = None, speed: float | None = None,
         turns: int | None = None, standstill: float | None = None,
         acceleration: float | None = None,
         scenario: str | None = None, duration: float | None = None,
         gpx: Path | str | None = None, bag: Path | str | None = None,
         topics: Mapping[str, str] | None = None, config: Settings = None,
         **errors: float) -> Planned:
    """
    Predict the sigmas of one drive.

    distance, speed, turns, standstill, acceleration : m, m/s, number of 90 deg turns, s at rest
    at start and end (default 30), m/s^2 (default 1): a drive by its figures.   scenario,
    duration : name of a simulated drive, and its duration, s.   gpx : a GPX track; one without
    times is driven at ``speed``.
    bag, topics : a recorded bag, with the accuracy and rate of its fixes; a journal also has its
    settings and topics.   config : as ``calibrate_bag``: IMU grade, heading source and the like.
    errors : fields of ``forecast.predict.Sigmas``: fix, fix_up m, fix_rate Hz, quantum m per
    count, sway m/s, slip m/sqrt(s).

    Raises BadUsage, BadConfig: not exactly one drive is given, or its values are invalid.
    """
    drives = [name for name, value in {'scenario': scenario, 'gpx': gpx, 'bag': bag,
                                       'distance': distance}.items() if value is not None]
    _check_arguments(drives, {'speed': speed, 'turns': turns, 'standstill': standstill,
                             'acceleration': acceleration, 'duration': duration,
                             **{f'{slot}-topic': topic for slot, topic in (topics or {}).items()}})
    from odocal_ros.library.read_bag import journal_notes
    journal = journal_notes(Path(bag)) if bag else None
    settings = config_of(config, journal.settings if journal else None)
    bag_sigmas: dict[str, Any] = {}      # fields of Sigmas
    if scenario:
        drive = drive_sources.from_scenario(scenario, duration)
    elif gpx:
        drive = drive_sources.from_gpx(Path(gpx), speed)
    elif bag:
        drive, bag_sigmas = drive_sources.from_bag(Path(bag), settings, dict(topics or {}),
                                                   journal)
    else:
        assert distance is not None
        assert speed is not None
        drive = drive_sources.from_figures(
            speed, distance, DEFAULT_REST if standstill is None else standstill, turns or 0,
            1.0 if acceleration is None else acceleration)
    if 'fix' in errors:      # fix_up is twice fix, unless it is given
        bag_sigmas |= {'fix_up': None}
    sigmas = Sigmas(config=settings, **(bag_sigmas | errors))
    return Planned(**vars(plan_methods(drive, sigmas)), drive=drive, sigmas=sigmas)


def _check_arguments(drives: list[str], others: dict[str, Any]) -> None:
    """Raise BadUsage if not one drive is given, or if other arguments do not fit it."""
    if len(drives) != 1:
        raise BadUsage('plan: give one drive: --scenario NAME, --gpx FILE, --bag BAG, or '
                       f'--distance with --speed{"; not " if drives else ""}'
                       f'{" and ".join("--" + name for name in drives)}')
    required = {'speed': ('distance', 'gpx'), 'turns': ('distance',), 'standstill': ('distance',),
                'acceleration': ('distance',), 'duration': ('scenario',)}
    for name, value in others.items():
        fitting = required.get(name, ('bag',))      # otherwise a topic
        if value is not None and drives[0] not in fitting:
            raise BadUsage(f'--{name} requires {" or ".join(f"--{drive}" for drive in fitting)}, '
                           f'not --{drives[0]}')
    speed = others['speed']
    if speed is None and drives == ['distance']:
        raise BadUsage('--distance requires --speed, m/s')
    if speed is not None and not (math.isfinite(speed) and speed > 0):
        raise BadUsage(f'--speed {speed:g}: required: a number above 0')
