# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Result files in one folder: calibration.json (schema 1), report, files for other programs.

The folder is replaced as a whole, so that its files belong together; the report is drawn last,
since it takes longest.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from odocal_ros import __version__
from odocal_ros.calib import result
from odocal_ros.errors import BadUsage
from odocal_ros.output import program_files
from odocal_ros.output.report import NAME as REPORT, report_or_error_page
from odocal_ros.output.tables import CHECKS, pooled_check, pooled_per_distance
from odocal_ros.pipeline.acceptance import accept
from odocal_ros.safe_io.atomic_files import ResultFolder
from odocal_ros.settings.config import Config, flat

SCHEMA = 1    # format: version of calibration.json
MAIN = 'calibration.json'


def as_json(calibration: result.Calibration, config: Config, inputs: list[dict[str, Any]],
            created: str) -> dict[str, Any]:
    """
    Return the content of calibration.json.

    calibration : the combination of all legs.   config : its settings.   inputs : name, sha256
    and topics of each bag.   created : ISO 8601 date and time.

    Returns plain dicts and lists, no NaN: a missing number is None.
    """
    values: dict[str, Any] = {
        name: estimate.as_dict() | {'unit': estimate.unit or None,
                                    'method': estimate.method or None}
        for name, estimate in (result.unknown_values('') | calibration.estimates).items()}
    main_method = calibration.methods.get(values['scale_factor']['method'])
    values |= main_method.details.get('beside', {}) if main_method else {}    # no estimates
    values['imu_rotation'] = {'quaternion_xyzw': calibration.imu_rotation_xyzw,
                              'rpy': calibration.imu_rotation_rpy}
    before, after = (pooled_check([(getattr(leg, name), leg.fixes) for leg in calibration.legs])
                     for name in CHECKS)
    content: dict[str, Any] = plain({
        'schema': SCHEMA, 'software': f'odocal_ros {__version__}', 'created': created,
        'vehicle': config.vehicle,
        'verdict': calibration.verdict.value,
        'reasons': [reason.as_dict() for reason in calibration.reasons],
        'result': values,
        'methods': {name: _method(m) for name, m in calibration.methods.items()},
        'legs': [_leg(leg) for leg in calibration.legs],
        'check': _check(before, after, calibration.legs),
        'inputs': inputs,
        'config': flat(config)} | _optional_entries(calibration, config))
    return content


def _optional_entries(calibration: result.Calibration, config: Config) -> dict[str, Any]:
    """Return the entries with acceptance limits, and those with information for later legs."""
    entries: dict[str, Any] = {}
    if (acceptance := accept(calibration, config)) is not None:
        entries['acceptance'] = acceptance.as_dict()
    if calibration.carried:
        from odocal_ros.estimator.state import ACCEL, CONSTANTS, GYRO
        imu_change = 0.1    # change by temperature and time, as a fraction of the prior sigma
        entries['imu'] = calibration.carried.select(
            (*CONSTANTS[GYRO], *CONSTANTS[ACCEL]), imu_change).as_dict()
        if config.leg.automatic:
            entries['carried'] = calibration.carried.as_dict()
    return entries


def _method(method: result.MethodResult) -> dict[str, Any]:
    """Return the entry of a method, without the arrays of its details."""
    details = {key: detail for key, detail in method.details.items()
               if not isinstance(detail, np.ndarray)}
    return {'verdict': method.verdict.value,
            'reasons': [reason.as_dict() for reason in method.reasons],
            'estimates': {name: {'value': estimate.value, 'sigma': estimate.sigma,
                                 'unit': estimate.unit}
                          for name, estimate in method.estimates.items()},
            'correlation': {}, 'budget': {}} | details


def _leg(leg: result.LegResult) -> dict[str, Any]:
    return {'bag': leg.bag, 'start': leg.start_ns * 1e-9, 'stop': leg.stop_ns * 1e-9,
            'start_ns': leg.start_ns, 'stop_ns': leg.stop_ns,
            'distance': leg.distance, 'duration': leg.duration, 'imu_samples': leg.imu_samples,
            'pulses': leg.pulses, 'fixes': leg.fixes, 'rejected_fixes': leg.rejected_fixes,
            'verdict': leg.verdict.value, 'reasons': [r.as_dict() for r in leg.reasons],
            'methods': {name: _method(m) for name, m in leg.methods.items()},
            'check': _check(leg.before, leg.after, [leg])}


def _check(before: result.TrackCheck | None, after: result.TrackCheck | None,
           legs: Sequence[result.LegResult]) -> dict[str, Any]:
    """Return the errors of dead reckoning before and after the calibration, and by distance."""
    return {'before': before and asdict(before), 'after': after and asdict(after),
            'per_distance': [{'length': error.length, 'before': error.before, 'after': error.after}
                             for error in pooled_per_distance(legs)]}


def plain(value: Any) -> Any:
    """Return a value in JSON types: no numpy, no tuples, None for non-finite numbers."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_results(calibration: result.Calibration, config: Config, directory: Path,
                  inputs: list[dict[str, Any]], created: str, force: bool = False,
                  warn: Callable[[str], None] = lambda note: None) -> list[Path]:
    """
    Write the result files, as ``library.Calibration.save``; return their paths.

    Raises KeyboardInterrupt: its text names the written results, if any.
    """
    results = Results(calibration, config, directory, inputs, created)
    with results.name_results_when_interrupted():
        written = results.write(force)
        if cause := results.draw():
            warn(f'{results.report[0]}: could not be drawn: {cause}')
    return written + results.report


class Results:
    """The result files of a calibration: ``write`` all but the report, then ``draw`` it."""

    def __init__(self, calibration: result.Calibration, config: Config, directory: Path,
                 inputs: list[dict[str, Any]], created: str) -> None:
        self.directory = Path(directory)
        self.has_report = 'report' in config.output.formats
        self.report = [self.directory / REPORT] * self.has_report
        self.folder = ResultFolder(self.directory, MAIN,
                                   frozenset(program_files.NAMES | {MAIN, REPORT}))
        self._calibration, self._config = calibration, config
        self._content = as_json(calibration, config, inputs, created)

    def write(self, force: bool = False) -> list[Path]:
        """Write all but the report; return the paths."""
        texts = {MAIN: json.dumps(self._content, indent=2, allow_nan=False) + '\n'}
        texts |= program_files.file_texts(self._calibration, self._config, self._content)
        with self._bad_usage_for_disk():
            self.folder.put(texts, force)
        return [self.directory / name for name in texts]

    def draw(self) -> str:
        """Add the report, if requested; return the cause if it cannot be drawn, else ''."""
        if not self.has_report:
            return ''
        page, cause = report_or_error_page(self._calibration, self._config, self._content)
        with self._bad_usage_for_disk():
            self.folder.add(REPORT, page)
        return cause

    @contextmanager
    def _bad_usage_for_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise BadUsage(
                f'{self.directory}: results cannot be written ({error.strerror}); choose a '
                'writable folder (--output, or output.directory of the node)') from None

    @contextmanager
    def name_results_when_interrupted(self) -> Iterator[None]:
        """Add to the text of an interruption the place of the written results, if any."""
        try:
            yield
        except KeyboardInterrupt:
            if not self.folder.is_unchanged:
                raise
            missing = '' if (self.directory / REPORT).exists() else f', {REPORT} is not'
            raise KeyboardInterrupt(f'the results are in {self.directory}/{missing}') from None
