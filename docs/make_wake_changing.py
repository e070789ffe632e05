"""Write the table of docs/experiments/wake_changing.md from runs of the experiment.

Usage: ``python docs/make_wake_changing.py``, about two minutes.
"""

from pathlib import Path

import numpy as np
import xarray as xr

import lidar_mi as lm
from lidar_mi.assessment.metrics.names import Source

PAGE = Path(__file__).with_name("experiments") / "wake_changing.md"
BEGIN, END = "<!-- winds: begin -->", "<!-- winds: end -->"
SOURCES = {
    Source.NOISY: "rendered images with noise of the detector",
    Source.BACKSCATTER: "rendered images, all orders",
    Source.EXTINCTION: "the extinction field itself",
    Source.WITHOUT_TEXTURE: "the extinction field without sub-grid texture",
}
MOTIONS = {"advect_3d": "in three dimensions", "advect": "in the plane alone"}
"""Of the air, by ``wake.second``."""
HEAD = (
    "| variational, rms error, m/s | motion of the air | v | w | valid | within 1 / 1.96 standard "
    "errors | variance of normalised errors |\n" + "| --- " * 7 + "|"
)


def row(name: str, motion: str, wind: xr.Dataset) -> str:
    """One line of the table.

    Parameters
    ----------
    wind : xr.Dataset, dims (z, y)
        v, w with ``_stderr`` and ``_true``, m/s, and ``flag``.
    """
    valid = (wind["flag"] == 0).values
    cells = [name, motion, "-", "-", f"{100 * valid.mean():.0f} %", "-", "-"]
    if valid.any():
        errors = {n: (wind[n] - wind[f"{n}_true"]).values[valid] for n in "vw"}
        scores = np.stack([errors[n] / wind[f"{n}_stderr"].values[valid] for n in "vw"])
        within = [100 * np.mean(np.abs(scores) < limit) for limit in (1, 1.96)]
        cells[2:4] = [f"{np.sqrt(np.mean(errors[n] ** 2)):.2f}" for n in "vw"]
        cells[5:] = ["{:.0f} / {:.0f} %".format(*within), f"{np.mean(scores**2):.2f}"]
    return f"| {' | '.join(cells)} |"


def table() -> str:
    """Winds of both motions by source, and the true wind's rms."""
    runs = {
        second: lm.run(
            lm.load_experiment(
                "wake_changing",
                wake={"second": second},
                retrieval={"methods": ["variational"], "error_budget": False},
            )
        ).wind.sel(algorithm="variational")
        for second in MOTIONS
    }
    lines = [
        row(text, motion, runs[second].sel(source=source))
        for source, text in SOURCES.items()
        for second, motion in MOTIONS.items()
    ]
    true = runs["advect_3d"].isel(source=0)
    rms = [f"{float(np.sqrt((true[f'{n}_true'] ** 2).mean())):.1f}" for n in "vw"]
    last = f"| *(rms of the true wind)* | | {rms[0]} | {rms[1]} | | *(68 / 95 %)* | *(1)* |"
    return "\n".join([HEAD, *lines, last])


def with_table(page: str, text: str) -> str:
    """The page with the table between its marks."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"{PAGE.name}: expected {BEGIN} ... {END}")
    return f"{before}{BEGIN}\n\n{text}\n\n{END}{after}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), table()), encoding="utf-8")
    print(f"written: {PAGE}")
