# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Untrusted names in every format: they are shown, and no program acts on their content."""

from dataclasses import replace
from pathlib import Path
import shlex
import subprocess
from xml.etree import ElementTree

import pytest
import yaml

from odocal_ros.calib.result import Calibration, Estimate, LegResult
from odocal_ros.errors import BadConfig
from odocal_ros.output import program_files
from odocal_ros.output.files import as_json
from odocal_ros.output.program_files import with_imu_frame
from odocal_ros.output.tables import leg_table, LEGS
from odocal_ros.reasons import Code
from odocal_ros.safe_io import atomic_files, text_formats
from odocal_ros.safe_io.text_formats import parameter_block, yaml_value
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
ATTACKS = ["imu$(command 'touch x')", '$(env HOME)', 'a b', '-x', "x'; touch x; '", '`touch x`',
           'imu\ntouch x', 'imu\x1b[2J', 'imu --', 'a"b', 'a: b', '<imu>', 'x' * 300, 'imü',
           'imu\udcff', 'imu\u202e', '#', '/', '//']
BAGS = ['drive\ntouch x', 'drive\x1b]0;title\x07', 'drive -->', 'drive\udcff', 'drive ---x',
        'drive\r', 'drive\u2028x: 1', '$(command x)']


def calibration():
    """Return a calibration for which every file with a frame is written."""
    found = {'scale_factor': Estimate(0.05, 1e-6, 'm/pulse'), 'scale_ratio':
             Estimate(1.25, 1e-5, '1'), 'yaw_mounting_angle': Estimate(0.1, 1e-4, 'rad')}
    found |= {f'gyro_bias_{a}': Estimate(1e-5, 1e-6, 'rad/s') for a in 'xyz'}
    leg = LegResult(0, 10**11, 900.0, 100.0, 5, 5, 5, 0, (), {}, bag='drive', C_bi=None)
    return Calibration((), found, {}, (leg,), (0.0, 0.0, 0.05, 0.999), (0.0, 0.0, 0.1))


def texts(frame='imu_link', bag='drive', config=None):
    made, config = with_imu_frame(calibration(), config or Config(), frame)
    inputs = [{'bag': bag, 'sha256': None, 'topics': {}}]
    content = as_json(made, config, inputs, '2026-01-02T03:04:05+00:00')
    return made, program_files.file_texts(made, config, content)


@pytest.mark.parametrize('frame', ATTACKS)
def test_a_frame_that_ros_refuses_is_replaced_and_reported(frame):
    made, written = texts(frame)
    assert [r.code for r in made.reasons] == [Code.FRAME_REPLACED]
    assert 'imu_link is written' in made.reasons[0].text
    assert made.reasons[0].text.isprintable()
    assert written == texts('imu_link')[1]


def test_valid_and_empty_frames_are_kept_and_configured_ones_take_precedence():
    for frame in ('imu_link', 'car/imu-top.1', '3dm_gx5'):
        made, written = texts(frame)
        assert made.reasons == ()
        assert f'--child-frame-id {frame}\n' in written['imu_transform.txt']
    made, written = texts('/imu')
    assert [r.code for r in made.reasons] == [Code.FRAME_REPLACED]
    assert '--child-frame-id imu\n' in written['imu_transform.txt']
    assert texts('')[0].reasons == ()
    config = with_settings(Config(), {'frames.imu': 'top'})
    made, written = texts('$(command x)', config=config)
    assert made.reasons == ()
    assert '--child-frame-id top\n' in written['imu_transform.txt']
    made = calibration()
    assert with_imu_frame(made, Config(), '') == (made, Config())


@pytest.mark.parametrize('frame', [*ATTACKS, '/base_link'])
@pytest.mark.parametrize('name', ['frames.base', 'frames.imu', 'frames.local'])
def test_an_invalid_frame_setting_is_refused(name, frame):
    with pytest.raises(BadConfig, match=name) as error:
        with_settings(Config(), {name: frame})
    assert str(error.value).isprintable()


@pytest.mark.parametrize('name', ['odometer.field', 'odometer.left', 'output.directory'])
def test_a_setting_with_invisible_characters_is_refused(name):
    for text in ('a\nb', 'a\x1b[2J', 'a\x00', 'a\udcff', 'a\u202eb'):
        with pytest.raises(BadConfig, match='invisible characters'):
            with_settings(Config(), {name: text})
    assert with_settings(Config(), {name: "ü $(x) 'y'"})


def test_the_name_of_a_node_has_only_characters_that_ros_accepts():
    node = ElementTree.fromstring(texts('car/imu-top.1')[1]['imu_transform.launch.xml'])[0]
    assert node.attrib['name'] == 'base_link_to_car_imu_top_1'


@pytest.mark.parametrize('bag', BAGS)
def test_the_name_of_a_bag_stays_within_its_comment(bag):
    _, written = texts(bag=bag)
    plain = texts()[1]
    for name, text in written.items():
        text.encode()
        assert len(text.splitlines()) == len(plain[name].splitlines()), name
        assert text.replace('\n', '').isprintable(), name
        if name.endswith('.yaml'):
            assert yaml.safe_load(text) == yaml.safe_load(plain[name])
        if name.endswith(('.xml', '.urdf')):
            assert (ElementTree.canonicalize(text) == ElementTree.canonicalize(plain[name]))
        if name == 'imu_transform.txt':
            assert shlex.split(text, comments=True) == shlex.split(plain[name], comments=True)


def test_arguments_reach_shell_and_launch_unchanged():
    words = ['a b', "it's", '$(touch x)', '`x`', '', '-', 'ü']
    script = f'printf "%s\\0" {text_formats.for_shell(words)}'
    out = subprocess.run(['bash', '-c', script], text=True, stdout=subprocess.PIPE,
                         check=True).stdout
    assert out.split('\0')[:-1] == words
    text = text_formats.for_launch(["$(command 'x')", '"', '\\'])
    # launch's grammar: $( begins a substitution unless a backslash stands before it
    assert '$(' not in text.replace('\\$(', '')
    assert text.replace('\\\\', '').count('"') == text.count('\\"')


@pytest.mark.parametrize('text', ['0', 'on', '1e5', '.nan', 'a: b', '#', "it's", '"', '\\', '',
                                  'ü', '😀', '- x', '{a}', 'x ' * 200])
def test_text_in_yaml_is_read_back_as_text(text):
    assert yaml.safe_load(yaml_value(text)) == text
    assert '\n' not in yaml_value(text)
    assert yaml.safe_load(parameter_block({'a': {'b': text}})) == {
        '/**': {'ros__parameters': {'a': {'b': text}}}}


def test_text_for_a_terminal_is_escaped_and_cut():
    assert text_formats.for_terminal('\x1b[1;32mACCEPTED\x1b[0m\na\x1b[2Jb\rc\x9b') == (
        '\x1b[1;32mACCEPTED\x1b[0m\na\\x1b[2Jb\\rc\\x9b')
    assert text_formats.one_line('a\nb\udcff') == 'a\\nb\\udcff'
    colours = '\x1b[1;31mstd_msgs/msg/Int64\x1b[0m'
    assert '\x1b' not in text_formats.for_terminal(colours)
    for text in ('x' * 2_000_000, '\x1b' * 2_000_000, '\n' * 2_000_000):
        assert len(text_formats.brief_line(text)) <= text_formats.LONGEST_LINE + 4
        assert len(text_formats.error_text(ValueError(text))) <= text_formats.LONGEST_LINE + 4
    assert text_formats.brief_line('a\x1b]52;c;eA==\x07b') == r'a\x1b]52;c;eA==\x07b'


def test_only_cli_py_calls_print():
    folder = Path(text_formats.__file__).parents[1] / 'offline'
    users = {path.name for path in folder.glob('*.py') if 'print(' in path.read_text()}
    assert users == {'cli.py'}


def test_no_cell_of_a_spreadsheet_is_a_formula():
    made = calibration()
    legs = (replace(made.legs[0], bag='=cmd|x!A1'), *made.legs)
    rows = leg_table(replace(made, legs=legs), Config(), {})[LEGS].splitlines()
    assert rows[1].startswith("1,'=cmd")
    assert rows[2].startswith('2,drive,')


def test_folders_of_one_name_are_numbered_up_to_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic_files, 'MAX_SAME_NAME', 3)
    made = [atomic_files.new_folder(tmp_path / 'root', 'leg').name for _ in range(3)]
    assert made == ['leg', 'leg-2', 'leg-3']
    with pytest.raises(OSError, match='holds 3 folders named leg'):
        atomic_files.new_folder(tmp_path / 'root', 'leg')
