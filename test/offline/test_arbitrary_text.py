# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Text of any kind in metadata.yaml, journal.yaml and options: at most one error line."""

from contextlib import suppress
import random
import shutil

import pytest
import ros_bags
import yaml

from odocal_ros.errors import BadUsage, OdocalError
from odocal_ros.library.arguments import parse_leg
from odocal_ros.offline.cli import main
from odocal_ros.settings.config_file import parse_set, read_config_file

pytestmark = pytest.mark.slow
ODD = [None, True, -1, 0, 10**400, 2**63, float('inf'), float('nan'), '', 'text', '\0', [], [[]],
       {}, {'a': 1}, [None], -1e308, '1' * 5000, {'nanoseconds': []}, b'\xff']
DEEP = 1000      # levels: each takes several frames, of which Python allows as many
QUICK = '--quiet', '--method', 'two_point', '--set', 'output.formats=[]'
HEAD = '/**:\n  ros__parameters:\n    '
TEXTS = [
    '!!python/object/apply:os.system [true]', '&a {b: *a}', '&a [*a]', '[' * DEEP, '{' * DEEP,
    '- ' * DEEP + 'x', '9' * 400, '9' * 5000, '1e400', '.inf', '!!binary x', '!!timestamp 1',
    '!foo bar', '? [a]\n: b', '!!int x', '0x' + 'f' * 400, '0' + '7' * 500, '"\\uD800"',
    '!!set {1}', '*nothing', '<<: *x', '%YAML 9.9', '\t', '1:60:60', '!!null {}', 'a: b: c',
    '| \n x', '\x07']


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return ros_bags.write(tmp_path_factory.mktemp('odd') / 'bag', ros_bags.drive())


def output(capsys, *argv):
    """Run a command; require exit code 0, 1, or 2 with one line on stderr; return both."""
    code = main([*map(str, argv)])
    errors = capsys.readouterr().err
    assert code in (0, 1, 2), errors
    assert code != 2 or len(errors.strip().splitlines()) == 1, errors
    return code, errors


def test_metadata_of_any_type_give_at_most_one_error_line(tmp_path, bag, capsys):
    """Each value of the tree in turn is replaced by an odd one."""
    path = shutil.copytree(bag, tmp_path / 'bag')
    whole = yaml.safe_load((bag / 'metadata.yaml').read_text())

    def places(node, keys=()):
        yield keys
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(
            node, list) else ()
        for key, inner in items:
            yield from places(inner, (*keys, key))
    rng = random.Random(1)
    for keys in list(places(whole))[1:]:
        for odd in rng.sample(ODD, 3):
            tree = yaml.safe_load((bag / 'metadata.yaml').read_text())
            node = tree
            for key in keys[:-1]:
                node = node[key]
            node[keys[-1]] = odd
            (path / 'metadata.yaml').write_text(yaml.safe_dump(tree))
            output(capsys, 'inspect', path)


def test_metadata_and_journals_of_any_text_give_at_most_one_error_line(tmp_path, bag, capsys):
    path = shutil.copytree(bag, tmp_path / 'bag')
    for text in TEXTS:
        (path / 'metadata.yaml').write_text(f'rosbag2_bagfile_information: {text}')
        output(capsys, 'inspect', path)
    shutil.copy(bag / 'metadata.yaml', path)
    journal = HEAD + 'leg.min_distance: 50.0\nodocal_journal:\n  ros__parameters:'
    for text in TEXTS:
        for form in (' {}', '\n    topics.imu: {}'):
            (path / 'journal.yaml').write_text((journal + form).format(text))
            output(capsys, 'replay', path, *QUICK, '--output', tmp_path / 'out', '--force')


def test_settings_of_any_text_raise_only_expected_errors(tmp_path, bag, capsys):
    for text in [*TEXTS, '[' * DEEP + ']' * DEEP]:
        for name in ('leg.min_distance', 'imu.lever_arm', 'frames.imu', 'wheels.levels',
                     'output.formats', 'method', 'reference.start', 'no.such'):
            with suppress(OdocalError):
                parse_set(f'{name}={text}')
    config = tmp_path / 'config.yaml'
    for text in TEXTS:
        for form in ('{}', HEAD + '{}', HEAD + 'leg.min_distance: {}', HEAD + 'frames.imu: {}',
                     HEAD + 'imu.lever_arm: [1, {}]', HEAD + '{}: 3'):
            config.write_text(form.format(text))
            with suppress(OdocalError):
                read_config_file(config)
    output(capsys, 'inspect', bag, '--config', config)


def test_legs_of_any_text_raise_only_expected_errors():
    for text in ('1e400:2', ':1e400', '1e999999999:', '-1e30:', 'nan:', 'inf:inf',
                 '9' * 5000 + ':', '1:2:3', '9999-12-31/', '0001-01-01T00:00:00+23:59/', '٣:٤',
                 '\0:', '1_0:2e', '/', '//', 'each-stop:'):
        with suppress(BadUsage):
            span = parse_leg(text)
            assert all(edge is None or abs(edge) < 2**62
                       for edge in (span.start_ns, span.stop_ns)), text


def test_the_length_of_an_error_line_is_limited(capsys):
    _, errors = output(capsys, 'inspect', 'x' * 50_000)
    assert len(errors) < 2200
