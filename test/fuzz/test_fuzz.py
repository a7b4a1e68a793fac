"""A small budget of fuzzing; any number: ``python benchmarks/fuzz.py --cases N --seed S``."""

import time

import cases
import pytest

BUDGET = 20.0       # s of this process and its children


@pytest.fixture(scope='module')
def clean(tmp_path_factory):
    return cases.bases(tmp_path_factory.mktemp('clean'))


def test_clean_bags_are_fine(clean, tmp_path):
    """Else the fuzz shows nothing: the truth is found in each base."""
    for name in ('mcap', 'rosbag1'):
        place = tmp_path / name
        for folder in ('tmp', 'home'):
            (place / folder).mkdir(parents=True)
        before = cases.tree(place)
        ran = cases.child(['replay', str(clean.bag(name)), '--output', str(place / 'out'), '--set',
                           'output.formats=[params]'], place)
        said = (place / 'stderr').read_text()
        assert cases.judged(place, before, *ran, said, clean.truth[name]) == ''
        assert ran[0] == 0, said


def test_a_budget_of_cases(clean, tmp_path):
    begin, ran = time.monotonic(), []
    while time.monotonic() - begin < BUDGET:
        ran += cases.run(20261122, clean, tmp_path, list(range(len(ran), len(ran) + 20)))
    wrong = [f'case {o.number} ({o.what}): {o.wrong}: {o.said}' for o in ran if o.wrong]
    assert not wrong, '\n'.join(wrong)
    assert len(ran) > 10
    assert {o.code for o in ran} >= {0, 2}
