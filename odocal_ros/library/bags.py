# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Several bags of one replay: each once, all of them looked at before the first is read."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from odocal_ros.calib.result import LegResult
from odocal_ros.errors import BadUsage, OdocalError
from odocal_ros.outside.names import one_line
from odocal_ros.settings.config import Config, flat


def unique_paths(paths: list[Path]) -> tuple[list[Path], list[Path]]:
    """Return the bags, one given twice once, and those that were given again."""
    first: dict[Path, Path] = {}
    again = []
    for path in paths:
        if path.resolve() in first:
            again.append(path)
        first.setdefault(path.resolve(), path)
    return list(first.values()), again


def about(path: Path, error: Exception) -> str:
    """Return the error of one of several bags, starting with the bag."""
    text = str(error)
    if text.startswith(str(path)):
        return text
    for name in (path.name, path.stem):      # some sentences begin with the bag's name
        text = text.removeprefix(f'{name}: ')
    return f'{path}: {text}'


def look_at_all(paths: list[Path], look: Callable[[Path], object]) -> None:
    """
    Look at each of several bags, so that all errors are reported together, before the work.

    Raises
    ------
    BadUsage
        ``look`` raised for one bag or more.

    """
    troubles = []
    for path in paths:
        try:
            look(path)
        except OdocalError as error:
            troubles.append(about(path, error))
    if troubles:
        raise BadUsage(f'{len(troubles)} of {len(paths)} bags cannot be used; nothing was '
                       f'calibrated: {"; ".join(troubles)}')


def unlike_settings(configs: list[Config]) -> list[str]:
    """Return the names of the settings that differ between bags, as journals bring their own."""
    first, *others = [flat(config) for config in configs]
    # as text: an unset one is NaN, which is not equal to itself
    return [name for name, value in first.items()
            if any(repr(other[name]) != repr(value) for other in others)]


def unique_names(paths: list[Path], legs: list[list[LegResult]],
               inputs: list[dict[str, Any]]) -> tuple[list[LegResult], list[dict[str, Any]]]:
    """
    Return legs and inputs named so that no two bags have one name: by their paths if need be.

    legs : of each bag.   inputs : what is written of each.
    """
    names = [entry['bag'] for entry in inputs]
    if len(set(names)) == len(names):
        return [leg for some in legs for leg in some], inputs
    return ([replace(leg, bag=one_line(path)) for path, some in zip(paths, legs, strict=True)
             for leg in some],
            [entry | {'bag': one_line(path)} for path, entry in zip(paths, inputs, strict=True)])
