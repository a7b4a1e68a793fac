"""What stands at the top of every file that others load."""

from odocal_ros.calib.result import Calibration
from odocal_ros.output.summary import sentence
from odocal_ros.outside import for_comment, one_line


def head(calibration: Calibration, content: dict) -> str:
    """Return ``about`` as comment lines."""
    return for_comment(about(calibration, content))


def about(calibration: Calibration, content: dict) -> str:
    """Return two lines: what made the file, when, from which bags, and with which result."""
    bags = ', '.join(str(i['bag']) for i in content['inputs'] if i.get('bag')) or 'live'
    return (f'{content["software"]}, {content["created"]}, {len(calibration.legs)} leg'
            f'{"s" * (len(calibration.legs) != 1)}, from: {one_line(bags)}\n'
            f'{sentence(calibration)}')
