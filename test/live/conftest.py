# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Fixtures of the node's tests: a ROS domain of their own, nodes and clients that end."""

from importlib.util import find_spec
import os
from pathlib import Path
import random
import re
import socket

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


@pytest.fixture(scope='session')
def domain():
    """Take a ROS domain that no other test run on this machine has, for the whole session."""
    for _ in range(200):
        number = random.randint(1, 100)
        lock = socket.socket()
        try:
            lock.bind(('127.0.0.1', 21000 + number))
        except OSError:
            lock.close()
            continue
        break
    os.environ['ROS_DOMAIN_ID'] = str(number)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    yield number
    lock.close()


@pytest.fixture
def start(domain, tmp_path):
    """Return a function that starts the node as a process; all end with the test."""
    started = []

    def run(*args: str, **kwargs) -> NodeProcess:
        started.append(NodeProcess('-p', f'output.directory:={tmp_path}', *args, **kwargs))
        return started[-1]

    yield run
    for process in started:
        process.end()


@pytest.fixture
def connect(domain):
    """Return a function that connects a client; all end with the test."""
    connected = []

    def run(name: str = 'calibrator') -> Client:
        connected.append(Client(name))
        return connected[-1]

    yield run
    for client in connected:
        client.close()
