# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""calibration.json keeps its schema: what is written, and what earlier releases wrote."""

import json
from pathlib import Path
import re

from drives import drive, settings
import pytest

from odocal_ros.offline.cli import main
from odocal_ros.output.files import as_json
from odocal_ros.output.stored import read_stored
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.settings.config import Config

pytestmark = pytest.mark.core
ROOT = Path(__file__).resolve().parents[2]
SCHEMA = json.loads((ROOT / 'config' / 'calibration-1.schema.json').read_text())
EARLIER = sorted(Path(__file__).parent.glob('calibration_*.json'))


@pytest.fixture
def validator():
    jsonschema = pytest.importorskip('jsonschema', reason='no jsonschema here')
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    return jsonschema.Draft202012Validator(SCHEMA)


def content(legs, config):
    return json.loads(json.dumps(as_json(combine(legs, config), config, [], 'now')))


def test_what_is_written_has_the_schema(validator):
    made = drive(scenario='straight', duration=200.0)
    config = settings(made)
    good = calibrate(made.leg(), config)
    validator.validate(content([good], config))
    failed = drive(scenario='straight', duration=200.0, fix_rate=0.01)
    validator.validate(content([calibrate(failed.leg(), Config())], Config()))


@pytest.mark.parametrize('path', EARLIER, ids=lambda path: path.stem)
def test_what_earlier_releases_wrote_is_read(path, validator, capsys):
    stored = json.loads(path.read_text())
    version = '.'.join(re.findall(r'\d+', path.stem))
    assert stored['software'] == f'odocal_ros {version}'
    validator.validate(stored)
    found = read_stored(path)
    assert found.value('scale_factor') == stored['result']['scale_factor']['value']
    assert main(['compare', str(path), str(path)]) == 0
    assert 'scale factor' in capsys.readouterr().out


@pytest.mark.parametrize('spoil', [
    lambda c: c.update(schema=2), lambda c: c.update(verdict='good'),
    lambda c: c['result'].pop('scale_factor'),
    lambda c: c['result']['yaw_mounting_angle'].update(unit='deg'),
    lambda c: c['legs'][0].pop('start_ns'), lambda c: c['reasons'][0].update(code='odd one')])
def test_a_break_of_the_contract_is_seen(spoil, validator):
    stored = json.loads(EARLIER[0].read_text())
    spoil(stored)
    assert not validator.is_valid(stored)
