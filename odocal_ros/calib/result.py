# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results: estimates with sigmas and units, of a method, of a leg, and of all legs combined."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
import traceback
from typing import Any

import numpy as np

from odocal_ros.calib.evidence import Evidence
from odocal_ros.calib.marginal_information import CarriedInformation, MarginalInformation
from odocal_ros.data.arrays import Floats
from odocal_ros.reasons import Code, Reason, SEVERITY, Verdict, verdict_of

# keys of a result in calibration.json that are not estimates
NOT_ESTIMATES = frozenset({
    'imu_rotation', 'scale_by_speed', 'scale_by_time', 'scale_by_left_force', 'scale_by_curvature',
    'scale_ratio_next_drive_sigma', 'yaw_mounting_angle_housing_sigma',
    'pitch_mounting_angle_housing_sigma'})
RAW_SCALE = 'scale_factor_as_sent'     # of a quantised speed as published
WHEEL_PREFIX = 'scale_factor_'     # format: before the name of a wheel
TRACE = 'trace'      # format: key in the details of a method that raised an exception: traceback


@dataclass(frozen=True)
class Estimate:
    """A number with its sigma (1 standard deviation) and unit; None: not determined."""

    value: float | None
    sigma: float | None
    unit: str
    method: str = ''

    @property
    def relative_sigma(self) -> float | None:
        """Return the sigma over the size of the value, None without them."""
        return self.sigma / abs(self.value) if self.value and self.sigma is not None else None

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of calibration.json."""
        entry = {'value': self.value, 'sigma': self.sigma, 'unit': self.unit}
        return entry | ({'method': self.method} if self.method else {})


def unknown_values(scale_unit: str) -> dict[str, Estimate]:
    """Return the estimates that every result has, without values."""
    units = {'scale_factor': scale_unit, 'scale_ratio': '1', 'yaw_mounting_angle': 'rad',
             'pitch_mounting_angle': 'rad'}
    return {name: Estimate(None, None, unit) for name, unit in units.items()}


def wheel_factors(estimates: Iterable[str]) -> list[str]:
    """Return the names of the scale factors of single wheels."""
    return [name for name in estimates if name.startswith(WHEEL_PREFIX) and name != RAW_SCALE]


@dataclass(frozen=True, eq=False)
class Source:
    """One source of error of p parameters, as one-sigma effects."""

    name: str
    effects: Floats       # (p, k) of k independent unit errors; relative for a scale factor
    shared: bool = False  # the same in every leg of a vehicle (heading source, lever arm)


@dataclass(frozen=True, eq=False)
class MethodResult:
    """The result of one method on one leg, or on all."""

    name: str
    reasons: tuple[Reason, ...]
    estimates: dict[str, Estimate] = field(default_factory=dict)
    parameters: tuple[str, ...] = ()  # names, in the order of the rows of the sources
    sources: tuple[Source, ...] = ()
    details: dict[str, Any] = field(default_factory=dict)
    marginal: MarginalInformation | None = None    # None: the method has none

    @cached_property
    def verdict(self) -> Verdict:
        """Return the most severe verdict of the reasons."""
        return verdict_of(self.reasons)


@dataclass(frozen=True)
class TrackCheck:
    """Distance of the dead-reckoned track from the fixes, m."""

    rms: float
    max: float
    mean: float
    end: float
    percent_of_distance: float


@dataclass(frozen=True)
class PerDistance:
    """Error of dead reckoning a path length after a fix, before and after calibration: rms, m."""

    length: float  # m driven
    before: float
    after: float
    pieces: float  # number of pieces of this length in the path


@dataclass(frozen=True, eq=False)
class LegResult:
    """Everything computed from one leg."""

    start_ns: int                         # stamps of the marks
    stop_ns: int
    distance: float                       # m, path length
    duration: float                       # s
    imu_samples: int                      # numbers of usable rows
    pulses: int                           # of the odometer
    fixes: int
    rejected_fixes: int
    reasons: tuple[Reason, ...]           # of the leg, for all methods
    methods: dict[str, MethodResult]
    before: TrackCheck | None = None      # with the configured values
    after: TrackCheck | None = None       # with the calibrated values
    per_distance: tuple[PerDistance, ...] = ()
    track_n: Floats | None = None         # (m, 3) corrected dead reckoning, n, m
    track_before_n: Floats | None = None  # (m, 3) as configured
    reference_n: Floats | None = None     # (k, 3) fixes used
    origin: tuple[float, float, float] | None = None  # latitude, longitude rad, height m of n
    bag: str = ''                         # recording of the leg, empty when live
    C_bi: Floats | None = None            # (3, 3) nominal rotation used, imu frame to b
    deciding: tuple[str, ...] = ()        # names of the methods whose verdict counts, () all
    evidence: Evidence | None = None      # plot data, None if no track was usable
    path_ratio: float | None = None       # median ratio of distance between fixes to travel
    cut_from_ns: int | None = None        # start mark of the leg of which this is a section

    @property
    def drive_start_ns(self) -> int:
        """Return the start of the drive, ns, common to its sections: no scale drift in between."""
        return self.start_ns if self.cut_from_ns is None else self.cut_from_ns

    @cached_property
    def verdict(self) -> Verdict:
        """Return the most severe of the leg's reasons and its best deciding method's verdict."""
        best = min((m.verdict for name, m in self.methods.items()
                    if name in (self.deciding or self.methods)), key=SEVERITY.index,
                   default=Verdict.REJECTED)
        return Verdict.worst([verdict_of(self.reasons), best])

    @property
    def all_reasons(self) -> tuple[Reason, ...]:
        """Return the reasons of the leg and of its methods."""
        return self.reasons + tuple(r for m in self.methods.values() for r in m.reasons)

    def without_plot_data(self) -> 'LegResult':
        """Return the data for a combination and its tables."""
        methods = {name: replace(method, details={
            key: value for key, value in method.details.items()
            if not isinstance(value, np.ndarray)}) for name, method in self.methods.items()}
        return replace(self, methods=methods, track_n=None, track_before_n=None,
                       reference_n=None, evidence=None)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The combined result of all legs, as published and written."""

    reasons: tuple[Reason, ...]
    estimates: dict[str, Estimate]
    methods: dict[str, MethodResult]
    legs: tuple[LegResult, ...]
    imu_rotation_xyzw: tuple[float, ...] | None = None  # base_link <- imu frame
    imu_rotation_rpy: tuple[float, ...] | None = None
    carried: CarriedInformation | None = None  # information for later legs

    @property
    def verdict(self) -> Verdict:
        """Return the most severe verdict of the reasons."""
        return verdict_of(self.reasons)


def has_local_fixes(legs: Iterable[LegResult]) -> bool:
    """Return True if the fixes of a leg are in a local frame: of SLAM, motion capture, ..."""
    return any(reason.code is Code.LOCAL_FRAME for leg in legs for reason in leg.reasons)


def name_antenna(text: str, is_local: bool) -> str:
    """Return a text about the antenna; with positions in a local frame it is a tracked point."""
    return text.replace('antenna', 'tracked point') if is_local else text


def raise_on_overflow() -> np.errstate:
    """Return a context in which overflow raises FloatingPointError instead of a warning."""
    return np.errstate(over='raise', divide='raise', invalid='raise')


def failure(refuse: Callable[[Reason], MethodResult], name: str, error: Exception) -> MethodResult:
    """Return the result of a method that raised; refuse: returns a result without values."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    text = ' '.join(str(error).split())[:200]
    reason = Reason(Code.METHOD_FAILED, f'method {name} failed with an internal error: '
                    f'{type(error).__name__}{f" ({text})" if text else ""} in {place.name}, line '
                    f'{place.lineno}')
    return replace(refuse(reason), details={TRACE: ''.join(traceback.format_exception(error))})


def traces(legs: Iterable[LegResult]) -> Iterator[tuple[str, str]]:
    """Yield (method, trace) of each method that raised."""
    for leg in legs:
        for name, method in leg.methods.items():
            if TRACE in method.details:
                yield name, method.details[TRACE]
