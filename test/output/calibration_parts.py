# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of the calibrations of ``conftest.py`` that tests of the written files import."""

from dataclasses import replace

from odocal_ros.output import program_files
from odocal_ros.output.files import as_json
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, with_settings

CREATED = '2026-01-02T03:04:05+00:00'
GAP = Reason(Code.TOPIC_GAP, 'odometer gap of 1.2 s at t = 3.1 s')


def texts(calibration, **changes):
    """Return the files for other programs by name; changes of settings as group__name."""
    config = with_settings(Config(), {k.replace('__', '.'): v for k, v in changes.items()})
    return program_files.file_texts(calibration, config, as_json(calibration, config, [], CREATED))


def with_estimates(calibration, **changed):
    return replace(calibration, estimates=calibration.estimates | changed)
