# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A drive with known truth, as samples or as a bag with a truth file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from odocal_ros.bagio.write import check_target, drive_topics, write_bag
from odocal_ros.errors import BadUsage
from odocal_ros.safe_io.atomic_files import uninterrupted, write_text
from odocal_ros.safe_io.text_formats import for_comment, one_line
from odocal_ros.sim import scenarios
from odocal_ros.sim.scenarios import Drive, SimOptions
from odocal_ros.sim.truth import settings, truth_entries

TRUTH, SETTINGS = 'truth.yaml', 'calibrator.yaml'
MADE_HERE = 'Made by odocal simulate.'


def simulate(scenario: str | SimOptions = 'town', out: Path | str | None = None, *,
             storage: str = 'mcap', compression: str = 'none', force: bool = False,
             heading_sigma: float | None = None,
             progress: Callable[[float], None] | None = None, **options: Any) -> Drive:
    """
    Simulate a drive; equal options give equal drives, to the last bit.

    scenario : paper, straight, out_and_back, town, motorway, oval, yard, indoor or square; or all
    options.   out : bag to write; truth.yaml and calibrator.yaml (the operator's settings) are
    next to it.   storage, compression, force, progress : of ``bagio.write.write_bag``.
    heading_sigma : rad: calibrator.yaml gets a heading of this accuracy.   options : fields of
    SimOptions: duration, seed, imu_grade, fix_noise, two_wheels and so on.

    Raises BadUsage: an option is unknown or out of range; a file exists and ``force`` is not set.
    """
    if out is not None:
        out = Path(out)
        for path in truth_paths(out):
            _check_may_replace(path, force)
        check_target(out, storage, compression, force)
    try:
        drive_options = scenario if isinstance(scenario, SimOptions) else SimOptions(
            scenario=scenario, **options)
    except TypeError as error:
        raise BadUsage(f'simulate: {error}') from None
    drive = scenarios.simulate(drive_options)
    if out is not None:
        write_bag(out, drive_topics(drive), storage, compression, force, progress)
        truth, operator = truth_paths(out)
        node = {'/**/calibrator': {'ros__parameters': settings(drive, heading_sigma)}}
        with uninterrupted():      # a bag is never without its truth
            write_yaml(truth, truth_entries(drive, out.name), f'Truth of {out.name}.')
            write_yaml(operator, node, f'Settings of the operator of {out.name}.')
    return drive


def truth_paths(out: Path) -> list[Path]:
    """Return the paths of truth and settings; with the bag's name if another bag has such."""
    paths = [out.parent / name for name in (TRUTH, SETTINGS)]
    text = paths[0].read_text(encoding='utf-8', errors='replace') if paths[0].exists() else ''
    if MADE_HERE in text and one_line(f'Truth of {out.name}.') not in text:
        return [path.with_name(f'{out.name}.{path.name}') for path in paths]
    return paths


def _check_may_replace(path: Path, force: bool) -> None:
    """Raise BadUsage for an existing file, unless ``force`` is set and a simulation made it."""
    if not path.exists():
        return
    if not force:
        raise BadUsage(f'{path} already exists; give --force to replace it, or --out in another '
                       'folder')
    if MADE_HERE not in path.read_text(encoding='utf-8', errors='replace'):
        raise BadUsage(f'{path} was not made by odocal simulate and is kept; give --out in '
                       'another folder')


def write_yaml(path: Path, content: dict[str, Any], title: str) -> None:
    """Write a YAML file, complete or not at all; title: its first line, a comment."""
    import yaml
    try:
        write_text(path, for_comment(one_line(f'{title} {MADE_HERE}'))
                   + yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    except OSError as error:
        raise BadUsage(f'{path}: cannot write ({error.strerror}); the bag itself is '
                       'complete') from None
