# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Two nodes of one name: each says so, for nothing else would tell."""

from bench import NodeProcess, wait_for


def test_two_nodes_of_one_name_say_so(tmp_path):
    nodes = [NodeProcess('-p', f'output.directory:={tmp_path / name}') for name in 'ab']
    try:
        for node in nodes:
            wait_for(lambda node=node: 'another node is called /calibrator' in node.text,
                     'a word about the other node')
            assert node.text.count('another node is called') == 1
    finally:
        assert [node.end() for node in nodes] == [0, 0]
