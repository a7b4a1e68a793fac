"""The settings of a leg beside its journal: a parameter file that says what it is."""

import json
import math

from odocal_ros import __version__
from odocal_ros.config import Config, flat

HEAD = """\
# Journal of a leg: 'odocal replay' on this folder computes it again with the settings below,
# which are those in force when the leg was started. They are a ROS parameter file too:
# --params-file, ros2 param load, odocal replay --config.
"""


def journal_text(config: Config, leg_id: int, start_ns: int, topics: dict[str, str]) -> str:
    """Return the text of journal.yaml; ``topics`` are slot -> topic."""
    settings = {name: _text(value) for name, value in flat(config).items()}
    about = {'software': _text(f'odocal_ros {__version__}'), 'leg_id': str(leg_id),
             'leg_start_ns': str(start_ns)} | {
                 f'topics.{slot}': _text(topic) for slot, topic in topics.items()}
    return HEAD + _block('/**', settings) + _block('odocal_journal', about)


def _block(key: str, values: dict[str, str]) -> str:
    lines = [f'    {name}: {text}\n' for name, text in values.items()]
    return f'{key}:\n  ros__parameters:\n{"".join(lines)}'


def _text(value) -> str:
    """Return a value as rcl and odocal read it back to the last bit."""
    if isinstance(value, tuple):
        return f'[{", ".join(map(_text, value))}]'
    if isinstance(value, float):
        return '.nan' if math.isnan(value) else repr(value)
    return json.dumps(value)     # text in quotes, so that a joint may be named 0 or on
