# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What stands at the top of every file that others load."""

from typing import Any

from odocal_ros.calib.result import Calibration
from odocal_ros.output.figures import counted
from odocal_ros.output.summary import sentence
from odocal_ros.outside.names import for_comment, one_line


def head(calibration: Calibration, content: dict[str, Any]) -> str:
    """Return ``about`` as comment lines."""
    return for_comment(about(calibration, content))


def about(calibration: Calibration, content: dict[str, Any]) -> str:
    """Return two lines: what made the file, when, of what, and with which result."""
    inputs = content['inputs']
    bags = ', '.join(str(i['bag']) for i in inputs if i.get('bag')) or 'live'
    bags += ''.join(f', node {i["node"]}' for i in inputs if i.get('node'))
    bags += f', vehicle {content["vehicle"]}' if content.get('vehicle') else ''
    return (f'{content["software"]}, {content["created"]}, '
            f'{counted(len(calibration.legs), "leg")}, from: {one_line(bags)}\n'
            f'{sentence(calibration)}')
