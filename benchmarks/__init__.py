"""lidar-mi side by side with other ways to the same result, measured in one run.

``make bench`` (or ``python -m benchmarks``) prints one table per comparison and writes them to
``docs/performance.md`` and ``outputs/benchmarks.json``; with ``--quick`` small cases of some, and
of those named no page. The ratios are the result: both sides take turns, and a ratio is the
median over the turns, as times are noisy and depend on the machine.

estimators   the gated estimator against the analog one
transient    the renderer against mitransient's volumetric integrator
velocimetry  cross-correlation against OpenPIV
methods      wind from exact images by all methods, and by public codes
rendered     wind from rendered images by all methods, and the fraction of every cause of error
renderer     speed and memory of the renderer alone
rings        wind from ring images, all rings at once, against a 2-D fit and scipy
"""

import lidar_mi  # noqa: F401  chooses the LLVM before any of the modules here imports drjit
