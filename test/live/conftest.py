# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fixtures of the node's tests: nodes and clients that end."""

from importlib.util import find_spec
from pathlib import Path
import re

from bench import Client, NodeProcess
import pytest

HAVE_ROS = find_spec('rclpy') is not None
# what needs a real node, by itself or by a helper; the pure parts of live/ are tested everywhere
NEEDS_ROS = re.compile(r'^ *(import|from) (rclpy|bench|kills|player|wire)\b', re.MULTILINE)
collect_ignore = [] if HAVE_ROS else [
    path.name for path in Path(__file__).parent.glob('test_*.py')
    if NEEDS_ROS.search(path.read_text())]


def pytest_report_header():
    """Say loudly that the node was not tested."""
    return None if HAVE_ROS else ('LIVE NODE NOT TESTED: no rclpy here; source ROS 2 Jazzy or pip '
                                  'install odocal_ros[ros]')


@pytest.fixture
def start(tmp_path):
    """Return a function that starts the node as a process; all end with the test."""
    started = []

    def run(*args: str, **kwargs) -> NodeProcess:
        started.append(NodeProcess('-p', f'output.directory:={tmp_path}', *args, **kwargs))
        return started[-1]

    yield run
    for process in started:
        process.end()


@pytest.fixture
def connect():
    """Return a function that connects a client; all end with the test."""
    connected = []

    def run(name: str = 'calibrator') -> Client:
        connected.append(Client(name))
        return connected[-1]

    yield run
    for client in connected:
        client.close()
