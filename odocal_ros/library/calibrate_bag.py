# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One calibration from one or several bags of a vehicle: ``odocal replay`` as a function."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from odocal_ros.calib.result import LegResult
from odocal_ros.errors import BadTopics, BadUsage, OdocalError
from odocal_ros.library import arguments
from odocal_ros.library.calibration import Calibration
from odocal_ros.library.find_legs import coverage_reasons, missing_stop_reasons, OPEN_LEG
from odocal_ros.library.read_bag import journal_notes, read_bag, readers_of, Recording
from odocal_ros.output.value_text import iso
from odocal_ros.pipeline.prepared_leg import Stage
from odocal_ros.reasons import Reason
from odocal_ros.safe_io.text_formats import date_text, one_line
from odocal_ros.settings.config import Config, flat

UNIT_TEXTS = {'m/pulse': 'm/pulse (a counter)', 'm/rad': 'm/rad (a joint)',
              '1': 'm per m (a speed)'}


class LegDropped(BadUsage):
    """The operator dropped the leg of a journal."""


def calibrate_bag(path: Path | str | Sequence[Path | str],
                  topics: Mapping[str, str] | None = None, config: arguments.Settings = None,
                  legs: Iterable[arguments.Leg] | arguments.Leg | None = None, *,
                  holdout: bool = False,
                  listener: arguments.Listener | None = None) -> Calibration:
    """
    Calibrate from a recorded bag, or from several of one vehicle.

    path : bags as ``read_bag`` takes them.   topics : slot (imu, odometer, odometer_right, fix,
    fix_velocity, heading) -> topic; the others are found by their type.   config : Config,
    settings by dotted name, or a parameter file; they take precedence over those of a journal.
    legs : 'A:B' in seconds from the bag's first message, 'A/B' for ISO 8601 dates, 'each-stop',
    or (A, B); one or several. None: as the node marked them, else found by the standstills.
    holdout : keep the last fifth of each leg back from the fit and check the correction on it.
    listener : receives notes and progress.

    Returns a Calibration; its reasons name the cause if the drive cannot be calibrated. Raises
    BadUsage, BadBag, BadData, BadConfig: a bag cannot be read or used, or an argument is invalid.
    """
    from odocal_ros.output.program_files import with_imu_frame
    from odocal_ros.output.stored import known_imu
    from odocal_ros.pipeline.calibrate import combine
    notes = arguments.Notes(listener or arguments.Listener())
    request = _Request(arguments.topics_of(topics), config, arguments.legs_of(legs), holdout)
    imu = known_imu(arguments.config_of(config))
    unique: dict[Path, Path] = {}
    for bag_path in arguments.paths_of(path):
        if unique.setdefault(bag_path.resolve(), bag_path) is not bag_path:
            notes.note(f'{bag_path} is given twice; it is read once')
    paths = list(unique.values())
    if len(paths) > 1:
        _check_bags(paths, request)
    bags = _calibrate_bags(paths, request, notes)
    settings = bags[-1].config
    first, *others = [flat(bag.config) for bag in bags]      # each journal has settings
    # as text: an unset one is NaN, which is not equal to itself
    if different := [name for name, value in first.items()
                     if any(repr(other[name]) != repr(value) for other in others)]:
        notes.note(f'{", ".join(different)}: differ between the journals; each leg uses its '
                   f'own settings, limits and files use those of {bags[-1].path.name}')
    results, inputs = unique_names([bag.path for bag in bags], [bag.legs for bag in bags],
                                   [bag.input_entry for bag in bags])
    frame = next((bag.imu_frame for bag in bags if bag.imu_frame), '')
    result, settings = with_imu_frame(combine(results, settings, imu=imu), settings, frame)
    return Calibration(result, settings, tuple(inputs), tuple(notes.texts))


class _Request(NamedTuple):
    """The arguments of ``calibrate_bag``, checked."""

    topics: dict[str, str]
    config: arguments.Settings
    legs: list[arguments.LegSpan | str]
    holdout: bool


def _check_bags(paths: list[Path], request: _Request) -> None:
    """Check each bag for the required data; raise one BadUsage that names all errors."""
    from odocal_ros.bagio.read import open_bag
    errors = []
    for path in paths:
        try:
            journal = journal_notes(path)
            settings = arguments.config_of(request.config, journal.settings if journal else None)
            with open_bag(path) as bag:
                readers_of(bag, request.topics, settings, journal)
        except OdocalError as error:
            errors.append(error_about(path, error))
    if errors:
        raise BadUsage(f'{len(errors)} of {len(paths)} bags cannot be used; nothing was '
                       f'calibrated: {"; ".join(errors)}')


class _BagLegs(NamedTuple):
    """The results of a bag's legs, without the samples, which need much memory."""

    path: Path
    input_entry: dict[str, Any]     # of calibration.json: name, sha256, topics
    config: Config
    imu_frame: str                  # frame_id of the IMU
    unit: str                       # of the scale factor
    legs: list[LegResult]


def _calibrate_bags(paths: list[Path], request: _Request,
                    listener: arguments.Listener) -> list[_BagLegs]:
    """Return the results of each bag; a journal whose leg was dropped is skipped, if not alone."""
    bags: list[_BagLegs] = []
    drop_error = None
    for path in paths:
        try:
            unit = bags[0].unit if bags else None
            bags.append(_calibrate_one_bag(path, request, unit, listener))
        except LegDropped as error:
            drop_error = error
            if len(paths) > 1:
                listener.note(str(error))
        except OdocalError as error:
            if len(paths) == 1:
                raise
            raise BadUsage(error_about(path, error)) from None
    if drop_error and not bags:
        raise drop_error
    return bags


def _calibrate_one_bag(path: Path, request: _Request, previous_unit: str | None,
                       listener: arguments.Listener) -> _BagLegs:
    """Read a bag and calibrate its legs; previous_unit: scale unit of earlier bags."""
    bag = read_bag(path, request.topics, request.config, listener=listener)
    unit = bag.form.scale_unit
    if previous_unit and unit != previous_unit:
        raise BadUsage(f'{path}: the scale of its odometer {bag.topics["odometer"]} is in '
                       f'{UNIT_TEXTS[unit]}, that of the previous bags in '
                       f'{UNIT_TEXTS[previous_unit]}: they cannot be combined; calibrate them '
                       'separately, or name topics of one kind')
    return _BagLegs(path, {'bag': bag.name, 'sha256': bag.sha256, 'topics': bag.topics},
                    bag.config, bag.imu_frame, unit, _calibrate_legs(bag, request, listener))


def _calibrate_legs(bag: Recording, request: _Request,
                    listener: arguments.Listener) -> list[LegResult]:
    """Return the results of the legs of a bag: requested, marked by the node, or searched."""
    if bag.dropped and not request.legs:
        raise LegDropped(f'{bag.name}: its leg was cancelled or undone and is not replayed; use '
                         '--leg : to replay it anyway')
    marks = () if request.legs else bag.marks
    if any(not stop for _, stop in marks):
        listener.note(f'{bag.name}: {OPEN_LEG}')
    spans = bag.spans(request.legs)
    is_searched = not (marks or request.legs)      # between standstills
    coverage = coverage_reasons(bag.recorder) if is_searched else ()
    notes = [bag.notes + coverage + note for note in missing_stop_reasons(spans, marks)]
    results = _calibrate_spans(bag, spans, notes, request.holdout, listener)
    if bag.config.leg.automatic and is_searched:
        return _usable_automatic_legs(results, listener)
    return results


def _calibrate_spans(bag: Recording, spans: list[tuple[int, int]],
                     notes: list[tuple[Reason, ...]], holdout: bool,
                     listener: arguments.Listener) -> list[LegResult]:
    """Return the results of the legs between stamps, ns, each with its notes."""
    from odocal_ros.pipeline.calibrate import calibrate_parts
    results = []
    with listener.phase('calibrating') as progress:
        for number, (start_ns, stop_ns) in enumerate(spans, 1):
            prefix = f'leg {number} of {len(spans)}: ' if len(spans) > 1 else 'calibrating: '
            leg = bag.recorder.close(start_ns, stop_ns, bag.config.leg.preroll)

            def report(stage: Stage, prefix: str = prefix) -> None:
                progress(None, prefix + stage.as_text())
            parts = calibrate_parts(leg, bag.config, notes=notes[number - 1], holdout=holdout,
                                    progress=report)
            results += [replace(part, bag=bag.name) for part in parts]
    return results


def _usable_automatic_legs(results: list[LegResult],
                           listener: arguments.Listener) -> list[LegResult]:
    """Return the usable legs, as the node does; note the others. All if none is usable."""
    from odocal_ros.pipeline.automatic import rejecting_reason
    causes = [rejecting_reason(leg) for leg in results]
    usable = [leg for leg, cause in zip(results, causes, strict=True) if cause is None]
    if not usable:
        return results
    for leg, cause in zip(results, causes, strict=True):
        if cause is not None:
            listener.note(f'the leg of {date_text(iso(leg.start_ns))} is not used: {cause}')
    return usable


def error_about(path: Path, error: Exception) -> str:
    """Return the error of one of several bags, starting with the bag."""
    text = ' '.join(str(error).split()) if isinstance(error, BadTopics) else str(error)
    if text.startswith(str(path)):
        return text
    for name in (path.name, path.stem):      # some texts begin with the bag's name
        text = text.removeprefix(f'{name}: ')
    return f'{path}: {text}'


def unique_names(paths: list[Path], legs: list[list[LegResult]],
                 inputs: list[dict[str, Any]]) -> tuple[list[LegResult], list[dict[str, Any]]]:
    """
    Return the legs of all bags, and the inputs, with bag names that are unique.

    paths, legs, inputs : of each bag. If names are not unique, they are replaced by the paths.
    """
    names = [entry['bag'] for entry in inputs]
    if len(set(names)) < len(names):
        names = [one_line(path) for path in paths]
        legs = [[replace(leg, bag=name) for leg in bag_legs]
                for name, bag_legs in zip(names, legs, strict=True)]
    return ([leg for bag_legs in legs for leg in bag_legs],
            [entry | {'bag': name} for name, entry in zip(names, inputs, strict=True)])
