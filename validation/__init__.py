"""Comparison of lidar-mi with independent numbers.

``make validate`` (or ``python -m validation``) runs every check, prints its tables and stores them
in ``validation/results``, a file for each group, of which the site makes pages. It ends with an
error if any row fails.

lidar_equation       single scattering: closed forms
multiple_scattering  all orders in a dense slab: an independent simulation in numpy
narrow_fields        light scattered twice in 0.05 to 20 mrad: a quadrature in double precision
steady_state         all ranges together: an integral equation, conservation of energy, Eradiate
scattering_matrices  particles: published tables, other solvers, inequalities of matrices
molecules            air: published numbers
standard_errors      standard errors against the scatter over seeds
gradients            derivatives of an image against those of the lidar equation
receivers            analysers of the Doppler shift: published efficiencies, cost of 0.5 m/s
strips               loads of a wake on a wing: closed forms, a lattice of vortices
track                track of a vortex pair: errors over simulated flights are as stated
timing               winds of beams with times and poses: closed forms
air                  turbulence, gusts and a microburst: theory, regulations
filaments            bent vortices, rings, decay: theory, published numbers
loads                an aircraft that rises in gusts: closed forms, its frequency response
common_numbers       error of winds by the simulation's own noise; only by name
coverage             standard errors of winds where air changes; stored by name or with --slow
instrument           winds by an etalon with defects; only by name
flows                winds of families of flows that judge, and of those that build; only by name
defects              winds of images with defects, by families that judge; only by name
resolution           winds from fewer, larger pixels, against their bound; only by name
line_vortices        vortices from slices of a Doppler lidar: errors, coverage, false alarms; only
                     by name
pairs_in_air         tracks of pairs in families of air, half of which only judge; only by name
control_loops        roll and load that control blocks predict, in rendered flights; only by name
"""

import lidar_mi  # noqa: F401  chooses the LLVM before any of the modules here imports drjit

GROUPS = (
    "lidar_equation",
    "multiple_scattering",
    "narrow_fields",
    "steady_state",
    "scattering_matrices",
    "molecules",
    "standard_errors",
    "gradients",
    "receivers",
    "strips",
    "track",
    "timing",
    "air",
    "filaments",
    "loads",
    "coverage",
)
OPEN = (
    "common_numbers",
    "instrument",
    "flows",
    "defects",
    "resolution",
    "line_vortices",
    "pairs_in_air",
    "control_loops",
)
"""Run only by name: some of their rows fail."""
TOLD = ("coverage", "flows", "defects")
"""Groups whose texts hold their tables."""
