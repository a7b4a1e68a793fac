# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The printed tables 1 to 4 of Shi et al. 2015, and a cell with a printed and a computed value.

Shi, Ma, Zhang, Zhang 2015, 'The initial calibration of odometer and error analysis'. Tables 1 and
2 print magnitudes. The yaw errors of tables 3 and 4 are printed as truth - estimate; computed
errors are always estimate - truth.
"""

from dataclasses import dataclass

CONVENTION = ('value: estimate - truth; printed: as printed, which in the yaw columns of tables 3 '
              'and 4 is truth - estimate, and in tables 1 and 2 a magnitude')

# rate of a state: {state or drift: printed coefficient}
TABLE_1 = {
    'dL': {'phi_U': 2.2e-6},
    'dlam': {'dL': 2.4e-6, 'phi_U': 2.8e-6},
    'phi_E': {'phi_N': 5.0e-5, 'phi_U': 5.6e-5, 'eps_E': 1.0},
    'phi_N': {'dL': 4.7e-5, 'phi_E': 4.9e-5, 'eps_N': 1.0},
    'phi_U': {'dL': 5.9e-5, 'phi_E': 5.8e-5, 'phi_N': 2.2e-6, 'phi_U': 2.2e-6, 'eps_U': 1.0},
}
TABLE_2 = {
    'dL': {'phi_U': 2.4e-9},
    'dlam': {'dL': 3.8e-12, 'phi_U': 3.1e-9},
    'phi_E': {'phi_N': 7.5e-9, 'phi_U': 6.2e-8, 'eps_E': 4.8e-8},
    'phi_N': {'dL': 7.5e-10, 'phi_E': 7.5e-9, 'eps_N': 4.8e-8},
    'phi_U': {'dL': 9.4e-11, 'phi_E': 8.7e-9, 'phi_N': 3.3e-10, 'phi_U': 2.2e-9, 'eps_U': 4.8e-8},
}
# source: (scale error in K, yaw error in deg)
TABLE_3: dict[str, tuple[float | None, float | None]] = {
    'none': (None, None),
    'eps_x': (4.016e-8, 3.002e-5),
    'eps_y': (4.016e-8, 2.944e-5),
    'eps_z': (4.016e-8, -7.968e-4),
    'phi_E0': (4.017e-8, -2.338e-5),
    'phi_N0': (4.015e-8, 1.811e-4),
    'phi_U0': (4.016e-8, 0.0596),
    'all': (4.016e-8, 0.0589),
}
# source: {line: (scale error in K0, yaw error in deg)}
TABLE_4 = {
    'eps_z': {'simulated': (4.016e-8, -0.0008), 'formula': (4.845e-8, -0.0008)},
    'phi_U0': {'simulated': (4.016e-8, 0.0596), 'formula': (3.416e-6, 0.0588)},
}


@dataclass(frozen=True)
class Cell:
    """A printed and a computed value."""

    printed: float | None
    value: float                # computed; its magnitude if ``sign`` is set
    sign: int | None = None     # 1 or -1, of the computed value
    printed_sign: int = 1       # -1 if the printed value is truth - estimate
    remark: str = ''            # usually a misprint

    @property
    def ratio(self) -> float | None:
        """Return the computed over the printed value, both estimate - truth."""
        return self.value / (self.printed_sign * self.printed) if self.printed else None

    def as_dict(self) -> dict[str, float | str | None]:
        """Return the entry of --json."""
        entry: dict[str, float | str | None] = {
            'printed': self.printed, 'value': self.value, 'ratio': self.ratio}
        if self.sign is not None:
            entry['sign'] = self.sign
        return entry | ({'remark': self.remark} if self.remark else {})
