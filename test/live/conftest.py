# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fixtures of the tests of the node: nodes and clients that end with the test."""

from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
import re

from bench import Client, given, NodeProcess
import pytest

HAVE_ROS = find_spec('rclpy') is not None
# tests that need a real node, also through a helper; the others are run everywhere
NEEDS_ROS = re.compile(r'^ *(import|from) (rclpy|bench|kills|player|wire)\b', re.MULTILINE)
collect_ignore = [] if HAVE_ROS else [
    path.name for path in Path(__file__).parent.glob('test_*.py')
    if NEEDS_ROS.search(path.read_text())]


def pytest_report_header():
    """Report that the node was not tested."""
    return None if HAVE_ROS else ('LIVE NODE NOT TESTED: no rclpy here; source ROS 2 Jazzy or pip '
                                  'install odocal_ros[ros]')


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a node process with settings; end all of them."""
    started = []

    def run(settings: dict | None = None, *words: str, **kwargs) -> NodeProcess:
        started.append(NodeProcess(
            *given({'output.directory': tmp_path} | (settings or {})), *words, **kwargs))
        return started[-1]

    yield run
    for process in started:
        process.end()


@pytest.fixture
def connect():
    """Return a function that connects a client; close all clients."""
    with ExitStack() as ends:
        def run(name: str = 'calibrator') -> Client:
            client = Client(name)
            ends.callback(client.close)
            return client

        yield run


@pytest.fixture
def play_to(start, connect):
    """Return a function that starts a node which listens to a drive, and returns its Drive."""
    def run(driven, settings: dict | None = None, speed: float = 20.0, **kwargs):
        from player import Drive
        return Drive(start(settings, **kwargs), connect(), driven, speed)
    return run
