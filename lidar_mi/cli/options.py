"""Arguments and options common to several commands."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, overload

import typer

from lidar_mi.errors import InputError


def starting(incomplete: str, names: Iterable[str], *patterns: str) -> list[str]:
    """Completions for a shell: names, then files of some patterns and folders here."""
    folder = incomplete.rpartition("/")[0]
    inside = Path(folder or ("/" if incomplete.startswith("/") else "."))
    paths = sorted(path for pattern in patterns for path in inside.glob(pattern) if path.is_file())
    paths += sorted(p for p in inside.glob("*/") if p.is_dir()) if patterns else []
    files = [f"{path}/" if path.is_dir() else str(path) for path in paths]
    return [name for name in (*names, *files) if name.startswith(incomplete)]


def complete_run(incomplete: str) -> list[str]:
    """Experiments of the package that are no flights, and experiment files here."""
    from lidar_mi.schema.shipped import experiments, flights

    return starting(incomplete, sorted(set(experiments()) - set(flights())), "*.yaml")


def complete_flight(incomplete: str) -> list[str]:
    """Flights of the package, and experiment files here."""
    from lidar_mi.schema.shipped import flights

    return starting(incomplete, flights(), "*.yaml")


def _complete_experiment(incomplete: str) -> list[str]:
    from lidar_mi.schema.shipped import experiments

    return starting(incomplete, experiments(), "*.yaml")


def complete_campaign(incomplete: str) -> list[str]:
    """Campaigns of the package, and files here."""
    from lidar_mi.schema.shipped import campaigns

    return starting(incomplete, campaigns(), "*.yaml")


def complete_scene(incomplete: str) -> list[str]:
    """Mitsuba scenes of the package, and scenes here."""
    from lidar_mi.schema.shipped import scenes

    return starting(incomplete, scenes(), "*.xml")


def complete_contents(incomplete: str) -> list[str]:
    """Files and folders that can be shown, and the names of scatterers."""
    from lidar_mi.atmosphere.scattering.aerosols import AEROSOLS

    return starting(incomplete, ("molecules", *AEROSOLS), "*.exr", "*.nc", "*.hpl", "*.txt")


def complete_method(incomplete: str) -> list[str]:
    """Methods of wind from images."""
    from lidar_mi.retrieval.method_names import ImageMethod

    return starting(incomplete, (method.value for method in ImageMethod))


def complete_shipped(incomplete: str) -> list[str]:
    """Experiments of the package."""
    from lidar_mi.schema.shipped import experiments

    return starting(incomplete, experiments())


def complete_instrument(incomplete: str) -> list[str]:
    """Published instruments."""
    from lidar_mi.schema.shipped import instruments

    return starting(incomplete, instruments())


def complete_key(incomplete: str) -> list[str]:
    """Keys and sections of an experiment file."""
    from lidar_mi.schema.keys import OF_A_FILE, names

    return starting(incomplete, [*names(), *OF_A_FILE])


def complete_change(incomplete: str) -> list[str]:
    """``KEY=`` of every key of an experiment file; after it, the words that the key may be."""
    from lidar_mi.schema.keys import explain, settable

    keys = settable()
    key, equals, _ = incomplete.partition("=")
    if not equals:
        return starting(incomplete, [f"{name}=" for name in keys])
    words = explain(key).words if key in keys else ()
    return starting(incomplete, [f"{key}={word}" for word in words])


def examples(*commands: str) -> str:
    """The end of a command's help: command lines, each as an item of a list (Markdown)."""
    title = "Examples:" if commands[1:] else "Example:"
    return "\n\n".join([title, *(f"- `{command}`" for command in commands)])


_HELP = "Experiment file, or the name of a shipped one."
ExperimentName = Annotated[str, typer.Argument(help=_HELP, autocompletion=_complete_experiment)]
RunName = Annotated[str, typer.Argument(help=_HELP, autocompletion=complete_run)]
OptionalFlightName = Annotated[
    str | None,
    typer.Argument(
        help=f"{_HELP} With --replay by default that of the flight.", autocompletion=complete_flight
    ),
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a key of the file, as often as needed: --set scan.range='400 m'. See "
        "`lidar-mi explain`.",
        autocompletion=complete_change,
    ),
]
Variant = Annotated[
    str | None,
    typer.Option(
        "-m", "--variant", help="Mitsuba variant, such as llvm_ad_mono_polarized or cuda_ad_mono."
    ),
]

DEVICES = ("auto", "cpu", "cuda")


def _checked_device(device: str | None) -> str | None:
    if device not in (None, *DEVICES):
        raise InputError(f"--device: {device} is not allowed; expected {', '.join(DEVICES)}")
    return device


Device = Annotated[
    str | None,
    typer.Option(
        "--device",
        metavar="DEVICE",
        callback=_checked_device,
        autocompletion=lambda incomplete: starting(incomplete, DEVICES),
        help="Device that renders and retrieves: cpu, cuda, or auto for cuda if there is one. "
        "Default: as the experiment says.",
        show_default=False,
    ),
]


NominalInstrument = Annotated[
    str,
    typer.Option(
        "--instrument",
        help="The nominal instrument: an experiment file with the section doppler, or the name of "
        "a shipped one.",
    ),
]
Electrons = Annotated[
    bool,
    typer.Option(
        "--electrons",
        help="The files hold photoelectrons. Default: counts, of doppler.ccd's bias and gain.",
    ),
]
Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Replace a file that does not say that lidar-mi wrote it, as tables do not.",
    ),
]

MinCnr = Annotated[
    float | None,
    typer.Option(help="Least carrier-to-noise ratio, dB. Default: -21, of WindCube -27."),
]
LineNames = Annotated[
    list[str] | None,
    typer.Option(
        metavar="OURS=THEIRS",
        help="Name of a variable in the file, as often as needed; a minus sign before "
        "that of radial_velocity: it is positive toward the lidar.",
    ),
]


def names_of(pairs: Sequence[str]) -> dict[str, str]:
    """The names of ``--name OURS=THEIRS``."""
    names = {}
    for pair in pairs:
        ours, sign, theirs = pair.partition("=")
        if not (ours and sign and theirs):
            raise InputError(f"--name: {pair!r} is not allowed; expected OURS=THEIRS")
        names[ours] = theirs
    return names


@overload
def quantity(option: str, text: str, unit: str, example: str) -> float: ...
@overload
def quantity(option: str, text: str | None, unit: str, example: str) -> float | None: ...
def quantity(option: str, text: str | None, unit: str, example: str) -> float | None:
    """An option's value in SI; None if it is not given."""
    from lidar_mi.units import to_si

    if text is None:
        return None
    try:
        return to_si(text, unit, example)
    except ValueError as error:
        raise InputError(f"{option}: {error}") from None
