# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The bag that others are compared with."""

from bag_content import read
import pytest
import ros_bags


@pytest.fixture(scope='session')
def plain(tmp_path_factory):
    return ros_bags.write(tmp_path_factory.mktemp('plain') / 'drive', ros_bags.drive())


@pytest.fixture(scope='session')
def expected(plain):
    return read(plain)[0]
