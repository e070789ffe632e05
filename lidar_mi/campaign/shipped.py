"""The campaigns that come with the package."""

import difflib
from importlib.resources import files
from pathlib import Path

from lidar_mi.errors import InputError
from lidar_mi.experiment.shipped import experiment_file, experiments


def campaigns() -> list[str]:
    """Names of the campaigns that come with the package, in alphabetical order.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> "design_map" in lm.campaigns()
    True
    """
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def campaign_file(name: str | Path) -> Path:
    """The file of a path or of a shipped campaign's or experiment's name.

    A file of that name in the working folder comes first.

    Raises
    ------
    InputError
        There is none.
    """
    path = Path(name)
    shipped = _folder() / (path.name if path.suffix == ".yaml" else f"{path.name}.yaml")
    if path.parent == Path() and shipped.is_file() and not path.is_file():
        return shipped
    try:
        return experiment_file(name)
    except InputError:
        names = campaigns()
        close = difflib.get_close_matches(path.stem, [*names, *experiments()], 1)
        hint = f"did you mean {close[0]}? Expected" if close else "expected"
        raise InputError(
            f"{name}: no such file; {hint} a campaign file or one of {', '.join(names)}"
        ) from None


def _folder() -> Path:
    return Path(str(files("lidar_mi.scenes"))) / "campaigns"
