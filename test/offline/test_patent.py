# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal patent: the page, its JSON and its picture, of one drive."""

import json

import pytest

from odocal_ros.offline import patent
from odocal_ros.offline.cli import main
from odocal_ros.patent.embodiment import FOUND

pytestmark = pytest.mark.core


@pytest.fixture(scope='module')
def drive():
    return patent.driven('rtk', 1)


@pytest.fixture(autouse=True)
def unique_paths(drive, monkeypatch):
    monkeypatch.setattr(patent, 'driven', lambda fix_noise, seed: drive)


def test_json_and_page_have_the_same_lines_and_the_truth_is_found(capsys):
    assert main(['patent', '--json']) == 0
    out = json.loads(capsys.readouterr().out)
    rows = {row['name']: row for row in out['rows']}
    whole = rows['best of all 441']
    # of all combinations the true one is best, though none of those printed is it
    assert (whole['left'], whole['right'], whole['heading_deg']) == pytest.approx(FOUND)
    assert out['orthogonal_rows'] == 441
    assert main(['patent', '--fix-noise', 'rtk']) == 0
    page = capsys.readouterr().out
    assert max(map(len, page.splitlines())) < 100
    for name, row in rows.items():
        line, *_ = (line for line in page.splitlines() if line.startswith(f'  {name} '))
        assert f'{row["criteria"]["mean"]:9.3f}' in line or name.startswith(' ')


@pytest.mark.parametrize(('name', 'begin'), [('a.png', b'\x89PNG'), ('b.PDF', b'%PDF')])
def test_plot_writes_a_picture_whole(capsys, tmp_path, name, begin):
    assert main(['patent', '--plot', str(tmp_path / name)]) == 0
    assert name in capsys.readouterr().out
    assert (tmp_path / name).read_bytes().startswith(begin)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_a_picture_that_cannot_be_is_refused_before_anything_is_computed(capsys, tmp_path):
    assert main(['patent', '--plot', str(tmp_path / 'a.gif')]) == 2
    assert '.png, .svg, .pdf' in capsys.readouterr().err
