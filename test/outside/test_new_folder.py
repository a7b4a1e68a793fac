# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A folder that nobody else has."""

import pytest

from odocal_ros.outside import whole


def test_folders_of_one_name_are_numbered_up_to_a_bound(tmp_path, monkeypatch):
    monkeypatch.setattr(whole, 'MOST_SAME_NAME', 3)
    made = [whole.new_folder(tmp_path / 'root', 'leg').name for _ in range(3)]
    assert made == ['leg', 'leg-2', 'leg-3']
    with pytest.raises(OSError, match='holds 3 folders named leg'):
        whole.new_folder(tmp_path / 'root', 'leg')
