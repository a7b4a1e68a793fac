# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal patent: the embodiment, its arrays, the page, its JSON and its picture, of one drive."""

from itertools import combinations
import json
from math import gcd

import numpy as np
import pytest

from odocal_reproductions.patent import command as patent
from odocal_reproductions.patent.embodiment import (
    embodiment,
    imbalance,
    LEVELS,
    min_rows,
    nearly_balanced,
    NOMINAL_RADIUS,
    PRINTED,
    PRINTED_BEST,
)
from odocal_ros.calib.wheel_search.parameter_sets import bose_array, full_factorial
from odocal_ros.offline.cli import main

pytestmark = pytest.mark.core


@pytest.fixture(scope='module')
def drive():
    return patent.planar_leg('rtk', 1)


@pytest.fixture
def same_drive(drive, monkeypatch):
    monkeypatch.setattr(patent, 'planar_leg', lambda fix_noise, seed: drive)


def test_json_and_page_have_the_same_lines_and_the_truth_is_found(same_drive, capsys):
    assert main(['patent', '--json']) == 0
    out = json.loads(capsys.readouterr().out)
    rows = {row['name']: row for row in out['rows']}
    best = rows['best of all 441']
    # the true combination is the best of all, and is not one of those printed
    assert (best['left'], best['right'], best['heading_deg']) == pytest.approx(PRINTED_BEST)
    assert out['orthogonal_rows'] == 441
    assert main(['patent', '--fix-noise', 'rtk']) == 0
    page = capsys.readouterr().out
    assert max(map(len, page.splitlines())) < 100
    for name, row in rows.items():
        line, *_ = (line for line in page.splitlines() if line.startswith(f'  {name} '))
        assert f'{row["criteria"]["mean"]:9.3f}' in line or name.startswith(' ')


@pytest.mark.parametrize(('name', 'begin'), [('a.png', b'\x89PNG'), ('b.PDF', b'%PDF')])
def test_plot_writes_a_picture(same_drive, capsys, tmp_path, name, begin):
    assert main(['patent', '--plot', str(tmp_path / name)]) == 0
    assert name in capsys.readouterr().out
    assert (tmp_path / name).read_bytes().startswith(begin)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_an_invalid_picture_file_is_refused_before_any_computation(capsys, tmp_path):
    assert main(['patent', '--plot', str(tmp_path / 'a.gif')]) == 2
    assert '.png, .svg, .pdf' in capsys.readouterr().err


def test_the_embodiment_gives_the_printed_values():
    leg = patent.planar_leg('white', 0, duration=300.0, imu_grade='perfect', fix_sigma=0.0,
                        odometer_rate=50.0)
    table = embodiment(leg, truth=PRINTED_BEST)
    rows = {row.name: row for row in table.rows}
    assert [(round(r.left, 9), round(r.right, 9), round(r.heading_deg, 9)) for r in (
        rows[f'printed {k}'] for k in range(1, 8))] == list(PRINTED)
    assert table.orthogonal_rows == 441
    assert table.imbalance == pytest.approx(4 - 81 / 49)
    # fixes without noise: among all 441 the true one is best, and the optimum is the truth
    best = rows['best of all 441']
    assert (best.left, best.right, best.heading_deg) == pytest.approx(PRINTED_BEST)
    for name in ('response surface', 'least squares'):
        row = rows[name]
        # tracks within 0.1 mm (the line truth); a relative difference of radii of 1 gives 0.4 m
        assert (row.left, row.right) == pytest.approx(PRINTED_BEST[:2],
                                                      abs=NOMINAL_RADIUS * 1e-4 / 0.4)
        assert row.heading_deg == pytest.approx(PRINTED_BEST[2], abs=0.002)
        assert row.criteria['mean'] <= rows['truth'].criteria['mean'] + 1e-6
    others = [rows[f'printed {k}'] for k in range(1, 8)] + [rows['best of 81']]
    assert best.criteria['mean'] < min(row.criteria['mean'] for row in others)


def test_one_wrong_cell_makes_an_array_unbalanced():
    array = bose_array(5, 6)
    assert imbalance(array, (5,) * 6) == 0.0
    array[7, 2] = (array[7, 2] + 1) % 5
    assert imbalance(array, (5,) * 6) == 1.0


def test_no_array_smaller_than_all_441_is_orthogonal_for_the_embodiment():
    # each pair of columns needs a multiple of its 49 or 63 pairs of levels
    assert min_rows(LEVELS) == 49 * 63 // gcd(49, 63) == 441 == len(full_factorial(LEVELS))
    assert imbalance(full_factorial(LEVELS), LEVELS) == 0.0
    assert min_rows((3, 3, 3)) == 9
    assert min_rows((5,)) == 5


def test_the_printed_combinations_are_levels_but_not_balanced():
    errors = np.array(PRINTED)
    rows = np.rint(errors / [0.01, 0.01, 0.25]).astype(int) + [3, 3, 4]
    assert len(rows) == 7
    assert (rows >= 0).all()
    assert (rows < LEVELS).all()
    assert imbalance(rows, LEVELS) > 0.8
    assert PRINTED_BEST not in PRINTED


def test_the_small_array_is_nearly_balanced_by_the_stated_amount():
    array = nearly_balanced(LEVELS)
    assert array.shape == (81, 3)
    assert (array.max(axis=0) == [6, 6, 8]).all()
    # two of seven levels replace four of nine: a pair of them occurs 4 times; even: 81 / 49
    assert imbalance(array, LEVELS) == pytest.approx(4 - 81 / 49)
    for a, b in combinations(range(3), 2):
        pairs = {tuple(pair) for pair in array[:, [a, b]].tolist()}
        assert len(pairs) == LEVELS[a] * LEVELS[b]
    # dummy levels are symmetric about the middle: the mean of each column is the middle level
    assert array.mean(axis=0) == pytest.approx([3, 3, 4])
