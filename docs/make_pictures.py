"""Make the pictures of the pages: ``make pictures``, or ``python docs/make_pictures.py NAME ...``.

Each picture has one maker below: a figure of an experiment, of a flight or of a campaign, an
example, a notebook, or a check of the validation. Runs are left in outputs/ and resumed from there:
what is done is only drawn again. All of them take hours on two cores, of which the campaigns and
the flights are most. ``--list`` prints what makes each. Pictures in docs/validation are made by
``make validate``.
"""

import argparse
import io
import re
import runpy
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parent
ROOT, PICTURES = DOCS.parent, DOCS / "pictures"

# picture: command, experiment, figure within its folder
FIGURES = {
    "wake": ("run", "wake_backscatter", "figures/fig00_overview.png"),
    "depolarization": ("run", "wake_backscatter", "figures/fig14_depolarization.png"),
    "wind3d": ("run", "wake_sensor", "figures/fig20_wind3d.png"),
    "wake_3d": ("run", "wake_3d", "figures/fig31_wind_in_three_dimensions.png"),
    "turbine": ("run", "turbine", "figures/fig20_wind3d.png"),
    "near_range": ("run", "near_range", "figures/fig00_comparison.png"),
    "eye_safe": ("run", "eye_safe", "figures/fig00_comparison.png"),
    "moving_platform": ("run", "moving_platform", "poor_navigation/figures/fig24_scan_time.png"),
    "fringes": ("run", "fringes_paper", "figures/fig03_fringes.png"),
    "fringes_calibrated": ("run", "fringes", "figures/fig03_fringes.png"),
    "airport": ("run", "airport", "figures/fig30_slices.png"),
    "airport_errors": ("run", "airport", "figures/fig32_vortex_errors.png"),
    "encounter": ("fly", "encounter", "figures/fig29_encounter.png"),
    "real_wakes": ("fly", "real_wakes", "figures/fig29_encounter.png"),
    "gust": ("fly", "gust", "figures/fig37_load_factor.png"),
}
# picture: campaign, heading of the part of its report, options
PARTS = {
    "design_map": ("design_map", "Requirements", ()),
    "encounters": (
        "encounters",
        "Bank angle",
        ("--set", "sample.n=20", "--set", "set.encounter.control.latency=0.12 s"),
    ),
}
EXAMPLES = ("dense", "inflow", "recover_slab")
CHECKS = {"resolution": "resolution"}


def figure(name: str) -> None:
    """Run or resume an experiment or a flight, and copy a figure of it."""
    command, experiment, place = FIGURES[name]
    folder = ROOT / "outputs" / experiment
    _call("-m", "lidar_mi.cli.app", command, experiment, "-o", str(folder))
    _write(name, Image.open(folder / place))


def part(name: str) -> None:
    """Run or resume a campaign, and take panels of its report by a browser."""
    campaign, heading, options = PARTS[name]
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if not browser:
        raise SystemExit(f"{name}: panels of a report are drawn by Chromium, which is not here")
    folder = ROOT / "outputs" / campaign
    _call("-m", "lidar_mi.cli.app", "campaign", "run", campaign, "-o", str(folder), *options)
    text = (folder / "report.html").read_text()
    after = text[text.index(f">{heading}</h2>") :]
    panels = re.findall(r"<svg.*?</svg>", after.partition("<h2")[0], re.DOTALL)
    width, height = 520 * len(panels), 380
    with tempfile.TemporaryDirectory() as place:
        here = Path(place)
        style = "<style>body { margin: 0; display: flex; font-family: sans-serif }</style>"
        (here / "a.html").write_text(f"<meta charset=utf-8>{style}{''.join(panels)}")
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        flags += ["--force-device-scale-factor=1.6", f"--window-size={width},{height}"]
        target = f"--screenshot={here / 'a.png'}"
        subprocess.run([browser, *flags, target, (here / "a.html").as_uri()], check=True)
        _write(name, Image.open(here / "a.png"))


def example(name: str) -> None:
    """Run an example, which draws the picture."""
    with tempfile.TemporaryDirectory() as place:
        _call(f"examples/{name}.py", "--out", f"{place}/a.png")
        _write(name, Image.open(f"{place}/a.png"))


def check(name: str) -> None:
    """Run a check of the validation, which draws the picture."""
    _call("-m", "validation", CHECKS[name])


def tutorial(name: str) -> None:
    """Run a notebook, which draws its pictures, and write its page."""
    _call("docs/make_tutorials.py", name)


def makers() -> dict[str, tuple[str, ...]]:
    """Pictures, as places below `PICTURES`, by what makes them: its kind and its name."""
    found: dict[str, tuple[str, ...]] = {}
    kinds = (("figure", FIGURES), ("part", PARTS), ("example", EXAMPLES), ("check", CHECKS))
    for kind, names in kinds:
        found |= {f"{name}.png": (kind, name) for name in names}
    for notebook, texts in runpy.run_path(str(DOCS / "make_tutorials.py"))["SEEN"].items():
        for number in range(1, len(texts) + 1):
            found[f"tutorials/{notebook}_{number}.png"] = ("tutorial", notebook)
    return found


def _call(*arguments: str) -> None:
    print("python", *arguments, flush=True)
    subprocess.run([sys.executable, *arguments], check=True, cwd=ROOT)


def _write(name: str, image: Image.Image) -> None:
    """As a small PNG on white."""
    white = Image.new("RGB", image.size, "white")
    white.paste(image, mask=image.getchannel("A") if "A" in image.getbands() else None)
    buffer = io.BytesIO()
    white.save(buffer, "PNG", optimize=True)
    (PICTURES / f"{name}.png").write_bytes(buffer.getvalue())
    print(f"docs/pictures/{name}.png: {image.width} x {image.height}", flush=True)


def main() -> None:
    """Make all pictures, or those that are named."""
    every = dict.fromkeys(makers().values())
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="of a picture or a notebook")
    parser.add_argument("--list", action="store_true", help="show what makes each picture")
    options = parser.parse_args()
    if options.list:
        for picture, (kind, name) in makers().items():
            print(f"{picture:34}{kind:10}{name}")
        return
    known = [name for _, name in every]
    for name in options.names:
        if name not in known:
            parser.error(f"{name}: no picture or notebook; there are {', '.join(known)}")
    for kind, name in every:
        if not options.names or name in options.names:
            globals()[kind](name)


if __name__ == "__main__":
    main()
