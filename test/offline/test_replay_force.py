"""What replay says when --force replaces a better calibration."""

import json

import pytest

from odocal_ros.calib.result import Calibration
from odocal_ros.config import Config
from odocal_ros.offline import replay
from odocal_ros.output.files import write_results
from odocal_ros.reasons import Code, Reason

CREATED = '2026-01-02T03:04:05+00:00'


class Args:
    """Options of a command line."""

    force, json, quiet, holdout = True, False, False, False


@pytest.mark.parametrize('quiet', [False, True])
def test_a_better_one_that_went_is_named(tmp_path, capsys, quiet):
    write_results(Calibration((), {}, {}, ()), Config(), tmp_path, [], CREATED)
    args = Args()
    args.quiet = quiet
    worse = Calibration((Reason(Code.NO_FIX, 'no fix came'),), {}, {}, ())
    for said in (not quiet, False):      # the second time a rejected one goes: nothing is lost
        assert replay._report(worse, Config(), [], tmp_path, args) == 1
        err = capsys.readouterr().err
        assert ('a better calibration was replaced, as --force asks: the new one is rejected '
                '(NO_FIX), the old one is accepted' in err) == said
        assert bool(err) == said
    assert json.loads((tmp_path / 'calibration.json').read_text())['verdict'] == 'rejected'
