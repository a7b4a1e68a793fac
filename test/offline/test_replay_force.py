# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What replay says when --force replaces a better calibration."""

import json

import pytest

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.calib import result
from odocal_ros.library.calibration import Calibration
from odocal_ros.offline import replay
from odocal_ros.offline.cli import main
from odocal_ros.output.files import write_results
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Write a short drive."""
    return write_bag(tmp_path_factory.mktemp('force') / 'drive', drive_topics(simulate(SimOptions(
        scenario='straight', duration=180.0, imu_rate=20.0, odometer_rate=10.0))))


CREATED = '2026-01-02T03:04:05+00:00'


class Args:
    """Options of a command line."""

    force, json, quiet, holdout = True, False, False, False


@pytest.mark.parametrize('quiet', [False, True])
def test_a_better_one_that_went_is_named(tmp_path, capsys, quiet):
    write_results(result.Calibration((), {}, {}, ()), Config(), tmp_path, [], CREATED)
    args = Args()
    args.quiet = quiet
    worse = result.Calibration((Reason(Code.NO_FIX, 'no fix came'),), {}, {}, ())
    for said in (not quiet, False):      # the second time a rejected one goes: nothing is lost
        assert replay._report(Calibration(worse), tmp_path, args) == 1
        err = capsys.readouterr().err
        assert ('--force replaced a better calibration: the new result is rejected (NO_FIX), the '
                'old one is accepted' in err) == said
        assert bool(err) == said
    assert json.loads((tmp_path / 'calibration.json').read_text())['verdict'] == 'rejected'


def interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize(('where', 'said'), [
    ('odocal_ros.pipeline.calibrate.combine', 'odocal: interrupted, nothing written\n'),
    ('odocal_ros.output.folder._which', 'odocal: interrupted, nothing written\n'),
    ('odocal_ros.output.files.report_or_why', 'the results are in {out}/, report.html is not\n'),
    ('odocal_ros.output.summary.screen', 'the results are in {out}/, report.html is not\n'),
    ('odocal_ros.output.summary.sentence', 'the results are in {out}/\n')])
def test_ctrl_c_is_answered_with_what_happened(bag, tmp_path, capsys, monkeypatch, where, said):
    monkeypatch.setattr(where, interrupted)
    assert main(['replay', str(bag), '--output', str(tmp_path / 'out')]) == 130
    assert capsys.readouterr().err.endswith(said.format(out=tmp_path / 'out'))
    written = (tmp_path / 'out').exists()
    assert written == ('results are' in said)
    assert not list(tmp_path.glob('.*'))
