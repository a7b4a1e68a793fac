# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A fleet on real Dask workers: rows, re-runs, bags that fail, hang or lose their worker."""

from contextlib import contextmanager
import csv
from dataclasses import replace
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from odocal_ros.fleet import calibrate_bags
from odocal_ros.fleet.bag_jobs import computed_rows
from odocal_ros.fleet.bags import find_bags
from odocal_ros.fleet.engine import MIN_TASKS, task_results
from odocal_ros.fleet.rows import DONE, FAILED, read_rows
from odocal_ros.offline.cli import main

pytestmark = pytest.mark.slow


def stored(output):
    """Return all rows in an output folder by bag, without the computing times."""
    rows = list(read_rows(sorted((output / 'rows').rglob('*.parquet'))))
    by_bag = {row.bag: replace(row, seconds=0.0) for row in rows}
    assert len(by_bag) == len(rows)      # one row a bag
    return by_bag


def table_of(output, name='vehicles'):
    import pandas as pd
    return pd.read_parquet(output / f'{name}.parquet')


def computed(client, jobs, **more):
    """Return the number of computed bags, and the states of the rows."""
    ended = [done for _, done in computed_rows(client, jobs, **more)]
    return sum(done.computed for done in ended), [done.status for done in ended]


@pytest.fixture(scope='module')
def output(fleet, client, tmp_path_factory):
    """Return the output folder of the command itself, on the workers of the client."""
    folder = tmp_path_factory.mktemp('output') / 'result'
    code = main(['fleet', fleet.manifest, '--output', str(folder), '--scheduler',
                 client.scheduler.address, '--method', 'two_point', '--files', '--quiet'])
    assert code == 1      # a counter is broken
    return folder


def test_each_bag_has_one_row_with_the_result_of_replay(fleet, output, tmp_path):
    rows = stored(output)
    assert len(rows) == len(fleet.rows)
    bag = fleet.folder / fleet.rows[0]['bag']
    config = fleet.folder / fleet.rows[0]['config']
    assert main(['replay', str(bag), '--config', str(config), '--method', 'two_point', '--quiet',
                 '--output', str(tmp_path), '--set', 'output.formats=[legs]']) == 0
    reported = json.loads((tmp_path / 'calibration.json').read_text())
    row = rows[str(bag)]
    assert row.sha256 == reported['inputs'][0]['sha256']
    estimates = json.loads(row.legs)[0]['methods']['two_point']['estimates']
    found = reported['result']['scale_factor']
    assert [estimates['scale_factor'][key] for key in ('value', 'sigma', 'unit')] == [
        found[key] for key in ('value', 'sigma', 'unit')]


def test_a_vehicle_has_the_result_of_replay_of_its_bags_since_the_change(fleet, output, tmp_path):
    table = table_of(output).set_index('vehicle')
    changed = next(v for v in fleet.truth if v['changes'][0]['value'] == 'scale_factor')
    row, = [table.loc[changed['vehicle']]]
    bags = [fleet.folder / r['bag'] for r in fleet.rows if r['vehicle'] == changed['vehicle']]
    since = bags[changed['changes'][0]['bag'] - 1:]
    config = fleet.folder / f'{changed["model"]}.yaml'
    main(['replay', *map(str, since), '--config', str(config), '--method', 'two_point', '--quiet',
          '--output', str(tmp_path), '--set', 'output.formats=[legs]'])
    reported = json.loads((tmp_path / 'calibration.json').read_text())
    by_files = json.loads(
        (output / 'vehicles' / changed['vehicle'] / 'calibration.json').read_text())
    drawn = json.loads((output / 'reports' / changed['vehicle'] / 'calibration.json').read_text())
    for name in ('scale_factor', 'scale_ratio'):
        found = reported['result'][name]
        assert (row[name], row[f'{name}_sigma']) == (found['value'], found['sigma'])
        assert by_files['result'][name] == drawn['result'][name] == found
    assert 'report.html' in {p.name for p in (output / 'reports' / changed['vehicle']).iterdir()}


def test_changes_and_broken_counters_are_found_at_their_time(fleet, output):
    table = table_of(output).set_index('vehicle')
    for vehicle in fleet.truth:
        row, (change,) = table.loc[vehicle['vehicle']], vehicle['changes']
        found = json.loads(row.changes)
        if change['value'] == 'scale_factor':
            assert [(c['after'], c['by']) for c in found] == [(change['after'], change['by'])]
            assert abs(found[0]['size'] - change['size']) < 4 * found[0]['sigma'] + 2e-3
        else:      # without a heading two_point does not give the yaw
            assert found == []
        broken = change['value'] == 'counter'
        assert (row.rejected_since == row.rejected_since) == broken      # NaT is not
        if broken:
            assert f'{row.rejected_since:%Y-%m-%d}' == change['by'][:10]
            assert row.rejected_for == 'ODOMETER_STILL'
            assert row.reasons.split()[0] == 'ODOMETER_STILL'
        assert (row.verdict == 'rejected') == broken
        # its scale now: 4 sigma, one draw in 16,000; the random walk of the weeks is in the sigma
        good = len(vehicle['start']) - 1 if not broken else change['bag'] - 2
        assert abs(row.scale_factor - vehicle['scale_factor'][good]) < 4 * np.hypot(
            row.scale_factor_sigma, 1e-4 * 7**0.5 * 2 * row.scale_factor)


def test_tables_and_page_contain_all_vehicles(fleet, output):
    legs = table_of(output, 'legs')
    assert len(legs) == len(fleet.rows)
    assert set(legs.columns) >= {'vehicle', 'bag', 'scale_factor', 'period', 'verdict', 'start'}
    with open(output / 'fleet.csv', newline='') as file:
        text = list(csv.DictReader(file))
    whole = table_of(output)
    assert list(text[0]) == list(whole.columns)
    assert [float(row['scale_factor']) for row in text] == list(whole.scale_factor)
    page = (output / 'fleet.html').read_text()
    assert 'src=' not in page
    style = page.partition('<style>')[2].partition('</style>')[0]
    assert '"Helvetica Neue"' in style      # not escaped
    assert '&' not in style
    # three vehicles of three models: a mean of one has no sigma
    population = page.partition('<h2>Population</h2>')[2].partition('</table>')[0]
    assert 'm/pulse' in population
    assert '±' not in population
    assert page.count('<tr class="remarks') == sum(
        bool(re.search(r'changed|rejected', remark)) for remark in page.split('colspan="10">')[1:])
    assert not [link for link in page.split('href="')[1:]
                if not link.startswith(('reports/', '#'))]
    for vehicle in fleet.truth:
        assert vehicle['vehicle'] in page
        if vehicle['changes'][0]['value'] == 'scale_factor':
            assert f'href="reports/{vehicle["vehicle"]}/report.html"' in page


def test_a_second_run_computes_only_what_is_new_or_changed(fleet, client, output, tmp_path):
    jobs = fleet.jobs(output)
    before = stored(output)
    assert computed(client, jobs) == (0, [DONE] * len(jobs))
    # another date or place: the bag is read, recognised by its content, and not computed
    bag = fleet.folder / fleet.rows[0]['bag']
    for path in bag.iterdir():
        os.utime(path, (1, 1))
    assert computed(client, jobs)[0] == 0
    assert {k: replace(row, seen='') for k, row in stored(output).items()} == {
        k: replace(row, seen='') for k, row in before.items()}
    # legs do not depend on limits of the result, but on requirements for a leg
    assert computed(client, fleet.jobs(output, '--accept', 'scale_ratio=0:9')[:2])[0] == 0
    assert computed(client, fleet.jobs(tmp_path, '--set', 'leg.min_distance=50')[:2])[0] == 2
    assert stored(tmp_path)[str(bag)].key != before[str(bag)].key


def test_limits_give_a_json_line_per_vehicle_and_the_exit_code(fleet, client, output, capsys):
    argv = ['fleet', fleet.manifest, '--output', str(output), '--scheduler',
            client.scheduler.address, '--method', 'two_point', '--reports', 'none', '--quiet']
    assert main([*argv, '--accept', 'scale_ratio=0.9:1.1']) == 1
    reported = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {one['vehicle'] for one in reported} == {v['vehicle'] for v in fleet.truth}
    broken = {v['vehicle'] for v in fleet.truth if v['changes'][0]['value'] == 'counter'}
    # its good drives are before the fault
    assert {one['vehicle']: one['decision'] for one in reported} == {
        v['vehicle']: 'UNDECIDED' if v['vehicle'] in broken else 'PASS' for v in fleet.truth}
    why, = [one['why'] for one in reported if one['vehicle'] in broken]
    assert re.match(r'rejected: ODOMETER_STILL: the last \d legs, since \S+, are all rejected; '
                    'the last one: the fixes move', why)
    assert main([*argv, '--accept', 'scale_ratio=0.9:1.01']) == 1      # the shuttle is at 1.014
    reported = {(one := json.loads(line))['vehicle']: one['decision']
                for line in capsys.readouterr().out.splitlines()}
    assert reported == {v['vehicle']: 'UNDECIDED' if v['vehicle'] in broken else
                        'PASS' if v['scale_ratio'] < 1.01 else 'FAIL' for v in fleet.truth}
    table = table_of(output)
    worst_first = ['FAIL', 'UNDECIDED', 'PASS']
    assert list(table.decision) == sorted(table.decision, key=worst_first.index)


@contextmanager
def silent_server():
    """Yield the URL of a bag on a server that accepts a connection and never replies."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        yield f'ftp://127.0.0.1:{server.getsockname()[1]}/drive.mcap'


def test_a_bag_that_hangs_and_an_invalid_one_do_not_stop_others(fleet, client, tmp_path):
    (tmp_path / 'no.mcap').write_bytes(b'nothing of a bag')
    good = find_bags([fleet.manifest], None)[:3]
    with silent_server() as url:
        bags = [replace(good[0], bag=url), replace(good[0], bag=str(tmp_path / 'no.mcap')), *good]
        jobs = fleet.jobs(tmp_path / 'out', bags=bags, seconds=0)
        jobs[0] = replace(jobs[0], time_limit_s=6.0)
        assert sorted(computed(client, jobs)[1]) == [DONE] * 3 + [FAILED] * 2
    rows = stored(tmp_path / 'out')
    assert rows[url].reason == 'exceeded the time limit --task-timeout (6 s)'
    assert 'no.mcap' in rows[bags[1].bag].reason
    assert {row.status for bag, row in rows.items() if bag in {b.bag for b in good}} == {DONE}
    # failed rows are kept, and computed again on request
    assert computed(client, jobs[1:]) == (0, [DONE] * 3 + [FAILED])
    assert computed(client, jobs[1:2], retry_failed=True) == (1, [FAILED])


def test_a_bag_whose_worker_is_killed_has_a_row_with_the_reason(fleet, client, tmp_path):
    good = find_bags([fleet.manifest], None)[:3]
    with silent_server() as url:
        jobs = fleet.jobs(tmp_path, bags=[replace(good[0], bag=url), *good], seconds=0)
        threading.Thread(target=kill_at, args=(client, jobs[0])).start()
        assert sorted(computed(client, jobs)[1]) == [DONE] * 3 + [FAILED]
    assert 'its worker ended 1 times' in stored(tmp_path)[url].reason
    client.wait_for_workers(2)


def kill_at(client, job):
    """Kill the worker of a job when it has no other job, which would lose its only try."""
    def at_work():
        return [address for address, keys in client.processing().items()
                if len(keys) == 1 and job.failed_key in str(keys[0])]
    while not (where := at_work()):
        time.sleep(0.1)
    os.kill(client.run(os.getpid, workers=where)[where[0]], signal.SIGKILL)


def test_a_bag_beyond_the_memory_limit_has_a_row_with_the_reason(fleet, client, tmp_path):
    bag = find_bags([fleet.manifest], None)[0]
    jobs = fleet.jobs(tmp_path, '--method', 'smoother', bags=[bag], memory=2**23, seconds=60.0)
    assert computed(client, jobs) == (1, [FAILED])
    assert 'exceeds the memory limit --task-memory' in stored(tmp_path)[bag.bag].reason
    # the worker continues, and its memory is free again
    assert computed(client, fleet.jobs(tmp_path / 'b', bags=[bag])) == (1, [DONE])


def test_libraries_are_loaded_before_memory_is_limited():
    """OpenBLAS that is loaded with 8 to 64 MB of free memory never stops mapping its buffer."""
    code = ('import resource\nimport numpy as np\nfrom odocal_ros.fleet import bag_jobs\n'
            'bag_jobs._load_libraries()\nmost = bag_jobs._data_bytes() + 2**24\n'
            'resource.setrlimit(resource.RLIMIT_DATA, (most, -1))\n'
            'from odocal_ros import estimator\nfrom scipy.linalg import cho_factor\n'
            'cho_factor(np.eye(128) @ np.eye(128))')
    assert subprocess.run([sys.executable, '-c', code], timeout=60.0).returncode == 0


def test_the_scheduler_receives_tasks_in_portions(client):
    found, most = {}, 0
    keys = [str(k) for k in range(400)]
    for i, result, error in task_results(client, abs, range(-400, 0), 'abs', keys):
        found[i], most = (result, error), max(most, len(client.futures))
    assert found == {i: (400 - i, None) for i in range(400)}
    assert most <= 2 * MIN_TASKS      # more when half are left


def test_a_process_that_has_read_rows_ends_without_an_error(output):
    """Three processes: with threads of pyarrow, seven of eight aborted at the end."""
    code = ('import sys\nfrom odocal_ros.fleet.rows import read_rows\n'
            'assert list(read_rows(sys.argv[1:]))')
    files = [str(path) for path in (output / 'rows').rglob('*.parquet')]
    for _ in range(3):
        assert subprocess.run([sys.executable, '-c', code, *files]).returncode == 0


def test_local_workers_accept_only_clients_with_the_key(client):
    import dask
    from distributed import Client
    address = client.scheduler.address
    assert address.startswith('tls://')
    nothing = dict.fromkeys(f'distributed.comm.tls.{name}' for name in (
        'ca-file', 'client.cert', 'client.key'))
    with dask.config.set(nothing | {'distributed.comm.require-encryption': False}), \
            pytest.raises(OSError, match='reset|closed|Timed out'):
        Client(address.replace('tls', 'tcp'), timeout='2s')


def test_calibrate_bags_returns_a_data_frame_of_legs(fleet, client, tmp_path):
    import pandas as pd
    manifest = pd.read_csv(fleet.manifest)[['vehicle', 'bag', 'model']].head(2)
    manifest['bag'] = [str(fleet.folder / bag) for bag in manifest.bag]
    gone = {'vehicle': 'x', 'bag': str(tmp_path / 'gone'), 'model': ''}
    frame = calibrate_bags(pd.concat([manifest, pd.DataFrame([gone])]),
                           {'method': 'two_point', 'odometer.nominal_scale': 0.02}, client=client)
    assert list(frame.status) == [DONE, DONE, FAILED]
    assert 'gone' in frame.reason[2]
    truth = next(v for v in fleet.truth if v['vehicle'] == manifest.vehicle[0])
    off = frame.scale_factor[:2] - truth['scale_factor'][:2]
    assert (abs(off) < 4 * frame.scale_factor_sigma[:2]).all()
