# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Selection of bags: manifests, folders, globs, patterns, URLs; and legs stored as text."""

from enum import Enum
import shutil
import zipfile

from drives import drive, settings
import pytest

from odocal_ros.errors import BadBag, BadData, BadUsage
from odocal_ros.fleet import bags as bags_module, rows as rows_module
from odocal_ros.fleet.bags import bag_fingerprint, find_bags, FleetBag, local_copy
from odocal_ros.fleet.rows import key_of, read_rows, Row, RowStore, text_of_legs
from odocal_ros.fleet.tables import folder_name
from odocal_ros.fleet.vehicles import vehicle_of, VehicleJob
from odocal_ros.offline.cli import main
from odocal_ros.output.files import as_json
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code

pytestmark = pytest.mark.core
pytest.importorskip('fsspec')


def test_a_manifest_gives_the_same_bags_from_csv_and_parquet(fleet, tmp_path):
    from pyarrow import csv, parquet
    bags = find_bags([fleet.manifest], None)
    assert [(b.vehicle, b.model, b.odometer_km) for b in bags] == [
        (row['vehicle'], row['model'], float(row['odometer_km'])) for row in fleet.rows]
    assert bags[0].bag == str(fleet.folder / fleet.rows[0]['bag'])
    assert bags[0].config == str(fleet.folder / fleet.rows[0]['config'])
    parquet.write_table(csv.read_csv(fleet.manifest), fleet.folder / 'manifest.parquet')
    assert find_bags([str(fleet.folder / 'manifest.parquet')], None) == bags


def test_bags_in_folders_and_globs_are_found_and_named_by_their_path(fleet):
    whole = find_bags([str(fleet.folder)], None)
    assert [(b.vehicle, b.bag) for b in whole] == sorted(
        (row['vehicle'], str(fleet.folder / row['bag'])) for row in fleet.rows)
    some = find_bags([f'{fleet.folder}/*/bag_01'], r'/(?P<model>[a-z]+)_(?P<vehicle>\d+)/')
    assert {(b.model, b.vehicle) for b in some} == {
        tuple(row['vehicle'].split('_')) for row in fleet.rows}
    for wrong, what in ((r'/(\d+)/x', 'not match'), ('no group', 'group'), ('(', '--vehicle')):
        with pytest.raises(BadUsage, match=what):
            find_bags([str(fleet.folder)], wrong)
    with pytest.raises(BadUsage, match='/nothing: no such file or folder'):
        find_bags([str(fleet.folder), f'{fleet.folder}/nothing'], None)


@pytest.mark.parametrize(('text', 'what'), [
    ('vehicle,model\na,b\n', 'no column bag'), ('vehicle,bag\n', 'no bag'),
    ('vehicle,bag\n,x\n', 'row 2: vehicle or bag is empty'),
    ('vehicle,bag,odometer_km\na,x,far\n', "'far' is not a number"), ('', 'cannot be read')])
def test_a_wrong_manifest_is_refused_with_the_place_of_the_error(text, what, tmp_path):
    (tmp_path / 'm.csv').write_text(text)
    with pytest.raises(BadUsage, match=what):
        find_bags([str(tmp_path / 'm.csv')], None)


def test_legs_and_urls_of_a_manifest_are_kept(tmp_path):
    (tmp_path / 'm.csv').write_text('vehicle,bag,legs\n007,s3://b/x.mcap,12:95 100:\n')
    assert find_bags([str(tmp_path / 'm.csv')], None) == [
        FleetBag('007', 's3://b/x.mcap', legs=('12:95', '100:'))]


def test_a_bag_by_url_is_copied_and_the_copy_removed(tmp_path):
    with zipfile.ZipFile(tmp_path / 'bags.zip', 'w') as archive:
        archive.writestr('drive/drive_0.mcap', b'12345')
        archive.writestr('drive/metadata.yaml', b'x')
    url = f'zip://drive::{tmp_path}/bags.zip'
    scratch = tmp_path / 'scratch'
    scratch.mkdir()
    with local_copy(url, str(scratch)) as path:
        assert path.is_relative_to(scratch)
        assert (path / 'drive_0.mcap').read_bytes() == b'12345'
    assert not list(scratch.iterdir())
    before = bag_fingerprint(url, 'settings')
    assert before == bag_fingerprint(url, 'settings') != bag_fingerprint(url, 'others')
    with zipfile.ZipFile(tmp_path / 'bags.zip', 'w') as archive:
        archive.writestr('drive/drive_0.mcap', b'12346')
    assert bag_fingerprint(url, 'settings') != before
    with pytest.raises(BadBag, match='gone'):
        bag_fingerprint(f'{tmp_path}/gone', '')


def test_a_remote_bag_stays_in_its_folder_within_the_free_space(tmp_path, monkeypatch):
    from fsspec.implementations.memory import MemoryFileSystem
    memory = MemoryFileSystem()
    memory.pipe('/odd/../x.mcap', b'12345')
    scratch = tmp_path / 'scratch'
    scratch.mkdir()
    monkeypatch.setattr(bags_module, 'file_system', lambda url: (memory, '/odd/..'))
    with local_copy('memory://odd/..', str(scratch)) as path:
        assert path.parent.parent == scratch
    monkeypatch.setattr(bags_module.shutil, 'disk_usage',
                        lambda folder: shutil._ntuple_diskusage(9, 9, 9))
    with pytest.raises(BadBag, match='free disk space'), \
            local_copy('memory://odd/..', str(scratch)):
        pass


def test_each_vehicle_has_a_separate_valid_folder():
    names = ['7', '.7', '..', '', '../x', 'x' * 300, 'x' * 299 + 'y', '\u00fc' * 200, 'a b']
    folders = [folder_name(name) for name in names]
    assert len(set(folders)) == len(names)
    for folder in folders:
        assert 0 < len(folder) < 200
        assert '/' not in folder
        assert not folder.startswith('.')


@pytest.mark.parametrize('spoil', [lambda data: data[:len(data) // 2], lambda data: b'',
                                   lambda data: b'PAR1' + b'x' * 50 + b'PAR1'])
def test_a_truncated_row_is_computed_again(tmp_path, spoil):
    store, key = RowStore(tmp_path), key_of('a bag')
    row = Row(key=key, bag='drive', vehicle='7')
    store.put(row)
    store.put_key('ab' * 20, key)
    assert store.find_key('ab' * 20) == key
    assert store.get(key) == row
    store.path(key).write_bytes(spoil(store.path(key).read_bytes()))
    assert store.get(key) is None
    with pytest.raises(BadData, match='not a fleet row'):
        list(read_rows([store.path(key)]))
    for odd in (b'../../x', b'\xff\xfe', b''):
        (tmp_path / 'seen' / 'ab' / ('ab' * 20)).write_bytes(odd)
        assert store.find_key('ab' * 20) is None


@pytest.mark.parametrize(('legs', 'what'), [
    ('[{"~": "Code", "of": "PLANES_DISAGREE"}]', 'PLANES_DISAGREE'),
    ('[{"~": "Plane"}]', 'Plane'), ('[{"~": "Reason", "plane": 1}]', 'plane'), ('[', 'line 1')])
def test_legs_of_another_version_are_refused_with_the_file_to_remove(legs, what, tmp_path):
    store, key = RowStore(tmp_path), key_of('a bag')
    store.put(Row(key=key, bag='drive', vehicle='7', legs=legs))
    job = VehicleJob('7', (FleetBag('7', 'drive'),), (str(store.path(key)),))
    with pytest.raises(BadData, match=f'drive: .*{what}.*remove the file rows/{key[:2]}/{key}'):
        vehicle_of(job)


def test_a_bag_has_another_key_when_reason_codes_or_results_change(monkeypatch):
    before = key_of('a bag')
    monkeypatch.setattr(rows_module, 'Code', Enum('Code', [*Code.__members__, 'PLANES_DISAGREE']))
    changed_codes = key_of('a bag')
    monkeypatch.setitem(rows_module.STORED_TYPES, 'Reason', rows_module.Row)
    assert len({before, changed_codes, key_of('a bag')}) == 3


def test_legs_of_a_row_combine_to_the_same_digits():
    """Also of the smoother, whose legs are combined by their shared constants."""
    legs = []
    for seed in (1, 2):
        made = drive(scenario='town', duration=135.0, fix_noise='rtk', imu_rate=25.0,
                     odometer_rate=10.0, fix_rate=2.0, seed=seed, start_ns=seed * 10**18)
        config = settings(made, heading_sigma=None, method='auto')
        legs.append(calibrate(made.leg(), config))
    text = text_of_legs(legs)
    again = Row(key='', bag='', vehicle='', legs=text).leg_results()
    assert text_of_legs(again) == text
    kept = [leg.without_plot_data() for leg in legs]      # without data for the plots
    found, known = (as_json(combine(some, config), config, [], '') for some in (again, kept))
    assert found == known
    assert found['result']['scale_factor']['method'] == 'smoother'
    assert again[0].methods['smoother'].marginal.information.tobytes() == \
        legs[0].methods['smoother'].marginal.information.tobytes()


@pytest.mark.parametrize(('argv', 'what'), [
    (['*.none'], 'no bag found'),
    (['{fleet}', '--set', 'leg.min_distance=x'], 'leg.min_distance'),
    (['{fleet}', '--accept', 'x=1:2'], '--accept'), (['{fleet}', '--leg', '3'], '--leg'),
    (['{fleet}', '--task-timeout', '0'], '--task-timeout'),
    (['{fleet}', '--scheduler', 'tcp://127.0.0.1:1'], 'no answer')])
def test_wrong_usage_is_refused_before_the_work(fleet, argv, what, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = [word.format(fleet=fleet.manifest) for word in argv]
    assert main(['fleet', *words, '--output', str(tmp_path / 'out')]) == 2
    assert what in capsys.readouterr().err
    assert not (tmp_path / 'out' / 'fleet.html').exists()
