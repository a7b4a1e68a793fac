# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The worker: what was asked for is done before the node ends, a long job does not hold it."""

import threading
import time

import pytest

from odocal_ros.live.worker import Worker

pytestmark = pytest.mark.core


def test_jobs_given_before_the_end_are_done():
    done, gate, w = [], threading.Event(), Worker()
    w.submit(lambda: gate.wait(5.0), lambda *_: None)
    w.submit(lambda: done.append('saved'), lambda *_: None)
    threading.Timer(0.05, gate.set).start()
    assert w.close()
    assert done == ['saved']


def test_a_long_job_does_not_hold_the_end():
    gate, w = threading.Event(), Worker()
    w.submit(gate.wait, lambda *_: None)
    began = time.monotonic()
    assert not w.close(0.05)       # returns though the job has not ended
    assert not gate.is_set()
    assert time.monotonic() - began < 60.0
    gate.set()
