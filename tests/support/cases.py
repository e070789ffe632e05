"""Cases of hostile input: files and a call, the promise that holds for all, cases as files.

The promise: a command ends with exit code 0 or 2, in bounded time and memory; bad input gives one
printable line of at most 300 characters; nothing is left behind; nothing that a terminal would
obey is printed. A call from Python returns, or raises an InputError of one such line; for an
argument of another type than its signature says also a TypeError that names it.
"""

import ast
import base64
import json
import re
import tempfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tests.support.sandbox import Outcome, Sandbox, command

LONGEST_LINE = 300


@dataclass(frozen=True)
class Case:
    """A call in a folder with files of its own.

    Attributes
    ----------
    kind : str
        Of input, by the strategy that made it.
    call : tuple of str
        Arguments of the command; or "python" and an expression with lm, np, xr and `pattern`.
    files : mapping
        Content by name.
    leaves : tuple of str
        Files that the command makes if it succeeds.
    """

    kind: str
    call: tuple[str, ...]
    files: Mapping[str, bytes] = field(default_factory=dict)
    leaves: tuple[str, ...] = ()

    def to_text(self) -> str:
        """The case as JSON; what is not text is packed."""
        files = {name: _packed(content) for name, content in self.files.items()}
        data = {"kind": self.kind, "call": self.call, "leaves": self.leaves, "files": files}
        return json.dumps(data, indent=1) + "\n"

    @staticmethod
    def from_text(text: str) -> "Case":
        """What `to_text` wrote."""
        data = json.loads(text)
        files = {name: _unpacked(content) for name, content in data["files"].items()}
        return Case(data["kind"], tuple(data["call"]), files, tuple(data["leaves"]))


def fault(case: Case, sandbox: Sandbox) -> str | None:
    """What breaks the promise; None: nothing does."""
    with tempfile.TemporaryDirectory() as folder:
        for name, content in case.files.items():
            path = Path(folder, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        before = _listing(folder)
        if case.call[0] == "python":
            done = sandbox.call(evaluate, case.call[1], folder=folder)
            # how long a run takes is no fault
            ending = None if case.kind == "run" and done.timed_out else _ending(done)
            return ending or _answer(done)
        done = sandbox.call(command, *case.call, folder=folder)
        return _ending(done) or _lines(done) or _left(case, done, before, _listing(folder))


def evaluate(expression: str) -> str | None:
    """What is wrong with the answer to a call from Python; None: nothing."""
    import warnings

    import numpy as np
    import xarray as xr

    import lidar_mi as lm
    from tests.support.accepted import runs
    from tests.support.hostile_calls import pattern, vectors, volume

    warnings.simplefilter("ignore")
    names = {"lm": lm, "np": np, "xr": xr, "runs": runs}
    names |= {
        "pattern": pattern,
        "volume": volume,
        "vectors": vectors,
        "nan": np.nan,
        "inf": np.inf,
    }
    try:
        eval(expression, names)
    except lm.InputError as error:
        return None if str(error) else "an empty message"
    except TypeError as error:
        return None if _names_argument(error, expression) else _where(error)
    except Exception as error:
        place = _where(error)
        # an argument that cannot even be made is no call of ours
        return None if place.startswith("? ") else place
    return None


def _names_argument(error: TypeError, expression: str) -> bool:
    """Whether an error says which argument of a call it is about."""
    call = ast.parse(expression).body[0].value
    return any(re.search(rf"\b{one.arg}\b", str(error)) for one in call.keywords)


def _where(error: BaseException) -> str:
    """Where an exception came from: the last line of ours, and what it was."""
    place = "?"
    trace = error.__traceback__
    while trace:
        file = trace.tb_frame.f_code.co_filename
        if "lidar_mi" in file or "/plugins/" in file:
            place = f"{Path(file).name}:{trace.tb_lineno}"
        trace = trace.tb_next
    return f"{place} {type(error).__name__}: {error}"


def _answer(done: Outcome) -> str | None:
    return done.value if isinstance(done.value, str) else None


def _ending(done: Outcome) -> str | None:
    if done.timed_out:
        return "takes too long"
    if done.code < 0:
        return f"ended by signal {-done.code}"
    # 1: the result is written, and no vector of it is valid
    if done.code not in (0, 2) and not (done.code == 1 and "lidar-mi: no valid" in done.err):
        ours = [line.strip() for line in done.err.splitlines() if "/lidar_mi/" in line]
        last = (done.err.strip().splitlines() or [""])[-1]
        return f"exit code {done.code}: {ours[-1:]} {last[:200]}"
    return None


def _lines(done: Outcome) -> str | None:
    for text in (done.out, done.err):
        hidden = sorted({c for c in text if c != "\n" and not c.isprintable()})
        if hidden:
            return f"prints {hidden[:3]!r}"
    lines = done.err.splitlines()
    output = [line for line in lines if line.startswith("lidar-mi: ")]
    if done.code == 2 and (len(output) != 1 or lines[-1] != output[0]):
        return f"exit code 2 with {len(output)} messages, at the end {lines[-1:]}"
    longest = max(map(len, lines), default=0)
    if longest > LONGEST_LINE:
        return f"a line of {longest} characters"
    return None


def _left(case: Case, done: Outcome, before: set[str], after: set[str]) -> str | None:
    new = after - before - (set(case.leaves) if done.code in (0, 1) else set())
    if new or before - after:
        return f"exit code {done.code} leaves {sorted(new)}, removes {sorted(before - after)}"
    return None


def _listing(folder: str) -> set[str]:
    return {str(path.relative_to(folder)) for path in Path(folder).rglob("*")}


def _packed(content: bytes) -> dict[str, str]:
    try:
        text = content.decode("ascii")
        if len(text) < 4000 and all(c == "\n" or c.isprintable() for c in text):
            return {"text": text}
    except UnicodeDecodeError:
        pass
    return {"zlib": base64.b64encode(zlib.compress(content, 9)).decode()}


def _unpacked(stored: dict[str, str]) -> bytes:
    if "text" in stored:
        return stored["text"].encode("ascii")
    return zlib.decompress(base64.b64decode(stored["zlib"]))
