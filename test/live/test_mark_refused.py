# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""~/mark without points, and points that are none."""


def test_without_points_a_mark_is_refused(start, connect):
    start()
    client = connect()
    client.until(state='waiting')
    answer = client.call('mark')
    assert not answer.success
    assert 'reference.points is empty' in answer.message


def test_points_are_pairs(start):
    node = start('-p', 'reference.points:=[1.0, 2.0, 3.0]')
    assert node.wait() != 0
    assert 'reference.points has 3 values; required with marks' in node.text
    assert 'Traceback' not in node.text
