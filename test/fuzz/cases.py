# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
One fuzz case: a bag, a mutation, a command in its own process, and a check of the outcome.

Seed and number define a case; one case: ``python benchmarks/fuzz.py --seed S --only N``.
"""

from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
import gc
import hashlib
import json
import os
from pathlib import Path
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings

from damage import file_of
import mutations
import semantic

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.scenarios import simulate

SECONDS = 60.0           # limit of a case
MEMORY = 2**30           # bytes: limit above the memory for a clean bag
BASES = {'mcap': ('mcap', 'none', 'counts'), 'zstd': ('mcap', 'storage', 'counts'),
         'messages': ('mcap', 'message', 'speed'), 'file': ('mcap', 'file', 'counts'),
         'sqlite3': ('sqlite3', 'none', 'counts'), 'angle': ('sqlite3', 'none', 'angle'),
         'rosbag1': ('rosbag1', 'none', 'counts'), 'journal': ('mcap', 'storage', 'counts')}
JOURNAL = ('/calibrator:\n  ros__parameters:\n    leg:\n      min_distance: 50.0\n    imu:\n'
           '      grade: industrial\n      lever_arm: [0.0, 0.0, 0.0]\n    frames:\n'
           "      base: base_link\n      imu: ''\nodocal_journal:\n  ros__parameters:\n"
           '    topics:\n      imu: /imu/data\n      odometer: /odometer\n      fix: /fix\n')


@dataclass(frozen=True)
class Outcome:
    """Outcome of a case; ``wrong`` is empty if there is no error."""

    number: int
    what: str
    code: int
    seconds: float
    memory: int
    said: str
    wrong: str


@dataclass(frozen=True)
class Bases:
    """Clean bags by name, the truth of each, and options with which a clean one is accepted."""

    folder: Path
    truth: dict
    options: list

    def bag(self, name: str) -> Path:
        return self.folder / name / ('bag.bag' if name == 'rosbag1' else 'bag')


def bases(folder: Path) -> Bases:
    """Write the clean bags: of a short drive with few samples, so that a case costs little."""
    @cache
    def drive(odometer):
        return simulate(SimOptions(scenario='town', duration=136.0, imu_rate=10.0, seed=3,
                                   imu_grade='industrial', odometer_rate=5.0, fix_rate=2.0,
                                   odometer=odometer))

    truth = {}
    for name, (storage, compression, odometer) in BASES.items():
        made = drive(odometer)
        (folder / name).mkdir(parents=True)
        path = folder / name / ('bag.bag' if storage == 'rosbag1' else 'bag')
        write_bag(path, drive_topics(made), storage, compression)
        if name == 'journal':
            (path / 'journal.yaml').write_text(JOURNAL)
        truth[name] = made.truth
    # a heading, and limits within which the two-point method is accepted: so the cheapest method
    # can give a wrong value
    options = [f'alignment.heading={made.truth.heading}', 'alignment.heading_sigma=0.002',
               'alignment.heading_source=fixed', 'verdict.max_scale_sigma=0.005',
               'verdict.max_yaw_sigma=0.05']
    return Bases(folder, truth, [text for option in options for text in ('--set', option)])


def warm_up(clean: Bases) -> Bases:
    """Import all that a case needs, so that a forked process has it; return the bags."""
    from odocal_ros.offline.cli import main
    os.environ['MPLCONFIGDIR'] = str(clean.folder)      # for the font list of matplotlib
    for name, out in (('mcap', 'out'), ('messages', 'odd'), ('sqlite3', 'db'), ('rosbag1', 'one')):
        with redirect_stdout(None), redirect_stderr(None):
            main(['inspect', str(clean.bag(name))])
            main(['replay', str(clean.bag(name)), '--output', str(clean.folder / out)])
    gc.collect()
    gc.freeze()           # else the first collection of every child copies all this memory
    return clean


def run(seed: int, clean: Bases, work: Path, numbers: list[int]) -> list[Outcome]:
    """
    Run cases in one forked process; repeat each failed case in its own process.

    One fork serves many cases, and no case affects the outcome of another.
    """
    ended = work / f'told_{numbers[0]}'
    ended.touch()
    pid = os.fork()
    if not pid:
        try:
            with ended.open('a') as file:
                limit()
                for number in numbers:
                    outcome = case(seed, clean, work, number, here)
                    file.write(json.dumps(vars(outcome)) + '\n')
                    file.flush()
        finally:
            os._exit(0)
    os.wait4(pid, 0)
    ran = {line['number']: Outcome(**line) for line in map(json.loads, ended.open())}
    ended.unlink()
    return [ran[n] if n in ran and not ran[n].wrong else case(seed, clean, work, n, child)
            for n in numbers]


def case(seed: int, clean: Bases, work: Path, number: int, ran) -> Outcome:
    """Run a case in its own folder, which is removed afterwards."""
    rng = random.Random(f'{seed}:{number}')
    place = work / f'case_{number}'
    shutil.rmtree(place, ignore_errors=True)
    for name in ('bags', 'tmp', 'home'):
        (place / name).mkdir(parents=True)
    base = rng.choice(list(BASES))
    bag = place / 'bags' / clean.bag(base).name
    (shutil.copy if clean.bag(base).is_file() else shutil.copytree)(clean.bag(base), bag)
    done, options, factors = mutated(rng, base, bag)
    argv = command(rng, bag, clean.options, options, whole=factors is not None)
    if argv[0] == 'replay':
        argv += ['--output', str(place / 'out')]
    before = tree(place)
    code, seconds, memory = ran(argv, place)
    said = (place / 'stderr').read_text(errors='replace')
    wrong = judged(place, before, code, seconds, memory, said,
                   semantic.ranges(clean.truth[base], factors) if not options else None)
    shutil.rmtree(place)
    method = argv[3] if argv[0] == 'replay' else ''
    return Outcome(number, f'{base} {done} {argv[0]} {method}'.rstrip(), code, seconds, memory,
                   said[-400:], wrong)


def command(rng, bag, wide, options, whole) -> list[str]:
    """Return a command line: mostly of the cheapest method, ``whole``: of the whole pipeline."""
    if rng.random() < 0.2:
        return ['inspect', str(bag), *(o for o in options if not o.startswith('--leg='))]
    few = [] if rng.random() < 0.005 else ['--set', 'output.formats=[params]']
    if rng.random() < (0.3 if whole else 0.9):
        return ['replay', str(bag), '--method', 'two_point', *wide, *few, *options]
    return ['replay', str(bag), '--method', rng.choice(['auto', 'smoother', 'patent']), *few,
            *options]


def mutated(rng, base, bag):
    """
    Change a bag, or make odd options; return the name of the change, options and factors.

    Factors of the true scale factor, (least, largest), if the meaning changes; else None.
    """
    if rng.random() < 0.15:
        return 'options', mutations.texts(rng, bag.parent), None
    if base == 'journal' and rng.random() < 0.4:
        mutations.text_file(rng, bag / 'journal.yaml')
        return 'journal_text', [], None
    if BASES[base][0] == 'sqlite3' and rng.random() < 0.5:
        change = rng.choice(semantic.ALL)
        return change.__name__, [], semantic.change_sqlite(rng, file_of(bag), change)
    change = rng.choice(mutations.OF.get(base) or mutations.OF[BASES[base][0]])
    change(rng, bag)
    return change.__name__, [], None


def tree(place: Path) -> dict:
    """Return all files under a folder with their checksums."""
    return {str(f.relative_to(place)): hashlib.sha256(f.read_bytes()).digest()
            for f in sorted(place.rglob('*')) if f.is_file()}


def child(argv, place):
    """Run a command in a forked process; return its code, seconds and peak memory, bytes."""
    pid = os.fork()
    if not pid:
        code = 99
        try:
            limit()
            code, _, _ = here(argv, place)
        finally:
            os._exit(code)
    _, status, used = os.wait4(pid, 0)
    return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss * 1024


def limit() -> None:
    """Limit the memory of this process, and show every repeated warning."""
    resource.setrlimit(resource.RLIMIT_DATA, (3 * MEMORY, 3 * MEMORY))
    warnings.filterwarnings('always', category=RuntimeWarning)


def here(argv, place):
    """Run a command in this process; return its code, seconds and the peak memory, bytes."""
    from odocal_ros.offline.cli import main
    signal.alarm(int(2 * SECONDS))         # ends a process that waits forever
    os.environ.update(HOME=str(place / 'home'), TMPDIR=str(place / 'tmp'))
    os.chdir(place / 'tmp')
    tempfile.tempdir = str(place / 'tmp')
    sys.argv = ['odocal', *argv]
    begin = time.process_time()
    with open(place / 'stdout', 'w') as out, open(place / 'stderr', 'w') as err:
        os.dup2(err.fileno(), 2)
        with redirect_stdout(out), redirect_stderr(err):
            code = main(argv)
    signal.alarm(0)
    return (code, time.process_time() - begin,
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)


def judged(place, before, code, seconds, memory, said, truth) -> str:
    """Return the error of an outcome, '' if there is none."""
    # the settings of a journal are printed first
    lines = [line for line in said.strip().splitlines() if ' is a journal: ' not in line]
    # topics, and clauses that end in a semicolon, have their own lines
    sentences = [line for previous, line in zip(['', *lines], lines, strict=False)
                 if not line.startswith('  /') and not previous.endswith(';')]
    if code not in (0, 1, 2):
        return f'exit {code}'
    if code == 2 and len(sentences) != 1:
        return f'{len(sentences)} sentences for exit 2'
    if 'Warning' in said or 'Traceback' in said or 'broke' in said or 'out of memory' in said:
        return 'more than a sentence on stderr'
    if seconds > SECONDS:
        return f'{seconds:.0f} s'
    if memory > MEMORY + 400 * 2**20:       # of which the interpreter and a clean leg take 0.3 GB
        return f'{memory / 2**20:.0f} MiB'
    after = tree(place)
    added = [n for n in after if n not in before and not n.startswith(('out/', 'std'))]
    changed = [n for n in before if after.get(n) != before[n]]
    if added or changed:
        return f'files: {added or changed}'
    if (place / 'out' / 'calibration.json').exists() and truth:
        return false_value(json.loads((place / 'out' / 'calibration.json').read_text()), truth)
    return ''


def false_value(content, truth) -> str:
    """Return the worst of the accepted values that are wrong, '' if there is none."""
    if content['verdict'] != 'accepted':
        return ''
    sigmas, what = semantic.worst_error({
        name: (entry.get('value'), entry.get('sigma'))
        for name, entry in content['result'].items() if isinstance(entry, dict)}, truth)
    return '' if sigmas <= semantic.SIGMAS else what
