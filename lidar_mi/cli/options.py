"""Arguments and options common to several commands."""

from pathlib import Path
from typing import Annotated, overload

import typer

from lidar_mi.errors import InputError


def _complete(incomplete: str) -> list[str]:
    """Experiments of the package and experiment files here, to a shell's completion."""
    from lidar_mi.experiment.shipped import experiments

    beside = incomplete.rpartition("/")[0]
    here = Path(beside or ("/" if incomplete.startswith("/") else "."))
    found = sorted(here.glob("*.yaml")) + sorted(p for p in here.glob("*/") if p.is_dir())
    names = [f"{path}/" if path.is_dir() else str(path) for path in found]
    return [name for name in (*experiments(), *names) if name.startswith(incomplete)]


ExperimentName = Annotated[
    str,
    typer.Argument(help="Experiment file, or the name of a shipped one.", autocompletion=_complete),
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a key of the file, as often as needed: --set scan.range='400 m'.",
    ),
]
Variant = Annotated[
    str | None,
    typer.Option(
        "-m", "--variant", help="Mitsuba variant, such as llvm_ad_mono_polarized or cuda_ad_mono."
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
    bool, typer.Option("--overwrite", help="Replace a file even if it is no result of lidar-mi.")
]


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
