# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal replay with several bags, and its messages after --force or Ctrl+C."""

import json
import shutil

import pytest

from odocal_ros.bagio.segments import JOURNAL_FILE
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
DAY_NS = 86_400 * 10**9
SHORT = {'scenario': 'straight', 'duration': 220.0, 'imu_rate': 50.0, 'odometer_rate': 20.0}


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('several')
    for day, (name, more) in enumerate({
            'one': {}, 'other': {'scale': 0.03}, 'speed': {'odometer': 'speed'},
            'nofix': {'outages': ((0.0, 220.0),)}, 'wheels': {'two_wheels': True}}.items()):
        options = SimOptions(**SHORT, seed=day + 1,
                             start_ns=SimOptions.start_ns + day * DAY_NS, **more)
        write_bag(folder / name, drive_topics(simulate(options)))
    whole = next((folder / 'other').glob('*.mcap'))
    (folder / 'cut.mcap').write_bytes(whole.read_bytes()[:whole.stat().st_size * 9 // 10])
    (folder / 'foreign.txt').write_text('hello')
    return folder


def replayed(bags, names, out, *options):
    return main(['replay', *(str(bags / name) for name in names), '--output', str(out), '--method',
                 'two_point', '--set', 'output.formats=[params]', *options])


def test_each_unusable_bag_is_named_before_any_bag_is_read(bags, tmp_path, capsys):
    names = ['one', 'cut.mcap', 'nofix', 'wheels', 'foreign.txt', 'nosuch']
    assert replayed(bags, names, tmp_path / 'out') == 2
    printed = capsys.readouterr()
    assert printed.out == ''
    line, = printed.err.splitlines()
    assert line.startswith('odocal: 4 of 6 bags cannot be used; nothing was calibrated: ')
    for name, why in (('nofix', 'no fix: /fix has no messages'),
                      ('wheels', '2 topics can be the odometer'),
                      ('foreign.txt', 'a text file'), ('nosuch', 'no such file')):
        assert f'{bags / name}: {why}' in line
    assert not (tmp_path / 'out').exists()


def test_an_empty_leg_and_mixed_odometer_units_are_errors_with_the_bag(bags, tmp_path, capsys):
    assert replayed(bags, ['one', 'other'], tmp_path / 'out', '--leg', '1000:2000') == 2
    assert f'odocal: {bags / "one"}: the leg 1000.00:2000.00 contains no data' in \
        capsys.readouterr().err
    assert replayed(bags, ['one', 'speed'], tmp_path / 'out') == 2
    line, = (x for x in capsys.readouterr().err.splitlines() if x.startswith('odocal: '))
    assert str(bags / 'speed') in line
    assert 'm per m (a speed), that of the previous bags in m/pulse (a counter)' in line


def test_two_vehicles_are_rejected(bags, tmp_path, capsys):
    assert replayed(bags, ['one', 'other'], tmp_path / 'out') == 1
    stdout = capsys.readouterr().out
    assert 'LEGS_UNLIKE: the scale of leg 2 is 40.' in ' '.join(stdout.split())    # 0.03 / 0.0213
    assert '  leg 1: one; leg 2: other' in stdout.splitlines()


def test_a_truncated_bag_is_accepted_with_a_complete_one(bags, tmp_path, capsys):
    assert replayed(bags, ['other', 'cut.mcap'], tmp_path / 'out', '--json') == 0
    printed = json.loads(capsys.readouterr().out)
    codes = {r['code'] for r in printed['reasons']}
    assert 'LEGS_OVERLAP' in codes
    assert 'BAG_TRUNCATED' not in codes         # of a leg that is not used
    assert 'BAG_TRUNCATED' in {r['code'] for r in printed['legs'][1]['reasons']}


def test_the_settings_of_the_last_used_bag_apply(bags, tmp_path, capsys, monkeypatch):
    """A dropped leg is not used, and neither are its settings."""
    for name, limit in (('one', 3), ('other', 5), ('dropped', 7)):
        shutil.copytree(bags / name.replace('dropped', 'one'), tmp_path / name)
        (tmp_path / name / JOURNAL_FILE).write_text(
            f'/**:\n  ros__parameters:\n    verdict.min_legs: {limit}\n')
    monkeypatch.setattr('odocal_ros.library.read_bag.has_dropped_legs',
                        lambda bag: bag.name == 'dropped')
    notes = {}
    for names in ('one', 'one dropped', 'one other'):
        replayed(tmp_path, names.split(), tmp_path / f'to {names}', '--json')
        printed = capsys.readouterr()
        notes[names] = printed.err
        result = json.loads(printed.out)
        text, = (r['text'] for r in result['reasons'] if r['code'] == 'MORE_LEGS_NEEDED')
        assert text.endswith('required: 5' if 'other' in names else 'required: 3'), names
    assert 'verdict.min_legs: differ between the journals' in notes['one other']
    assert 'use those of other' in notes['one other']
    assert 'not the same' not in notes['one dropped'] + notes['one']


def test_bags_with_the_same_name_are_named_by_their_paths(bags, tmp_path, capsys):
    for name in ('one', 'other'):
        shutil.copytree(bags / name, tmp_path / name / 'bag')
    names = ['one/bag', 'other/bag']
    assert replayed(tmp_path, names, tmp_path / 'out', '--json') == 1
    printed = json.loads(capsys.readouterr().out)
    paths = [str(tmp_path / name) for name in names]
    assert [leg['bag'] for leg in printed['legs']] == paths
    assert [entry['bag'] for entry in printed['inputs']] == paths


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp('force') / 'drive', drive_topics(simulate(SimOptions(
        scenario='straight', duration=180.0, imu_rate=20.0, odometer_rate=10.0))))


CREATED = '2026-01-02T03:04:05+00:00'


class Args:
    force, json, quiet, holdout, brief = True, False, False, False, False


@pytest.mark.parametrize('quiet', [False, True])
def test_a_replaced_better_calibration_is_reported(tmp_path, capsys, quiet):
    write_results(result.Calibration((), {}, {}, ()), Config(), tmp_path, [], CREATED)
    args = Args()
    args.quiet = quiet
    worse = result.Calibration((Reason(Code.NO_FIX, 'no fix came'),), {}, {}, ())
    # the second time a rejected one is replaced: no loss
    for is_stated in (not quiet, False):
        assert replay._report(Calibration(worse), tmp_path, args,
                              replay._TerminalListener(args)) == 1
        err = capsys.readouterr().err
        assert ('--force replaced a better calibration: the new result is rejected (NO_FIX), the '
                'old one is accepted' in err) == is_stated
        assert bool(err) == is_stated
    assert json.loads((tmp_path / 'calibration.json').read_text())['verdict'] == 'rejected'


def interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize(('where', 'last_line'), [
    ('odocal_ros.pipeline.calibrate.combine', 'odocal: interrupted, nothing written\n'),
    ('odocal_ros.safe_io.atomic_files._identity', 'odocal: interrupted, nothing written\n'),
    ('odocal_ros.output.files.report_or_error_page',
     'the results are in {out}/, report.html is not\n'),
    ('odocal_ros.output.summary.screen', 'the results are in {out}/, report.html is not\n'),
    ('odocal_ros.output.summary.sentence', 'the results are in {out}/\n')])
def test_ctrl_c_reports_the_written_files(bag, tmp_path, capsys, monkeypatch, where, last_line):
    monkeypatch.setattr(where, interrupted)
    assert main(['replay', str(bag), '--output', str(tmp_path / 'out')]) == 130
    assert capsys.readouterr().err.endswith(last_line.format(out=tmp_path / 'out'))
    written = (tmp_path / 'out').exists()
    assert written == ('results are' in last_line)
    assert not list(tmp_path.glob('.*'))
