# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

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
