"""The command line: ``lidar-mi run | check | render | retrieve | info | aerosol | rings | doctor``."""

import difflib
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from lidar_mi.errors import InputError, causes, is_interrupt

app = typer.Typer(
    name="lidar-mi",
    help="Virtual lidars that look at wake vortices: from a simulated wake to retrieved winds.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

# names in files and folders may hold brackets and colons: they are no markup
_out = Console(markup=False, emoji=False)
_err = Console(stderr=True, markup=False, emoji=False)

_VARIANT_HELP = "Mitsuba variant, such as llvm_ad_mono_polarized or cuda_ad_mono."
Variant = Annotated[str | None, typer.Option("-m", "--variant", help=_VARIANT_HELP)]


@app.callback(invoke_without_command=True)
def _top(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        from lidar_mi import __version__

        print(f"lidar-mi {__version__}")
        raise typer.Exit


@app.command(
    epilog="Examples: `lidar-mi run wake_backscatter.yaml` (a shipped experiment) - "
    "`lidar-mi run my.yaml -o outputs/calm --set wake.texture.rms=0 --set seed=7`"
)
def run(
    experiment: Annotated[
        str, typer.Argument(help="Experiment file, or the name of a shipped one.")
    ],
    variant: Variant = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Run folder. Default: outputs/NAME.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a key of the file, as often as needed: --set scan.range='400 m'.",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a run of a different experiment.")
    ] = False,
) -> None:
    """Run an experiment, start to end.

    Writes images (EXR), winds (NetCDF), metrics (JSON), figures and a report into the run folder.
    A run that was stopped goes on with the images it has.
    """
    from lidar_mi.experiment import run as chain
    from lidar_mi.experiment import schema as config
    from lidar_mi.experiment import study

    path, changes = _experiment_file(experiment), list(set_ or [])
    variants = config.load_variants(path, changes)
    loaded = next(iter(variants.values())) if variants else config.load(path, changes)
    if variant:
        sections = {"render": loaded.wake, "doppler.render": loaded.doppler}
        changes += [f"{key}.variant={variant}" for key, asked in sections.items() if asked]
    if variants:
        _run_study(config.load_variants(path, changes), out, path, overwrite, study.run)
        return
    loaded = config.load(path, changes)
    folder = out or Path("outputs") / loaded.name
    with _progress() as notice:
        metrics = chain.run(loaded, folder, path.parent, overwrite, notice)
    _print_metrics(metrics)
    _out.print(f"report   {folder / 'report.html'}")
    _out.print(f"figures  {folder / 'figures'}")
    winds = "wind_volume.nc" if loaded.volume else "wind.nc"
    found = "sensor.rmse_u" in metrics
    for name, asked in (
        (winds, loaded.wake),
        ("v_los.nc", loaded.doppler),
        ("lines_of_sight.nc", loaded.sensor),
        ("wind3d.nc", found),
    ):
        if asked:
            _out.print(f"winds    {folder / name}")
    if "timing.vortex_s" in metrics:
        _out.print(f"vortices {folder / 'vortex.json'}")


@app.command(
    epilog="Examples: `lidar-mi check wake_sensor` - `lidar-mi check my_wake.yaml --set "
    "scan.range='200 m'`"
)
def check(
    experiment: Annotated[
        str, typer.Argument(help="Experiment file, or the name of a shipped one.")
    ],
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a key of the file, as for run."),
    ] = None,
) -> None:
    """Say whether an experiment can be run, and in numbers what it will look at and with what.

    Reads the wake, the scattering and the requirements as run does, and writes nothing.
    """
    from lidar_mi.experiment import schema as config
    from lidar_mi.experiment.check import sections

    path, changes = _experiment_file(experiment), list(set_ or [])
    asked = config.load_variants(path, changes) or {"": config.load(path, changes)}
    with _progress() as notice:
        found = [
            section for one in asked.values() for section in sections(one, path.parent, notice)
        ]
    for title, rows in found:
        _print_rows(title, rows)
    _out.print("nothing wrong found", highlight=False)


def _run_study(variants, out, path, overwrite, start) -> None:
    """Variants of one experiment, each in a folder of its own, and their comparison."""
    first, experiment = next(iter(variants.items()))
    name = experiment.name.removesuffix(f".{first}")
    folder = out or Path("outputs") / name
    with _progress() as notice:
        metrics = start(name, variants, folder, path.parent, overwrite, notice)
    for variant, found in metrics.items():
        _out.print(f"\n{variant}", style="bold")
        _print_metrics(found)
    _out.print(f"report   {folder / 'report.html'}")


@app.command(epilog="Example: `lidar-mi render slab.xml -s 256 -D range=485 -o slab.exr`")
def render(
    scene: Annotated[Path, typer.Argument(help="Mitsuba scene (XML).")],
    variant: Variant = None,
    samples: Annotated[
        int, typer.Option("-s", "--spp", min=0, help="Photons a beam; 0 = as the scene says.")
    ] = 0,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="EXR file. Default: beside the scene.")
    ] = None,
    define: Annotated[
        list[str] | None,
        typer.Option("-D", "--define", metavar="KEY=VALUE", help="Fill in $KEY in the scene."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")] = 0,
) -> None:
    """Render a Mitsuba scene with the project's plugins, like the `mitsuba` command."""
    from lidar_mi.rendering.scene import render_file

    path = out or scene.with_suffix(".exr")
    with _progress() as notice:
        render_file(
            scene,
            path,
            variant or "llvm_ad_mono_polarized",
            samples,
            seed,
            _definitions(define or []),
            lambda share: notice(f"rendering {scene.name}", share),
        )
    _out.print(f"image    {path}")


@app.command(epilog="Example: `lidar-mi retrieve image_t1.exr image_t2.exr --dt 0.1 -o wind.nc`")
def retrieve(
    first: Annotated[Path, typer.Argument(help="Image at t1: EXR, TIFF, PNG, BMP, JPEG or FITS.")],
    second: Annotated[Path, typer.Argument(help="Image at t2.")],
    *,
    more: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Further images of a burst, each dt after the one before (variational)."
        ),
    ] = None,
    dt: Annotated[float, typer.Option(help="Time between the images, s.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="NetCDF file.")] = Path("wind.nc"),
    method: Annotated[
        str,
        typer.Option(
            help="cc (cross-correlation), ws (weight shift), multipass, variational or vortex_fit."
        ),
    ] = "cc",
    template: Annotated[int, typer.Option(help="Template size, pixels.")] = 8,
    search: Annotated[int, typer.Option(help="Search region, pixels.")] = 16,
    stride: Annotated[int, typer.Option(help="Step between vectors, pixels.")] = 1,
    layer: Annotated[
        str | None, typer.Option(help="Layer of the EXR files. Default: Y, or the only one.")
    ] = None,
    spacing: Annotated[
        float | None, typer.Option(help="Pixel spacing in m, for files without axes.")
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Standard deviation of the images' noise. Default: what our EXR "
            "files say, else estimated.",
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="torch device, such as cpu or cuda.")] = "cpu",
) -> None:
    """Find the cross-flow wind (v, w) in any two images of the same air."""
    from lidar_mi.experiment.run_folder import write_netcdf
    from lidar_mi.io.images import read_image, read_noise
    from lidar_mi.retrieval.velocimetry.common_grid import on_one_grid
    from lidar_mi.retrieval.velocimetry.wind import retrieve_wind

    images = [read_image(path, layer, spacing) for path in (first, second, *(more or []))]
    pair = on_one_grid(*images[:2])
    if noise is None:
        noise = read_noise(first, layer, spacing)
        if noise is not None and pair[0] is not images[0]:
            # noise has no structure to interpolate: its level goes along
            noise = float(noise.median())
    wind = retrieve_wind(
        *pair,
        dt=dt,
        method=method,
        template=template,
        search=search,
        stride=stride,
        device=device,
        noise=noise,
        more=images[2:],
    )
    write_netcdf(wind, out)
    valid = float((wind["flag"] == 0).mean())
    if "fit" in wind.attrs:
        _print_vortices(wind)
    _out.print(f"{wind.sizes['y']} x {wind.sizes['z']} vectors, {valid:.1%} valid")
    _out.print(f"winds    {out}")


def _print_vortices(wind) -> None:
    """The numbers of a fitted vortex pair with their standard errors."""
    rows = []
    for name in (n for n in wind.data_vars if f"{n}_stderr" in wind and not wind[n].dims):
        value, stderr = float(wind[name]), float(wind[f"{name}_stderr"])
        rows.append((name, f"{value:.2f} +- {stderr:.2f} {wind[name].attrs['units']}"))
    _print_rows(
        f"vortex pair, {wind.attrs['profile'].replace('_', ' ')} ({wind.attrs['fit']})", rows
    )


@app.command(
    epilog="Examples: `lidar-mi info outputs/wake_backscatter` - `lidar-mi info image_t1.exr` - "
    "`lidar-mi info spheroids` - `lidar-mi info molecules --wavelength '355 nm' "
    "--altitude '8500 m'`"
)
def info(
    what: Annotated[
        str,
        typer.Argument(
            help="EXR, NetCDF or scattering-table file (.txt), folder of a run or of variants, or a name: molecules, "
            "spheroids, spheres, continental, sea_salt, dust, droplets, soot."
        ),
    ],
    wavelength: Annotated[
        str | None, typer.Option(help="Of a named scatterer. Default: 532 nm.")
    ] = None,
    altitude: Annotated[
        str | None, typer.Option(help="Of molecules, in the standard atmosphere. Default: 0 m.")
    ] = None,
) -> None:
    """Say what a file or a folder of results holds, or how an aerosol or air scatters.

    Of scatterers: extinction and backscatter coefficient and the number of particles they go with,
    single-scattering albedo, lidar ratio, depolarisation ratio.
    """
    import json

    from lidar_mi.experiment.info import sections
    from lidar_mi.experiment.run_folder import failure
    from lidar_mi.experiment.study import RECORD

    with _progress() as notice:
        found = list(
            sections(
                what,
                _quantity("--wavelength", wavelength, "m", "532 nm"),
                _quantity("--altitude", altitude, "m", "8500 m"),
                notice,
            )
        )
    for title, rows in found:
        _print_rows(title, rows)
    folder = Path(what)
    if folder.is_dir():
        if reason := failure(folder):
            _out.print(f"failed: {reason}", soft_wrap=True)
        elif (folder / RECORD).is_file():
            if not (folder / "metrics.json").is_file():
                _out.print("unfinished: no metrics.json yet; run it again to go on")
            _out.print(f"more of a variant: lidar-mi info {folder}/VARIANT", soft_wrap=True)
        elif (folder / "metrics.json").is_file():
            _print_metrics(json.loads((folder / "metrics.json").read_text()))
        else:
            _out.print("unfinished: no metrics.json yet; run it again to go on")


@app.command(
    epilog="Examples: `lidar-mi aerosol dust --wavelength '1064 nm'` - "
    "`lidar-mi aerosol spheres --name smoke --index 1.6+0.02i --radius '0.1 um' --sigma 1.6 "
    "-o smoke.txt`. In an experiment: `scattering: {phase: table, table: smoke.txt}`"
)
def aerosol(
    start: Annotated[
        str,
        typer.Argument(
            metavar="AEROSOL",
            help="The aerosol to start from: spheroids, spheres, continental, "
            "sea_salt, dust, droplets, soot.",
        ),
    ],
    wavelength: Annotated[str, typer.Option(help="Vacuum wavelength.")] = "532 nm",
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Table to write. Default: aerosol_NAME_NNNnm.txt."),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(help="Name of the new aerosol; needed when something below is changed."),
    ] = None,
    index: Annotated[
        str | None,
        typer.Option(help="Refractive index, such as 1.53+0.008i; the imaginary part absorbs."),
    ] = None,
    elongation: Annotated[
        float | None,
        typer.Option(
            help="Length over width of prolate spheroids in random orientation; 1 = spheres."
        ),
    ] = None,
    radius: Annotated[
        str | None,
        typer.Option(
            help="Median radius of a log-normal, mode of a modified gamma distribution; of the "
            "sphere of equal volume, such as '0.2 um'."
        ),
    ] = None,
    sigma: Annotated[
        float | None,
        typer.Option(help="Geometric standard deviation of a log-normal distribution, above 1."),
    ] = None,
    smallest: Annotated[str | None, typer.Option(help="Smallest radius.")] = None,
    largest: Annotated[
        str | None,
        typer.Option(
            help="Largest radius. Time and memory grow steeply with it for spheroids; beyond a size "
            "parameter (circumference over wavelength) of about 24 they are refused."
        ),
    ] = None,
    number_density: Annotated[
        str | None, typer.Option(help="Particles that go with the table, such as '2e8 / m^3'.")
    ] = None,
    nodes: Annotated[
        int | None,
        typer.Option(
            min=2, help="Sizes to average over. Default: 128 (spheroids), 10000 (spheres)."
        ),
    ] = None,
) -> None:
    """Make the scattering table of an aerosol: a named one, or one changed to taste.

    The table holds the six elements of the scattering matrix over angle (T-matrix method for
    spheroids, Lorenz-Mie theory for spheres), averaged over sizes and orientations, and the
    extinction cross-section and albedo. A table of spheroids takes half a minute, of spheres a
    few seconds. Needs the library scatrs: `pip install 'lidar-mi[particles]'`.
    """
    from lidar_mi.atmosphere.particles import changed, make_table
    from lidar_mi.atmosphere.scattering import describe, write_table
    from lidar_mi.experiment.run_folder import write

    metres = _quantity("--wavelength", wavelength, "m", "532 nm")
    particles = changed(
        start,
        metres,
        name,
        index=_index(index),
        elongation=elongation,
        sigma=sigma,
        radius=_quantity("--radius", radius, "m", "0.2 um"),
        smallest=_quantity("--smallest", smallest, "m", "0.03 um"),
        largest=_quantity("--largest", largest, "m", "1.5 um"),
        number_density=_quantity("--number-density", number_density, "1/m^3", "2e8 / m^3"),
    )
    path = out or Path(f"aerosol_{particles.name}_{metres * 1e9:.0f}nm.txt")
    if not path.parent.is_dir():
        raise InputError(f"{path}: {path.parent} is no folder; expected one that exists")
    with _progress() as notice:
        table = make_table(particles, metres, nodes, notice)
    write(path, lambda part: write_table(table, part))
    _print_rows(particles.name, list(describe(table).items()))
    _out.print(f"table    {path}")


@app.command(
    epilog="Examples: `lidar-mi rings fringes.png` - `lidar-mi rings frame.exr --layer Y "
    "--centre 479.5 389.5 -o frame_rings.png`"
)
def rings(
    image: Annotated[Path, typer.Argument(help="EXR, PNG, TIFF, BMP, JPEG or FITS image.")],
    centre: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="Where the rings' centre is known: x to the right, y down, pixels from "
            "the middle of the top left one. Default: found."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Picture (PNG). Default: IMAGE_rings.png.")
    ] = None,
    layer: Annotated[
        str | None, typer.Option(help="Layer of an EXR file. Default: Y, or the only one.")
    ] = None,
    saturation: Annotated[
        float | None, typer.Option(help="Value from which on a pixel is full.")
    ] = None,
) -> None:
    """Measure the rings of an etalon in any image: centre, radii, orders, quality of the fit."""
    from lidar_mi.assessment.figures.rings import draw_rings
    from lidar_mi.experiment.run_folder import write
    from lidar_mi.io.images import read_picture
    from lidar_mi.retrieval.rings.analysis import analyse, describe

    path = out or Path(f"{image.stem}_rings.png")
    if not path.parent.is_dir():
        raise InputError(f"{path}: {path.parent} is no folder; expected one that exists")
    values = read_picture(image, layer)
    try:
        found = analyse(values, centre, saturation)
    except InputError as error:
        raise InputError(f"{image}: {error}") from None
    figure = draw_rings(values, found, image.name)
    write(path, lambda part: figure.savefig(part, dpi=110, format="png"))
    for title, rows in describe(found):
        _print_rows(title, rows)
    _out.print(f"picture  {path}")


@app.command(epilog="Example: `lidar-mi doctor` (exit code 0: everything that is needed is there)")
def doctor() -> None:
    """Explain what this machine can run, and what to install for the rest."""
    from lidar_mi.system.doctor import print_report

    raise typer.Exit(print_report())


def main() -> None:
    """Entry point: bad input is one line and exit code 2."""
    try:
        app()
    except InputError as error:
        _fail(str(error))
    except BaseException as error:
        if is_interrupt(error):
            _fail("stopped; a run goes on when started again", code=130)
        message = _plugin_message(error)
        if message is None:
            raise
        _fail(message)


def _fail(message: str, code: int = 2) -> None:
    _err.print(f"lidar-mi: {message}", style="red", highlight=False, soft_wrap=True)
    sys.exit(code)


def _plugin_message(error: BaseException) -> str | None:
    """The one line a plugin said about a wrong parameter, from under the layers above it."""
    for cause in causes(error):
        for line in str(cause).splitlines():
            if " is not allowed; expected " in line:
                return line.split("ValueError: ")[-1].strip()
    return None


def _experiment_file(name: str) -> Path:
    from importlib.resources import files

    path = Path(name)
    if path.is_file():
        return path
    shipped = Path(str(files("lidar_mi.scenes")))
    candidate = shipped / (name if name.endswith(".yaml") else f"{name}.yaml")
    if path.parent == Path() and candidate.is_file():
        return candidate
    names = sorted(p.stem for p in shipped.glob("*.yaml"))
    close = difflib.get_close_matches(path.stem, names, 1)
    hint = f"did you mean {close[0]}? Expected" if close else "expected"
    raise InputError(
        f"{name}: no such file; {hint} an experiment file or one of {', '.join(names)}"
    )


def _quantity(option: str, text: str | None, unit: str, example: str) -> float | None:
    """An option's value in SI; None where it is not given."""
    from lidar_mi.units import to_si

    if text is None:
        return None
    try:
        return to_si(text, unit, example)
    except ValueError as error:
        raise InputError(f"{option}: {error}") from None


def _index(text: str | None) -> complex | None:
    """A refractive index, its imaginary unit written as i or j."""
    try:
        return None if text is None else complex(text.replace(" ", "").replace("i", "j"))
    except ValueError:
        raise InputError(
            f"--index: {text!r} is not allowed; expected a number such as 1.53+0.008i"
        ) from None


def _definitions(texts: list[str]) -> dict[str, str]:
    pairs = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise InputError(f"-D {text}: expected KEY=VALUE")
        pairs[key] = value
    return pairs


class _progress:
    """A progress bar that says what is running; plain lines where there is no terminal."""

    def __enter__(self):
        self.bars = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            console=_err,
            transient=True,
            disable=not _err.is_terminal,
        )
        self.bars.start()
        self.task = self.bars.add_task("starting", total=None)
        self.last = None
        return self._notice

    def _notice(self, text: str, share: float | None) -> None:
        # a full bar would stop clock and spinner, and what comes next goes on
        self.bars.update(
            self.task,
            description=text,
            total=None if share is None else 1.0,
            completed=min(share or 0.0, 0.999),
        )
        if text != self.last and (text.startswith("warning: ") or not _err.is_terminal):
            _err.print(text, highlight=False, soft_wrap=True)
        self.last = text

    def __exit__(self, *_):
        self.bars.stop()


def _print_metrics(metrics: dict[str, float]) -> None:
    """The few numbers people ask for first."""
    if any(key.startswith("doppler.bound.") for key in metrics):
        _print_doppler(metrics)
    if any(key.startswith("backscatter.") for key in metrics):
        _print_winds(metrics)
    if "sensor.vectors" in metrics:
        _print_sensor(metrics)


def _print_doppler(metrics: dict[str, float]) -> None:
    """Standard deviation and bias of every method, for every number of pictures averaged."""
    cases = [
        key.split(".")[1:4] for key in metrics if key.startswith("doppler.") and "averaged" in key
    ]
    rows = dict.fromkeys((method, centre) for method, centre, _ in cases)
    numbers = sorted({int(averaged.removeprefix("averaged_")) for *_, averaged in cases})
    table = Table(
        title="line-of-sight wind from averages of so many pictures, m/s", title_justify="left"
    )
    for head in ("method", "centre"):
        table.add_column(head)
    for number in numbers:
        for head in (f"{number}: std", "bias"):
            table.add_column(head, justify="right")
    for method, centre in rows:
        keys = [
            f"doppler.{method}.{centre}.averaged_{number}.{name}"
            for number in numbers
            for name in ("std", "bias")
        ]
        shown = ["-" if key not in metrics else f"{metrics[key]:.3f}" for key in keys]
        style = "dim" if method == "bound" else None
        name = "(bound)" if method == "bound" else method
        table.add_row(name, centre.removeprefix("centre_"), *shown, style=style)
    _out.print(table)


def _print_winds(metrics: dict[str, float]) -> None:
    """Rms errors of the winds from every source, by every method."""
    table = Table(
        title="rms error of the wind in m/s, valid vectors (far: beyond two core radii)",
        title_justify="left",
    )
    components = (
        "uvw"
        if any(k.startswith("backscatter") and k.endswith(".rmse_u") for k in metrics)
        else "vw"
    )
    far = (f"far {name}" for name in components)
    for head in ("winds from", "method", *components, *far, "valid"):
        named = head in ("winds from", "method")
        table.add_column(head, justify="left" if named else "right", no_wrap=named)
    names = [
        tuple(key.split(".")[:2])
        for key in metrics
        if key.endswith(".valid_fraction") and not key.startswith("texture_sweep.")
    ]
    for source, method in names:
        values = [
            metrics.get(f"{source}.{method}.{place}rmse_{name}")
            for place in ("", "outside_cores.")
            for name in components
        ]
        shown = ["-" if value is None else f"{value:.2f}" for value in values]
        valid = f"{metrics[f'{source}.{method}.valid_fraction']:.0%}"
        table.add_row(source.replace("_", " ").replace("extinction ", ""), method, *shown, valid)
    strength = [
        metrics.get(f"true_wind.{place}rms_{name}")
        for place in ("", "outside_cores.")
        for name in components
    ]
    shown = ["-" if value is None else f"{value:.2f}" for value in strength]
    table.add_row("true wind", "", *shown, "", style="dim")
    _out.print(table)
    _out.print(
        "An error near the rms of the true wind (last row) means no skill: zero would be as good."
    )


def _print_sensor(metrics: dict[str, float]) -> None:
    """Rms errors of the wind from both lidars, beyond two core radii where there are any."""
    far = any(key.startswith("sensor.outside_cores.") for key in metrics)
    place = "outside_cores." if far else ""
    table = Table(
        title=f"rms error of the wind from both lidars{', beyond cores' if far else ''}, m/s",
        title_justify="left",
    )
    for head in ("", "u", "v", "w"):
        table.add_column(head, justify="right" if head else "left")
    for label, key, style in (
        ("both lidars", f"sensor.{place}rmse_", None),
        ("lines of sight alone, all over", "sensor.triples.rmse_", None),
        ("true wind (rms)", f"sensor.{place}rms_", "dim"),
    ):
        values = [metrics.get(f"{key}{name}") for name in "uvw"]
        if any(value is not None for value in values):
            shown = ["-" if value is None else f"{value:.2f}" for value in values]
            table.add_row(label, *shown, style=style)
    if table.rows:
        _out.print(table)


def _print_rows(title: str, rows) -> None:
    table = Table(title=title, title_justify="left", show_header=False)
    for row in rows:
        table.add_row(*row)
    _out.print(table)


if __name__ == "__main__":
    main()
