"""The experiments that come with the package."""

import difflib
from importlib.resources import files
from pathlib import Path

from lidar_mi.errors import InputError


def experiments() -> list[str]:
    """Names of the experiments that come with the package, in alphabetical order.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> "wake_backscatter" in lm.experiments()
    True
    """
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def experiment_file(name: str | Path) -> Path:
    """The experiment file of a path or of a shipped experiment's name.

    A file of that name in the working folder comes first.

    Raises
    ------
    InputError
        Neither a file nor a shipped experiment.
    """
    path = Path(name)
    try:
        if path.is_file():
            return path
    except OSError as error:  # a name that is too long
        raise InputError(f"{name}: {error.strerror}; expected an experiment file") from None
    shipped = _folder() / (path.name if path.suffix == ".yaml" else f"{path.name}.yaml")
    if path.parent == Path() and shipped.is_file():
        return shipped
    names = experiments()
    close = difflib.get_close_matches(path.stem, names, 1)
    hint = f"did you mean {close[0]}? Expected" if close else "expected"
    raise InputError(
        f"{name}: no such file; {hint} an experiment file or one of {', '.join(names)}"
    )


def _folder() -> Path:
    return Path(str(files("lidar_mi.scenes")))
