# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fixtures of all tests: real drives, and a ROS domain that no other process uses."""

import os
from pathlib import Path
import random
import socket

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get('ODOCAL_DATA') or ROOT.parent / 'shared' / 'data')


def _own_domain():
    """Take a ROS domain that no other test run holds; a bound port is the lock."""
    for domain in random.SystemRandom().sample(range(1, 101), 100):
        lock = socket.socket()
        try:
            lock.bind(('127.0.0.1', 22119 + domain))    # the ports that domain_coordinator uses
        except OSError:
            lock.close()
            continue
        return domain, lock
    raise RuntimeError('all ROS domains are taken by other test runs')


# no deadline: a test does not fail on a busy computer
hypothesis.settings.register_profile('untimed', deadline=None)
hypothesis.settings.load_profile('untimed')
# at import, since rclpy and every process started by a test read them once
DOMAIN, _lock = _own_domain()
os.environ['ROS_DOMAIN_ID'] = str(DOMAIN)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.pop('ROS_LOCALHOST_ONLY', None)      # deprecated, and it takes precedence
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')      # as in the commands: the same digits


def pytest_collection_modifyitems(items):
    """Mark what is in live/ (live) and what needs the recordings (data); put slow tests first."""
    for item in items:
        marks = {'live': item.path.parent.name == 'live', 'data': 'data_dir' in item.fixturenames}
        for mark in (name for name, there in marks.items() if there):
            item.add_marker(mark)
    # otherwise one worker ends with a long file while the other is idle
    items.sort(key=lambda item: ('live' not in item.keywords, 'slow' not in item.keywords))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Treat tests of the node as one file with --dist loadfile: they disturb each other."""
    if config.option.dist != 'loadfile':
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return 'live' if '/live/' in nodeid else super()._split_scope(nodeid)

    config.option.loadscopereorder = False      # by how many tests a file has
    return Scheduling(config, log)


def pytest_runtest_setup(item):
    """Give tests of the node, which run in real time, priority over those of other workers."""
    if 'PYTEST_XDIST_WORKER' in os.environ and 'live' not in item.keywords:
        os.setpriority(os.PRIO_PROCESS, 0, 5)


def pytest_report_header() -> list[str]:
    """Return a header line with the recordings that tests of real drives find."""
    found = DATA if DATA.is_dir() else f'MISSING at {DATA}: tests of real drives are skipped'
    return [f'ROS domain: {DOMAIN}', f'real drives: {found}']


class Recordings:
    """The folder of real recordings; a test of a missing one is skipped."""

    def __truediv__(self, name: str) -> Path:
        first = DATA / Path(name).parts[0]
        if not first.exists():
            pytest.skip(f'NO REAL DATA at {first}: set ODOCAL_DATA to the folder of recordings')
        return DATA / name

    def rglob(self, pattern: str):
        """Return the files of all available recordings."""
        return DATA.rglob(pattern)


@pytest.fixture(scope='session')
def data_dir() -> Recordings:
    """Return the folder of real recordings, or skip with a message."""
    if not DATA.is_dir():
        pytest.skip(f'NO REAL DATA at {DATA}: set ODOCAL_DATA to the folder of recordings')
    return Recordings()


@pytest.fixture(scope='module')
def made(request):
    """Return the drive with the options ``MADE`` of a module, by default the straight one."""
    import drives
    return drives.drive(**getattr(request.module, 'MADE', drives.STRAIGHT))


@pytest.fixture
def leg(made):
    return made.leg()


@pytest.fixture(scope='session')
def town():
    import drives
    return drives.drive(**drives.TOWN)
