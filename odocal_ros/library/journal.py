# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What a journal of the node says beside its messages: settings and topics of its leg."""

from dataclasses import dataclass, field
from pathlib import Path

from odocal_ros.bagio.numbered import JOURNAL
from odocal_ros.bagio.read import TopicInfo
from odocal_ros.data.leg import SLOTS
from odocal_ros.errors import BadUsage
from odocal_ros.outside.limits import is_file

BLOCK = 'odocal_journal'


@dataclass(frozen=True)
class JournalNotes:
    """Settings by dotted name, slot -> topic, and where they were found."""

    path: Path
    settings: dict[str, object] = field(default_factory=dict)
    topics: dict[str, str] = field(default_factory=dict)

    def topics_in(self, bag_topics: dict[str, TopicInfo]) -> dict[str, str]:
        """Return slot -> topic of those that have messages in the bag."""
        return {slot: topic for slot, topic in self.topics.items()
                if topic in bag_topics and bag_topics[topic].count}


def journal_notes(bag: Path) -> JournalNotes | None:
    """
    Return the metadata of a journal from its folder or a file; None for other bags.

    Raises
    ------
    BadUsage, BadConfig
        Its settings cannot be read, or are not those of this version.

    """
    path = (bag if bag.is_dir() else bag.parent) / JOURNAL
    if not path.exists():
        return None
    if not is_file(path):
        raise BadUsage(f'{path}: is not a regular file; remove it to replay the bag')
    from odocal_ros.settings.config_file import read_journal_file
    settings, about = read_journal_file(path, BLOCK)
    topics = {slot: about[f'topics.{slot}'] for slot in SLOTS if f'topics.{slot}' in about}
    return JournalNotes(path, settings, topics)
