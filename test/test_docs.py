# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Every command in README and docs is run; the table of real drives is made from data."""

import json
import re
import shlex
import shutil
import sys

from drives import drive, settings
from pages import all_commands, blocks, fenced, PAGES, ROOT, yaml_blocks
import pytest
import yaml

from odocal_ros.bagio.encode import counter, fix, imu, twist
from odocal_ros.bagio.write import write_bag
from odocal_ros.offline import cli
from odocal_ros.output.tables import source_label
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config_file import read_config_file
from tools import real_drives

pytestmark = pytest.mark.slow

# commands other than odocal and ros2, and what runs them instead of this file
ELSEWHERE = {
    './tools/try-it': 'installs for a minute: run by hand and by the README of a release',
    './tools/test': '.ci/run runs it',
    '.ci/run': 'runs these tests',
    '.venv/bin/ruff': '.ci/run runs it',
    '.venv/bin/mypy': '.ci/run runs it',
    'export': 'the TLS of a Dask cluster: test/fleet',
    '.venv/bin/python': 'test_comma2k19.py runs that module'}
# pages whose commands depend on earlier ones
FLEET, INDOOR = 'docs/first_fleet.md', 'docs/indoor.md'
RESULTS = ('ACCEPTED: ', 'CAUTION: ', 'REJECTED: ')     # a block with printed text
KNOWN = {'odocal', 'ros2', *ELSEWHERE}
STRAIGHT = {'scenario': 'straight', 'duration': 180.0, 'fix_noise': 'rtk'}
OPTIONS = {'imu': '--imu-topic', 'odometer': '--odometer-topic', 'fix': '--fix-topic'}
DEFAULTS = {'imu': '/imu/data', 'odometer': '/odometer', 'fix': '/fix'}


def page_of(name):
    return (ROOT / name).read_text(encoding='utf-8')


def test_each_block_has_known_commands():
    seen = set()
    for page in PAGES:
        for block in blocks(page.read_text(encoding='utf-8')):
            if block[0].startswith(RESULTS):
                continue
            for line in block:
                word = shlex.split(line)[0]
                assert word in KNOWN, f'{page.name}: {line}: run it in a test, or say where'
                seen.add(word)
    assert seen == KNOWN, 'no longer on any page: take it out of the table'


def put_bag(path, made, names=DEFAULTS):
    write_bag(path, [imu(names['imu'], made.imu), fix(names['fix'], made.fix),
                     counter(names['odometer'], made.odometer)])


def printed(words, capfd, code=0):
    capfd.readouterr()
    ended = cli.main(words)
    out, err = capfd.readouterr()
    assert ended == code, err
    return out


@pytest.fixture(autouse=True)
def undrawn(request, monkeypatch):
    """Draw the report for the README only: it takes half the time of a replay."""
    if 'README.md' not in request.node.name:
        monkeypatch.setattr('odocal_ros.output.files.report_or_error_page', lambda *_: ('', ''))


@pytest.fixture(scope='module')
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp('results')
    for seed in (1, 2):
        bag = folder / f'bag_{seed}'
        put_bag(bag, drive(**STRAIGHT, seed=seed))
        code = cli.main(['replay', str(bag), '--output', str(folder / f'{seed}'), '--quiet',
                         '--method', 'two_point', '--set', 'output.formats=[params]'])
        assert code in (0, 1)
    return folder / '1', folder / '2'


def meant_to_be_typed(line):
    """Return True if a text is a command line, not a mention (odocal compare A B ...)."""
    words = shlex.split(line)
    return len(words) > 2 and not any(word.isupper() or word == '...' for word in words)


@pytest.mark.parametrize(('page', 'line'), [
    (page, line) for page, line in all_commands('odocal')
    if meant_to_be_typed(line) and page not in (FLEET, INDOOR)],
    ids=lambda text: text[:60])
def test_odocal_commands_give_stated_results(page, line, tmp_path, monkeypatch, capfd, results):
    words = shlex.split(line)[1:]
    monkeypatch.chdir(tmp_path)
    for text in yaml_blocks(page_of(page)):
        (tmp_path / 'my_vehicle.yaml').write_text(text)
    if words[0] in ('replay', 'inspect', 'try'):
        names = DEFAULTS | ({'odometer': '/ticks'} if page == 'README.md' else {})
        named = {slot: words[words.index(option) + 1]
                 for slot, option in OPTIONS.items() if option in words}
        put_bag(tmp_path / words[1], drive(**STRAIGHT), names | named)
    if words[0] == 'compare':
        for made, name in zip(results, words[1:3], strict=True):
            shutil.copytree(made, tmp_path / name)
    out = printed(words, capfd)
    if words[0] == 'replay':
        content = json.loads((tmp_path / 'odocal_drive' / 'calibration.json').read_text())
        scale = content['result']['scale_factor']
        truth = drive(**STRAIGHT).truth.scale
        assert abs(scale['value'] - truth) < 4 * scale['sigma']
        keys = page_of('docs/report.md').partition('contains everything')[2].split('[files.md]')[0]
        assert set(re.findall(r'`(\w+)`', keys)) <= set(content)
    elif words[0] == 'simulate':
        assert {p.name for p in tmp_path.iterdir()} >= {'drive', 'truth.yaml'}
    elif words[0] == 'plan':
        assert 'predicted sigma' in out
    elif words[0] == 'try':
        assert f'to repeat this calibration:\n  odocal replay {words[1]} ' in out
    elif words[0] == 'inspect':
        assert '<- imu' in out
        assert 'suggested command' in out
    else:
        assert out


def test_the_fleet_tutorial_gives_the_results_on_the_page(tmp_path, monkeypatch, capfd):
    pytest.importorskip('distributed')
    monkeypatch.chdir(tmp_path)
    page = page_of(FLEET)
    made, calibrated, replayed, accepted = (
        shlex.split(line)[1:] for page, line in all_commands('odocal') if page == FLEET)
    assert cli.main(made) == 0
    assert '\n'.join((tmp_path / 'fleet' / 'manifest.csv').read_text().splitlines()[:2]) in page
    # test/fleet tests the reports: drawing them takes most of the time
    out = printed([*calibrated, '--reports', 'none'], capfd, code=1)
    worth = r'^  (\w+): (accepted|rejected); (.*) ([-\d]+)$'
    listed = re.findall(worth, page, re.MULTILINE)
    assert re.findall(worth, out, re.MULTILINE) == listed
    truth = yaml.safe_load((tmp_path / 'fleet' / 'truth.yaml').read_text())['vehicles']
    assert {(v['vehicle'], change['by'][:10]) for v in truth for change in v['changes']} == {
        (name, when) for name, *_, when in listed}
    program, = (text for language, text in fenced(page) if language == 'python')
    exec('\n'.join(program), {})
    out, _ = capfd.readouterr()
    assert re.findall(r'^(\w+_\d{3}) ', out, re.MULTILINE) == [
        name for name, verdict, *_ in listed if verdict == 'accepted']
    assert cli.main(replayed) == 0
    out = printed([*accepted, '--reports', 'none'], capfd, code=1)
    rows = {row['vehicle']: row for row in map(
        json.loads, re.findall(r'^\{.*$', out, re.MULTILINE)) if row['decision'] != 'PASS'}
    assert {name: row['decision'] for name, row in rows.items()} == {
        'shuttle_001': 'FAIL', 'van_005': 'UNDECIDED'}
    off = rows['shuttle_001']['values']['scale_ratio']['value'] - 1
    assert f'shuttle_001 is {100 * off:.2f} % above' in page


def test_the_indoor_tutorial_prints_the_text_on_the_page(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    lines = [shlex.split(line)[1:] for page, line in all_commands('odocal') if page == INDOOR]
    assert [words[0] for words in lines] == ['simulate', 'inspect', 'replay'] + [
        'simulate', 'replay'] * 5
    shown = [text for language, text in fenced(page_of(INDOOR)) if language == 'text']
    # blocks of the page after the replay of each bag
    count = {'robot': 2, 'square': 1, 'wheels': 1, 'skid': 1, 'mecanum': 2, 'omni': 1}
    assert len(shown) == sum(count.values())
    for words in lines:
        out = printed(words, capfd)
        if words[0] == 'replay':
            of_run = [shown.pop(0) for _ in range(count[words[1]])]
            assert all('\n'.join(text) in out for text in of_run), out
    made = yaml.safe_load((tmp_path / 'truth.yaml').read_text())
    true = f'{made["scale"]["value"]:g} m/pulse, ' + ', '.join(
        f'{x:.8f}' for x in made['scale']['wheels'])
    assert f'True values: {true.replace("8.9e-05", "0.000089")}, 0.3 m' in page_of(INDOOR)
    robots = {name: yaml.safe_load((tmp_path / f'{name}.truth.yaml').read_text())
              for name in ('skid', 'mecanum')}
    skid, mecanum = (robots[name]['robot'] for name in robots)
    assert (f'True values: {skid["track_width"]:g} m and {skid["track_width_arc"]:.3f} m'
            in page_of(INDOOR))
    assert (f'True values: {robots["mecanum"]["scale"]["value"]:g}, '
            f'{mecanum["track_width"] / 2:g} and {mecanum["lateral_scale_factor"]:g}'
            in page_of(INDOOR))


def test_the_page_lists_the_figures_of_the_report():
    table = page_of('docs/report.md').partition('| figure |')[2].partition('\n\n')[0]
    listed = re.findall(r'^\| ([A-Z][\w ]+) \|', table, re.MULTILINE)
    source = ''.join((ROOT / 'odocal_ros' / 'output' / name).read_text()
                     for name in ('plots.py', 'scale_plots.py'))
    drawn = re.findall(r"style\.drawing\(figure, f'[^']+', '([^']+)'", source)
    assert listed == drawn
    assert 'Origin' in (ROOT / 'odocal_ros/output/templates/report.html').read_text()


def test_each_source_of_a_budget_is_explained():
    page = page_of('docs/report.md')
    cells = re.findall(r'^\| ([\w, -]+) \|', page, re.MULTILINE)
    listed = {name for cell in cells for name in cell.split(', ')} | {'gyro bias y', 'gyro bias z'}
    assert '*Errors of single legs*' in page
    made = drive(scenario='town', duration=200.0, two_wheels=True, imu_grade='industrial')
    more = {'method': 'all', 'odometer.left': 'topic', 'odometer.right': 'topic'}
    leg = calibrate(made.leg(), settings(made, **more))
    budgets = {name: method.details.get('budget') for name, method in leg.methods.items()}
    assert all(budgets.values()), budgets
    found = {source_label(source) for budget in budgets.values() for source in budget}
    assert found <= listed, f'say in docs/report.md what they are: {found - listed}'


def test_settings_files_on_the_pages_are_valid(tmp_path):
    texts = [text for page in PAGES for text in yaml_blocks(page.read_text(encoding='utf-8'))
             if 'ros__parameters' in text]
    assert texts
    for text in texts:
        (tmp_path / 'mine.yaml').write_text(text)
        assert len(read_config_file(tmp_path / 'mine.yaml')) > 3


def test_files_for_common_vehicles_are_valid():
    files = sorted((ROOT / 'config').glob('vehicle_*.yaml'))
    assert len(files) == 3
    for path in files:
        found = read_config_file(path)
        assert found['imu.grade'] in path.read_text().partition('/**')[0], 'the head says it too'
        assert {'vehicle', 'odometer.nominal_scale', 'gnss.lever_arm', 'imu.mounting_rpy'} <= set(
            found), path.name


def test_a_plan_prints_the_text_on_the_page(capfd):
    words = [shlex.split(line)[1:] for page, line in all_commands('odocal')
             if page == 'docs/first_calibration.md' and ' plan ' in line]
    plans = [json.loads(printed([*command, '--json'], capfd)) for command in words]
    found = [plan['methods']['two_point']['estimates']['scale_factor']['sigma'] for plan in plans]
    assert found == pytest.approx([2000e-6, 30e-6], rel=0.2)


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
