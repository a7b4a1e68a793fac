# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Bags to one calibration: what ``odocal replay`` does, for any program."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, UTC
from pathlib import Path
from typing import Any

from odocal_ros.calib.result import LegResult
from odocal_ros.errors import BadUsage, OdocalError
from odocal_ros.library.asked import config_of, Leg, legs_of, paths_of, Settings, topics_of
from odocal_ros.library.calibration import Calibration
from odocal_ros.library.hearer import Hearer, Notes
from odocal_ros.library.read_bag import read_bag, readers_of, Recording
from odocal_ros.pipeline.stage import Stage
from odocal_ros.reasons import Reason
from odocal_ros.settings.config import Config

NAMED = {'m/pulse': 'm/pulse (a counter)', 'm/rad': 'm/rad (a joint)', '1': 'm per m (a speed)'}


class LegDropped(BadUsage):
    """A journal holds a leg that the operator dropped."""


def calibrate_bag(path: Path | str | Sequence[Path | str],
                  topics: Mapping[str, str] | None = None, config: Settings = None,
                  legs: Iterable[Leg] | Leg | None = None, *, holdout: bool = False,
                  hearer: Hearer | None = None) -> Calibration:
    """
    Calibrate from a recorded bag, or from several of one vehicle.

    Parameters
    ----------
    path : path, or several
        Bags as ``read_bag`` takes them.
    topics : mapping, optional
        Slot (imu, odometer, odometer_right, fix, fix_velocity, heading) -> topic; the others are
        found by their type.
    config : Config, mapping of dotted names, or a parameter file, optional
        Settings; they go before those of a journal.
    legs : optional
        'A:B' in seconds from the bag's first message, 'A/B' for ISO 8601 dates, 'each-stop', or
        (A, B); one or several. None: as the node marked them, else found by the standstills.
    holdout : bool
        Keep the last fifth of each leg back from the fit and check the correction on it.
    hearer : Hearer, optional
        Is told how it goes.

    Returns
    -------
    Calibration; a drive that cannot be calibrated says why in its reasons.

    Raises
    ------
    BadUsage, BadBag, BadData, BadConfig
        A bag cannot be read or used, or what is asked makes no sense.

    """
    from odocal_ros.library.bags import look_at_all, once, told_apart
    from odocal_ros.output.frames import framed
    from odocal_ros.output.stored import known_imu
    from odocal_ros.pipeline.calibrate import combine
    heard = Notes(hearer or Hearer())
    asked = _Asked(topics_of(topics), config, legs_of(legs), holdout)
    imu = known_imu(config_of(config))
    paths, again = once(paths_of(path))
    for twice in again:
        heard.note(f'{twice} is given twice: it is read once')
    if len(paths) > 1:
        look_at_all(paths, lambda one: _look(one, asked))
    done = _each(paths, asked, heard)
    settings = _settings_of_all(done, heard)
    results, inputs = told_apart([one.path for one in done], [one.legs for one in done],
                                 [one.entry for one in done])
    frame = next((one.imu_frame for one in done if one.imu_frame), '')
    result, settings = framed(combine(results, settings, imu=imu), settings, frame)
    return Calibration(result, settings, tuple(inputs), tuple(heard.said))


@dataclass(frozen=True)
class _Asked:
    topics: dict[str, str]
    config: Settings
    legs: list[Any]
    holdout: bool


def _look(path: Path, asked: _Asked) -> None:
    """Open a bag and see that it has what is wanted of it."""
    from odocal_ros.bagio.read import open_bag
    from odocal_ros.library.journal import journal_notes
    journal = journal_notes(path)
    settings = config_of(asked.config, journal.settings if journal else None)
    with open_bag(path) as bag:
        readers_of(bag, asked.topics, settings, journal)


@dataclass(frozen=True, eq=False)
class _BagLegs:
    """What is kept of a bag: the results of its legs, not its rows."""

    path: Path
    entry: dict[str, Any]
    config: Config
    imu_frame: str
    unit: str
    legs: list[LegResult]


def _each(paths: list[Path], asked: _Asked, heard: Notes) -> list[_BagLegs]:
    """Return what is kept of each bag that is used."""
    from odocal_ros.library.bags import about
    done: list[_BagLegs] = []
    dropped = None
    for path in paths:
        try:
            done.append(_one(path, asked, done[0].unit if done else None, heard))
        except LegDropped as error:
            dropped = error
            if len(paths) > 1:
                heard.note(str(error))
        except OdocalError as error:
            if len(paths) == 1:
                raise
            raise BadUsage(about(path, error)) from None
    if dropped and not done:
        raise dropped
    return done


def _one(path: Path, asked: _Asked, unit: str | None, heard: Notes) -> _BagLegs:
    """Read a bag and calibrate its legs; ``unit`` is that of the scale in the bags before."""
    bag = read_bag(path, asked.topics, asked.config, hearer=heard)
    own = bag.form.scale_unit
    if unit and own != unit:
        raise BadUsage(f'{path}: the scale of its odometer {bag.topics["odometer"]} is in '
                       f'{NAMED[own]}, that of the bags before in {NAMED[unit]}: there is no '
                       'mean of them; calibrate them apart, or name topics of one kind')
    return _BagLegs(path, {'bag': bag.name, 'sha256': bag.sha256, 'topics': bag.topics},
                    bag.config, bag.imu_frame, own, _legs_of(bag, asked, heard))


def _settings_of_all(done: list[_BagLegs], heard: Notes) -> Config:
    """Return the settings of the last bag; a note tells what others have otherwise."""
    from odocal_ros.library.bags import unlike_settings
    if unlike := unlike_settings([one.config for one in done]):
        heard.note(f'{", ".join(unlike)}: not the same in all journals; each leg is computed '
                   f'with its own, limits and files are by those of {done[-1].path.name}')
    return done[-1].config


def _legs_of(bag: Recording, asked: _Asked, heard: Notes) -> list[LegResult]:
    """Return the results of a bag's legs."""
    from odocal_ros.library.legs import open_ended, OPEN_LEG
    if bag.dropped and not asked.legs:
        raise LegDropped(f'{bag.name}: its leg was cancelled or undone, so it is not '
                         'replayed; give --leg : to replay it all the same')
    marks = () if asked.legs else bag.marks
    if any(not stop for _, stop in marks):
        heard.note(f'{bag.name}: {OPEN_LEG}')
    spans = bag.spans(asked.legs)
    notes = [bag.notes + note for note in open_ended(spans, marks)]
    results = _calibrated(bag, spans, notes, asked.holdout, heard)
    if bag.config.leg.automatic and not (marks or asked.legs):
        results = _worth_keeping(results, heard)
    return results


def _calibrated(bag: Recording, spans: list[tuple[int, int]], notes: list[tuple[Reason, ...]],
                holdout: bool, heard: Notes) -> list[LegResult]:
    from odocal_ros.pipeline.parts import calibrate_parts
    results = []
    with heard.phase('calibrating') as progress:
        for number, (start_ns, stop_ns) in enumerate(spans, 1):
            which = f'leg {number} of {len(spans)}: ' if len(spans) > 1 else 'calibrating: '
            leg = bag.recorder.close(start_ns, stop_ns, bag.config.leg.preroll)

            def of_leg(stage: Stage, which: str = which) -> None:
                progress(None, which + stage.words())
            parts = calibrate_parts(leg, bag.config, notes=notes[number - 1], holdout=holdout,
                                    progress=of_leg)
            results += [replace(one, bag=bag.name) for one in parts]
    return results


def _worth_keeping(results: list[LegResult], heard: Notes) -> list[LegResult]:
    """Return legs found by themselves but for those that are no good, as the node has it."""
    from odocal_ros.pipeline.automatic import refusal
    why = [refusal(leg) for leg in results]
    if all(why):
        return results
    for leg, reason in zip(results, why, strict=True):
        if reason:
            start = datetime.fromtimestamp(leg.start_ns // 10**9, UTC)
            heard.note(f'the leg of {start:%Y-%m-%d %H:%M:%S} UTC is not used: '
                       f'{reason.code.name}: {reason.text}')
    return [leg for leg, reason in zip(results, why, strict=True) if not reason]
