# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Messages lost before the node took them: in a full queue or on the network."""

AGAIN = 10     # judgement: times as many as were said, to say it again


class LossReport:
    """Turns counts of lost messages into sentences, each topic again at ten times the number."""

    def __init__(self) -> None:
        self._said: dict[str, int] = {}

    def news(self, lost: dict[str, int]) -> list[str]:
        """
        Return the new sentences.

        lost : topic -> messages so far; fewer than before: a new count.
        """
        found = []
        for topic, count in lost.items():
            said = self._said.get(topic, 0)
            if count < said:
                said = self._said[topic] = 0
            if count >= max(1, AGAIN * said):
                self._said[topic] = count
                found.append(f'{words({topic: count})}. Likely cause: CPU load or network. Reduce '
                             'the load, or set the QoS of the topic to reliable')
        return found


def words(lost: dict[str, int]) -> str:
    """Return the counts as text, empty if nothing is lost."""
    return ', '.join(f'{count} message{"s" * (count != 1)} of {topic} lost'
                     for topic, count in lost.items() if count)
