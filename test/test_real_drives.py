# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The table of real drives: made from a simulated one, with its truth as the reference."""

import sys

from drives import drive
import pytest
import yaml

from odocal_ros.bagio.encode import counter, fix, imu, twist
from odocal_ros.bagio.write import write_bag
from tools import real_drives

pytestmark = pytest.mark.slow


@pytest.fixture
def data(tmp_path, monkeypatch):
    """Return a folder of one drive that has a counter and a speed."""
    made = drive(scenario='straight', duration=200.0, fix_noise='rtk')
    speed = drive(scenario='straight', duration=200.0, fix_noise='rtk', odometer='speed')
    write_bag(tmp_path / 'a_drive' / 'bag', [
        imu('/imu/data', made.imu), fix('/fix', made.fix), counter('/ticks', made.odometer),
        twist('/speed', speed.odometer)])
    truth = {'odometer': {'pulses': '/ticks', 'twist': '/speed', 'k0_m_per_pulse': 0.02},
             'scale': {'value': made.truth.scale / 0.02, 'sigma': 1e-4},
             'yaw_mounting_deg': {'value': 1.0, 'sigma': 0.1}}
    (tmp_path / 'a_drive' / 'truth.yaml').write_text(yaml.safe_dump(truth))
    (tmp_path / 'no_drive').mkdir()
    monkeypatch.setenv('ODOCAL_DATA', str(tmp_path))
    return tmp_path


def test_the_page_has_a_row_for_each_odometer(data, monkeypatch):
    page = data / 'page.md'
    page.write_text(f'before\n{real_drives.BEGIN}old\n{real_drives.END}after\n')
    (data / 'pictures').mkdir()
    monkeypatch.setattr(real_drives, 'PAGE', page)
    monkeypatch.setattr(real_drives, 'GALLERY', data / 'gallery.md')
    monkeypatch.setattr(sys, 'argv', ['real_drives', '--write'])
    real_drives.main()
    text = page.read_text()
    assert text.startswith(f'before\n{real_drives.BEGIN}{real_drives.HEAD}| `a_drive` |')
    assert text.endswith(f'{real_drives.END}after\n')
    rows = [line.split(' | ') for line in text.splitlines() if line.startswith('| `a_drive`')]
    assert [row[1] for row in rows] == ['`/ticks`', '`/speed`']
    gallery = (data / 'gallery.md').read_text()
    assert gallery.count('\n## ') == gallery.count('pictures/a_drive.svg') == 1
    assert 'odometer: /ticks, because' in gallery
    assert 'scale factor' in gallery
    assert 'corrected' in (data / 'pictures' / 'a_drive.svg').read_text()
    assert abs(float(rows[0][4])) < 4           # sigmas, of the counter against its truth
    assert all(row[-2] in ('accepted', 'caution') for row in rows)
