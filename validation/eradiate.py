"""Steady states of Eradiate: computed in its own environment, or as stored."""

import json
import os
import subprocess
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
STORED = HERE / "eradiate_reference.json"
SAMPLES = 1_000_000  # of every case, times the effort


def reference(python: str | None, scale: int) -> dict:
    """Output of ``eradiate_reference.py``, computed by the given interpreter, else as stored."""
    if python is None:
        return json.loads(STORED.read_text())
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "eradiate.json"
        script = HERE / "eradiate_reference.py"
        # its own Mitsuba must not be hidden by one on our path
        environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
        command = [python, str(script), "-n", str(SAMPLES * scale), "-o", str(out)]
        subprocess.run(command, check=True, env=environment)
        return json.loads(out.read_text())


def provenance(python: str | None = None) -> str:
    """Source of Eradiate's numbers."""
    if python is not None:
        return (
            "The numbers of Eradiate were computed together with this page, by "
            "`validation/eradiate_reference.py`."
        )
    stored = json.loads(STORED.read_text())
    versions = ", ".join(f"{name} {number}" for name, number in stored["versions"].items())
    return (
        f"The stored numbers of Eradiate were computed by `{stored['command']}` with {versions}, "
        f"in the variant `{stored['variant']}`; `make validate ARGS='--eradiate PYTHON'` computes "
        "new ones with an interpreter that has eradiate-mitsuba."
    )
