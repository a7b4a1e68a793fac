# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
