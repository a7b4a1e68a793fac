# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is said of the work on a leg."""

import pytest

from odocal_ros.pipeline.prepared import Stage

pytestmark = pytest.mark.core


@pytest.mark.parametrize(('stage', 'words'), [
    (Stage(), ''),
    (Stage('two_point', 0.0), 'two_point'),
    (Stage('smoother', 0.1, 1, 51234.5), 'smoother, 1 pass done, remaining change 51234 sigma'),
    (Stage('smoother', 0.1, 7, 0.4249), 'smoother, 7 passes done, remaining change 0.42 sigma'),
])
def test_it_says_passes_and_change_and_no_share(stage, words):
    assert stage.words() == words
