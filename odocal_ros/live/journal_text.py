"""The settings of a leg beside its journal: a parameter file that says what it is."""

from odocal_ros import __version__
from odocal_ros.config import Config, flat
from odocal_ros.yaml_text import parameters

HEAD = """\
# Journal of a leg: 'odocal replay' on this folder computes it again with the settings below,
# which are those in force when the leg was started. They are a ROS parameter file too:
# --params-file, ros2 param load, odocal replay --config.
"""


def journal_text(config: Config, leg_id: int, start_ns: int, topics: dict[str, str]) -> str:
    """Return the text of journal.yaml; ``topics`` are slot -> topic."""
    about = {'software': f'odocal_ros {__version__}', 'leg_id': leg_id, 'leg_start_ns': start_ns}
    about |= {f'topics.{slot}': topic for slot, topic in topics.items()}
    return HEAD + parameters(flat(config)) + parameters(about, 'odocal_journal')
