# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The settings of a leg beside its journal: a parameter file that says what it is."""

from datetime import datetime, UTC

from odocal_ros import __version__
from odocal_ros.outside.names import for_shell
from odocal_ros.outside.yaml_text import parameters
from odocal_ros.settings.config import Config, flat

HEAD = """\
# Journal of a leg: 'odocal replay' on this folder computes it again with the settings below,
# which are those in force when the leg was started. They are a ROS parameter file too:
# --params-file, ros2 param load, odocal replay --config.
"""


def journal_text(config: Config, leg_id: int, start_ns: int, topics: dict[str, str],
                 node: str = '') -> str:
    """Return the text of journal.yaml; ``topics`` are slot -> topic, ``node`` its full name."""
    about = {'software': f'odocal_ros {__version__}', 'node': node, 'leg_id': leg_id,
             'leg_start_ns': start_ns}
    about |= {f'topics.{slot}': topic for slot, topic in topics.items()}
    return HEAD + parameters(flat(config)) + parameters(about, 'odocal_journal')


def replay_command(folder: str, start_ns: int) -> str:
    """Return the command that computes a cancelled leg from its journal, mark to last sample."""
    seconds, nanoseconds = divmod(start_ns, 10**9)
    start = f'{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{nanoseconds // 1000:06}'
    return for_shell(['odocal', 'replay', folder, '--leg', f'{start}/'])
