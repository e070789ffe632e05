"""The gated estimator against the analog one, in the paper's scan.

Efficiency = 1 / (variance x time). Both estimators render the same scene with the same beams, so
variances per Monte Carlo sample are compared beam by beam and then averaged. The fraction T tau of
the analog samples scatters in the gate, with the slab's optical depth tau and the transmittance T
to it. Their weight is about that of every gated sample: the ratio of relative variances is
(1 / (T tau)) / cv^2, with cv the coefficient of variation of a gated sample's weight.
"""

import mitsuba as mi
import numpy as np

from .measure import Timed, in_turns
from .report import Comparison, Row, row
from .scans import paper_scan, set_extinction

# the brightest and the darkest beams of the textured wake, fractions of all beams
BRIGHTEST, DARKEST = 0.01, 0.1


def compare(repeats: int = 5, samples: int = 64, columns: int = 219, rows: int = 139) -> Comparison:
    """Both estimators at peak and at environment extinction, homogeneous and in the wake."""
    scan = paper_scan(columns, rows)
    scene = scan.scene()
    gated = scene.integrator()
    analog = mi.load_dict({"type": "gated_volpath", "estimator": "analog"})
    mapping = scan.experiment.wake.extinction

    def measured(field, seed):
        set_extinction(scene, field)

        def render(integrator):
            return lambda turn: np.array(
                mi.render(scene, integrator=integrator, spp=samples, seed=seed + turn), float
            ).reshape(columns * rows, -1)[:, :5]

        return in_turns({"gated": render(gated), "analog": render(analog)}, repeats)

    lines = []
    homogeneous = {"peak": mapping.maximum, "environment": mapping.background}
    for case_number, (name, extinction) in enumerate(homogeneous.items()):
        field = scan.fields[0].copy(data=np.full(scan.fields[0].shape, extinction))
        found = measured(field, 1000 * case_number)
        case = f"homogeneous slab, {name} extinction {1e3 * extinction:.1f} / km"
        every = np.ones(columns * rows, bool)
        expected = f"1 / tau of the gate = {1 / (extinction * scan.thickness):.0f}"
        lines += _rows(case, found["gated"], found["analog"], samples, every, expected)
    found = measured(scan.fields[0], 1000 * len(homogeneous))
    brightness = np.mean([image[:, 0] for _, image in found["gated"]], axis=0)
    for name, chosen in (
        (f"brightest {BRIGHTEST:.0%}", brightness >= np.quantile(brightness, 1 - BRIGHTEST)),
        (f"darkest {DARKEST:.0%}", brightness <= np.quantile(brightness, DARKEST)),
    ):
        case = f"textured wake, {name} of the beams"
        lines += _rows(case, found["gated"], found["analog"], samples, chosen)
    return Comparison(
        f"Gated against analog estimator ({columns} x {rows} beams, {samples} samples per beam)",
        "gated",
        "analog",
        tuple(lines),
        (
            "Samples per contributing one: one that scatters in the gate. Times: whole calls, all "
            "beams.",
            (
                "Relative variance: of one sample's weight, over the squared mean, beam by beam. "
                "Its ratio is the factor by which the analog estimator needs more samples. It "
                "exceeds 1 / tau because all gated samples contribute with nearly equal weights; "
                "in the wake, texture within a beam increases their variance."
            ),
        ),
    )


def _rows(
    case: str,
    gated: list[Timed],
    analog: list[Timed],
    samples: int,
    chosen: np.ndarray,
    expected: str = "",
) -> list[Row]:
    """Rows for the chosen beams; images are (beams, 5): Stokes vector and standard error."""
    mean = np.mean([image[chosen, 0] for _, image in gated], axis=0)

    def variance(images):
        return [np.mean((image[chosen, 4] / mean) ** 2) * samples for _, image in images]

    def seconds(images):
        return [s / (samples * len(image)) for s, image in images]

    ours, other = variance(gated), variance(analog)
    time, other_time = seconds(gated), seconds(analog)
    # E[w^2] of a sample: 1 + cv^2 if all contribute, (1 + cv^2) / p if a fraction p does
    one_in = [(1 + a) / (1 + g) for g, a in zip(ours, other, strict=True)]
    need = [max(2.0, np.ceil(v / 1e-4)) for v in ours]
    lines = [
        row(case, "samples per contributing one", "", [1.0], one_in, "lower", expected),
        row(case, "relative variance of one sample", "", ours, other, "lower"),
        row(
            case,
            "samples per beam for 1 %",
            "",
            need,
            [v / 1e-4 for v in other],
            "lower",
            "gated: at least 2, for a standard error",
        ),
        row(
            case,
            "time of one sample",
            "ns",
            [1e9 * t for t in time],
            [1e9 * t for t in other_time],
            "lower",
        ),
        row(
            case,
            "variance x time of one sample",
            "ns",
            [1e9 * v * t for v, t in zip(ours, time, strict=True)],
            [1e9 * v * t for v, t in zip(other, other_time, strict=True)],
            "lower",
            "ratio of efficiencies",
        ),
    ]
    # are both means equal, and the reported standard errors those over the seeds?
    total = np.mean([image[chosen, 0].mean() for _, image in analog]) / mean.mean() - 1
    error = np.sqrt(np.mean(other) / (samples * len(analog) * chosen.sum()))
    lines.append(
        row(case, "mean signal / gated mean", "", [1.0], [1 + total], note=f"+- {error:.2g}")
    )
    if len(gated) > 1:
        variance_ratios = []
        for images in (gated, analog):
            observed = np.var([image[chosen, 0] for _, image in images], axis=0, ddof=1).mean()
            reported = np.mean([image[chosen, 4] ** 2 for _, image in images])
            variance_ratios.append(observed / reported)
        lines.append(
            row(
                case, "variance over seeds / reported", "", variance_ratios[:1], variance_ratios[1:]
            )
        )
    return lines
