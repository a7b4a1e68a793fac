# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Write .ci/constraints.txt: the installed versions of all dependencies of odocal_ros.

Run ``python -m tools.pin_versions`` in the environment of the tests.
"""

import argparse
from importlib.metadata import distribution, PackageNotFoundError
from pathlib import Path
import platform

from packaging.requirements import Requirement

PATH = Path(__file__).resolve().parent.parent / '.ci' / 'constraints.txt'
EXTRAS = ('', 'fleet', 'ros', 'tables', 'watch')


def needed(name: str, extras: tuple[str, ...], found: dict[str, str]) -> None:
    """Add name -> version of the requirements of a package, recursively."""
    for line in distribution(name).requires or ():
        wanted = Requirement(line)
        if wanted.marker and not any(wanted.marker.evaluate({'extra': extra}) for extra in extras):
            continue
        key = wanted.name.lower().replace('_', '-')
        if key in found:
            continue
        try:
            found[key] = distribution(wanted.name).version
        except PackageNotFoundError:      # of another platform, or not installed
            continue
        needed(wanted.name, ('', *wanted.extras), found)


def main() -> None:
    """Write the file."""
    argparse.ArgumentParser(description=__doc__).parse_args()   # --help writes nothing
    found: dict[str, str] = {}
    needed('odocal_ros', EXTRAS, found)
    head = (f'# made by tools/pin_versions.py on Python {platform.python_version()}: all that is '
            'installed with\n# the extras fleet, ros, tables and watch\n')
    PATH.write_text(head + ''.join(f'{name}=={found[name]}\n' for name in sorted(found)))


if __name__ == '__main__':
    main()
