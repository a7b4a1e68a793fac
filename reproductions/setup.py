# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Package for pip and for colcon (ament_python)."""

from pathlib import Path
import re

from setuptools import find_packages, setup

NAME = 'odocal_reproductions'
HERE = Path(__file__).resolve().parent
VERSION = re.search(r"^__version__ = '(.+)'$", (HERE / NAME / '__init__.py').read_text(),
                    re.MULTILINE).group(1)

setup(
    name=NAME,
    version=VERSION,
    description='Published results that odocal_ros reproduces: odocal paper, odocal patent',
    author='Seed 08f791d2 maintainers',
    author_email='maintainers@users.noreply.h-seed-08f791d2.example',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
    ],
    python_requires='>=3.11',
    # modules of odocal_ros that are not stable: of the same version alone
    install_requires=[f'odocal_ros=={VERSION}', 'numpy>=1.26', 'pyproj>=3.6'],
    entry_points={
        # commands that odocal_ros.offline.cli finds here
        'odocal.commands': [f'{name} = {NAME}.{name}.command' for name in ('paper', 'patent')],
    },
    zip_safe=True,
)
