# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal replay --accept: exit codes and the line for a production line's computer."""

import json

from drives import drive
import pytest

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.offline.cli import main

pytestmark = pytest.mark.core


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    made = drive(scenario='straight', duration=200.0, fix_noise='rtk')
    return write_bag(tmp_path_factory.mktemp('accept') / 'drive', drive_topics(made)), made


@pytest.mark.parametrize(('low', 'high', 'options', 'code', 'decision'), [
    (-1e-3, 1e-3, [], 0, 'PASS'),
    (1e-3, 3e-3, [], 1, 'FAIL'),
    (-1e-6, 1e-6, [], 1, 'UNDECIDED'),
    (-1e-3, 1e-3, ['--strict'], 1, 'UNDECIDED')])
def test_the_exit_code_and_one_line_of_json_tell_the_decision(bag, low, high, options, code,
                                                             decision, tmp_path, capsys):
    path, made = bag
    true = made.truth.scale_ratio
    argv = ['replay', str(path), '--method', 'two_point', '--set', 'vehicle=bus 7', '--set',
            f'odometer.nominal_scale={made.options.nominal_scale!r}', '--set',
            'output.formats=[legs]', '--output', str(tmp_path / 'out'), '--accept',
            f'scale_ratio={true + low!r}:{true + high!r}', *options]
    assert main([*argv, '--quiet']) == code
    told = json.loads(capsys.readouterr().out)       # this line alone
    assert (told['vehicle'], told['decision']) == ('bus 7', decision)
    held = told['values']['scale_ratio']
    assert abs(held['value'] - true) < 4 * held['sigma']
    stored = json.loads((tmp_path / 'out' / 'calibration.json').read_text())
    assert stored['acceptance']['decision'] == decision
    if options:      # its heading is not known: a caution
        assert 'YAW_NOT_SEPARABLE' in told['why']
        assert main([*argv, '--force']) == code
        lines = capsys.readouterr().out.splitlines()
        assert json.loads(lines[-1]) == told
        assert decision in lines


def test_strict_alone_has_a_caution_exit_with_one(bag, tmp_path):
    argv = ['replay', str(bag[0]), '--method', 'two_point', '--quiet', '--output', str(tmp_path),
            '--set', 'output.formats=[legs]']
    assert main(argv) == 0
    assert main([*argv, '--force', '--strict']) == 1
