"""
One case of fuzzing: a bag, something done to it, a command in a process of its own, a judgement.

A case is its seed and its number; alone: ``python benchmarks/fuzz.py --seed S --only N``.
"""

from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
import hashlib
import json
import os
from pathlib import Path
import random
import resource
import shutil
import signal
import sys
import time

import mutations

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.scenarios import simulate

SECONDS = 60.0           # of a case, at most
MEMORY = 2**30           # bytes over what a clean bag takes, at most
SIGMAS = 5.0
NAMES = {'scale_factor': 'scale', 'yaw_mounting_angle': 'yaw', 'pitch_mounting_angle': 'pitch'}
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
    """What became of a case; ``wrong`` is empty where it is as it should be."""

    number: int
    what: str
    code: int
    seconds: float
    memory: int
    said: str
    wrong: str


@dataclass(frozen=True)
class Bases:
    """Clean bags by name, the truth of each, and what a clean run takes."""

    folder: Path
    truth: dict

    def bag(self, name: str) -> Path:
        """Return a clean bag."""
        return self.folder / name / ('bag.bag' if name == 'rosbag1' else 'bag')


def bases(folder: Path) -> Bases:
    """Write the clean bags."""
    truth = {}
    for name, (storage, compression, odometer) in BASES.items():
        made = simulate(SimOptions(scenario='town', duration=240.0, imu_rate=50.0, seed=3,
                                   imu_grade='industrial', odometer_rate=20.0, odometer=odometer))
        (folder / name).mkdir(parents=True)
        path = folder / name / ('bag.bag' if storage == 'rosbag1' else 'bag')
        write_bag(path, drive_topics(made), storage, compression)
        if name == 'journal':
            (path / 'journal.yaml').write_text(JOURNAL)
        truth[name] = {n: float(getattr(made.truth, short)) for n, short in NAMES.items()}
    clean = Bases(folder, truth)
    warm_up(clean)
    return clean


def warm_up(clean: Bases) -> None:
    """Import here what every case would import: a forked process has it then."""
    from odocal_ros.offline.cli import main
    os.environ['MPLCONFIGDIR'] = str(clean.folder)      # of matplotlib's list of fonts
    for name, out in (('mcap', 'out'), ('messages', 'odd')):
        with redirect_stdout(None), redirect_stderr(None):
            main(['replay', str(clean.bag(name)), '--output', str(clean.folder / out)])


def run(seed: int, number: int, clean: Bases, work: Path) -> Outcome:
    """Run a case in a folder of its own, which is gone afterwards."""
    rng = random.Random(f'{seed}:{number}')
    place = work / f'case_{number}'
    shutil.rmtree(place, ignore_errors=True)
    for name in ('bags', 'tmp', 'home'):
        (place / name).mkdir(parents=True)
    base = rng.choice(list(BASES))
    bag = place / 'bags' / clean.bag(base).name
    (shutil.copy if clean.bag(base).is_file() else shutil.copytree)(clean.bag(base), bag)
    done, options = mutated(rng, base, bag)
    if rng.random() < 0.25:
        argv = ['inspect', str(bag), *(o for o in options if not o.startswith('--leg='))]
    else:
        method = rng.choice(['auto', 'auto', 'two_point', 'smoother', 'wheels'])
        few = [] if rng.random() < 0.05 else ['--set', 'output.formats=[params]']
        argv = ['replay', str(bag), '--method', method, *few, '--output', str(place / 'out'),
                *options]
    before = tree(place)
    code, seconds, memory = child(argv, place)
    said = (place / 'stderr').read_text(errors='replace')
    wrong = judged(place, before, code, seconds, memory, said,
                   clean.truth[base] if not options else None)
    shutil.rmtree(place)
    return Outcome(number, f'{base} {done} {argv[0]}', code, seconds, memory, said[-400:], wrong)


def mutated(rng, base, bag):
    """Change a bag, or say it all by options; return what was done and the options."""
    if rng.random() < 0.15:
        return 'options', mutations.texts(rng)
    kinds = mutations.OF[BASES[base][0]]
    if base == 'file':        # packed as a whole: no record can be reached
        kinds = [mutations.raw, mutations.clump, mutations.metadata]
    change = rng.choice(kinds)
    if base == 'journal' and rng.random() < 0.5:
        mutations.text_file(rng, bag / 'journal.yaml')
        return 'journal_text', []
    if base == 'messages' and change is mutations.mcap_inside:
        change = mutations.mcap_records
    change(rng, bag)
    return change.__name__, []


def tree(place: Path) -> dict:
    """Return all files under a folder with their sums."""
    return {str(f.relative_to(place)): hashlib.sha256(f.read_bytes()).hexdigest()
            for f in sorted(place.rglob('*')) if f.is_file()}


def child(argv, place):
    """Run a command in a forked process; return its code, seconds and most memory, bytes."""
    from odocal_ros.offline.cli import main
    begin = time.monotonic()
    pid = os.fork()
    if not pid:
        code = 99
        try:
            os.environ.update(HOME=str(place / 'home'), TMPDIR=str(place / 'tmp'))
            os.chdir(place / 'tmp')
            import tempfile
            tempfile.tempdir = str(place / 'tmp')
            sys.argv = ['odocal', *argv]
            resource.setrlimit(resource.RLIMIT_DATA, (3 * MEMORY, 3 * MEMORY))
            with open(place / 'stdout', 'w') as out, open(place / 'stderr', 'w') as err:
                os.dup2(err.fileno(), 2)
                with redirect_stdout(out), redirect_stderr(err):
                    code = main(argv)
        finally:
            os._exit(code)
    while True:
        done, status, used = os.wait4(pid, os.WNOHANG)
        if done:
            break
        if time.monotonic() - begin > 2 * SECONDS:
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.005)
    return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss * 1024


def judged(place, before, code, seconds, memory, said, truth) -> str:
    """Return what is wrong with an outcome, '' if nothing is."""
    # what a journal is read with is told before
    lines = [line for line in said.strip().splitlines() if ' is a journal: ' not in line]
    if code not in (0, 1, 2):
        return f'exit {code}'
    if code == 2 and len(lines) != 1:
        return f'{len(lines)} lines for exit 2'
    if 'Warning' in said or 'Traceback' in said or 'broke' in said or 'memory ran out' in said:
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
    """Return the values that are accepted without a word and are not true."""
    if content['verdict'] != 'accepted':
        return ''
    off = []
    for name, true in truth.items():
        entry = content['result'].get(name) or {}
        if entry.get('value') is None:
            continue
        z = (entry['value'] - true) / entry['sigma']
        if not abs(z) <= SIGMAS:
            off.append(f'{name} {entry["value"]:.6g} +- {entry["sigma"]:.2g}, {true:.6g} is true')
    return '; '.join(off)
