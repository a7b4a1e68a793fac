# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A folder that nobody else has."""

import pytest

from odocal_ros.outside import whole


def test_folders_of_one_name_are_numbered_up_to_a_bound(tmp_path, monkeypatch):
    monkeypatch.setattr(whole, 'MOST_SAME_NAME', 3)
    made = [whole.new_folder(tmp_path / 'root', 'leg').name for _ in range(3)]
    assert made == ['leg', 'leg-2', 'leg-3']
    with pytest.raises(OSError, match='holds 3 folders named leg'):
        whole.new_folder(tmp_path / 'root', 'leg')
