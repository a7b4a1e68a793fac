# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A report of one's own, as one picture: python custom_report.py BAG report.png."""

import sys

from matplotlib.figure import Figure

from odocal_ros import calibrate_bag

bag, picture = sys.argv[1:]
calibration = calibrate_bag(bag, config={'odometer.nominal_scale': 0.02})
if calibration.values['scale_factor'] is None:      # nothing to draw, but why
    sys.exit('\n'.join(f'{reason.code.name}: {reason.text}' for reason in calibration.reasons))
figure = Figure(figsize=(8, 10), layout='constrained')
track, residuals, table = figure.subplots(3, height_ratios=(5, 3, 2))
calibration.plot_track(track)
calibration.plot_residuals(residuals)
rows = [(name, f'{value:.6g}', f'{calibration.sigmas[name]:.2g}')
        for name, value in calibration.values.items() if value is not None]
table.axis('off')
table.table(rows[:5], colLabels=('value', '', '1 sigma'), loc='center')
figure.suptitle(f'{bag}: {calibration.verdict.value}')
figure.savefig(picture)
