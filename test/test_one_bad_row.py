# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A row or a method that breaks costs itself, never the leg."""

from dataclasses import replace

from drives import changed, drive, everything_said, settings
import numpy as np
import pytest

from odocal_ros.calib.failed import traces
from odocal_ros.pipeline import methods as leg_methods
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code, Verdict

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def made():
    return drive(scenario='town', duration=120.0, imu_grade='industrial', seed=4)


@pytest.fixture(scope='module')
def config(made):
    return settings(made, method='auto')


@pytest.fixture(scope='module')
def whole(made, config):
    """Return what the leg says with nothing wrong."""
    return calibrate(made.leg(), config)


BAD_COVARIANCES = [
    np.ones((3, 3)),                                        # E and N fully correlated
    [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]],    # a correlation of two
    [[1.0, 1 - 1e-9, 0.0], [1 - 1e-9, 1.0, 0.0], [0.0, 0.0, 1.0]],
    [[1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]],    # only with the height
    [[2.0, 0.0, 0.0], [3.0, 2.0, 0.0], [0.0, 0.0, 9.0]],    # not symmetric
    np.diag([1e-300, 1e-300, 1.0]), np.diag([1e300, 1.0, 1.0]), np.full((3, 3), 5e-324)]


def test_covariances_that_are_none(made, config, whole):
    leg = made.leg()

    def some(covariance):
        covariance[::len(covariance) // 8][:8] = BAD_COVARIANCES
    result = calibrate(replace(leg, fix=changed(leg.fix, covariance_n=some)), config)
    assert Code.METHOD_FAILED not in everything_said(result)
    for name in ('smoother', 'two_point'):
        mine, other = (r.methods[name].estimates['scale_factor'] for r in (result, whole))
        assert mine.value == pytest.approx(other.value, abs=other.sigma)   # eight fixes of many


@pytest.mark.parametrize('broken', ['two_point', 'smoother'])
def test_a_fault_in_a_method_costs_that_method(made, config, whole, monkeypatch, broken):
    def breaks(prepared, passed):
        raise np.linalg.LinAlgError('Singular\nmatrix')
    monkeypatch.setitem(leg_methods.METHODS, broken, breaks)
    result = calibrate(made.leg(), config)
    reason, = (r for r in result.methods[broken].reasons if r.code is Code.METHOD_FAILED)
    assert (f'method {broken} failed with an internal error: LinAlgError (Singular matrix) in '
            'breaks') in reason.text
    (name, trace), = traces([result])
    assert name == broken
    assert 'Traceback' in trace
    other, = {'two_point', 'smoother'} - {broken}
    assert result.methods[other].estimates == whole.methods[other].estimates
    # two legs of it, too: the combination knows what is missing
    later = replace(result, start_ns=result.stop_ns, stop_ns=2 * result.stop_ns - result.start_ns)
    both = combine([result, later], config)
    assert both.estimates['scale_factor'].method == other
    assert both.verdict is not Verdict.REJECTED
