# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A small fleet, simulated once, and two workers for all tests of it."""

from argparse import ArgumentParser
import csv
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

from odocal_ros.fleet.bag_jobs import bag_jobs
from odocal_ros.fleet.bags import find_bags
from odocal_ros.fleet.engine import engine
from odocal_ros.offline.cli import main
from odocal_ros.offline.replay import add_calibration_arguments

VEHICLES, BAGS = 3, 4
# not imported before a test runs: each worker of the tests collects all of them
collect_ignore_glob = [] if find_spec('distributed') and find_spec('cryptography') else ['test_*']


class Fleet:
    """Bags with their truth."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.manifest = str(folder / 'manifest.csv')
        self.truth = yaml.safe_load((folder / 'truth.yaml').read_text())['vehicles']
        with open(self.manifest, newline='') as file:
            self.rows = list(csv.DictReader(file))

    def jobs(self, output: Path, *options: str, seconds: float = 0.0, memory: int = 0,
             bags: list | None = None) -> list:
        return bag_jobs(bags if bags is not None else find_bags([self.manifest], None),
                        arguments(*options), output, seconds, memory)


def arguments(*options: str):
    """Return options of replay: the quick method by default."""
    parser = ArgumentParser()
    add_calibration_arguments(parser)
    return parser.parse_args(['--method', 'two_point', *options])


@pytest.fixture(scope='session')
def fleet(tmp_path_factory):
    folder = tmp_path_factory.mktemp('fleet') / 'fleet'
    assert main(['simulate', '--scenario', 'straight', '--duration', '180', '--fix-noise', 'rtk',
                 '--imu-rate', '25', '--odometer-rate', '10', '--fix-rate', '2', '--fleet',
                 str(VEHICLES), '--bags', str(BAGS), '--out', str(folder), '--quiet']) == 0
    return Fleet(folder)


@pytest.fixture(scope='session')
def client():
    """Two local workers; a bag that ends its worker is tried once."""
    import dask
    with engine(None, 2, 2**31, 1) as client:
        keys = client.security
        # the command with the address reads them from the configuration, as for a cluster
        with dask.config.set({'distributed.comm.require-encryption': True,
                              'distributed.comm.tls.ca-file': keys.tls_ca_file,
                              'distributed.comm.tls.client.cert': keys.tls_client_cert,
                              'distributed.comm.tls.client.key': keys.tls_client_key}):
            yield client
