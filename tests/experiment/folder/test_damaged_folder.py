"""Folders of runs and studies that somebody else wrote into. Unit tier.

Detects a damaged log, a damaged file of metrics or a record's wrong value that ends in a traceback,
and names in a record that lead out of the folder.
"""

import pytest

from lidar_mi.errors import InputError
from lidar_mi.experiment.folder import records
from lidar_mi.experiment.folder import run_folder as resumable_folder
from lidar_mi.experiment.folder.records import read_metrics, read_study
from lidar_mi.experiment.log import Log, failure
from lidar_mi.schema import reading


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", None),
        (b"\n\n", None),
        (b"one", None),
        (b"2026-01-01 00:00:00 done\n", None),
        (b"2026-01-01 00:00:00 failed: a file\n", "a file"),
        (b"2026-01-01 00:00:00 failed: \x1b[31m\xff\n", r"\x1b[31m\xff"),
        (b"\0" * 200_000 + b"\n2026-01-01 00:00:00 failed: at the end\n", "at the end"),
    ],
)
def test_any_log_is_read(tmp_path, content, reason):
    (tmp_path / "log.txt").write_bytes(content)
    assert failure(tmp_path / "log.txt") == reason


def test_a_log_keeps_one_line_a_message(tmp_path):
    log = Log(path=tmp_path / "log.txt")
    log.fail(InputError("two\nlines \x1b[31m"))
    assert failure(tmp_path / "log.txt") == r"two lines \x1b[31m"
    assert (tmp_path / "log.txt").read_text().count("\n") == 1


@pytest.mark.parametrize(
    "text", ["[1]", "3", '{"a": "b"}', '{"a": {"b": 1}}', f'{{"a": {10**400}}}']
)
def test_damaged_metrics_are_named(tmp_path, text):
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(InputError, match=r"metrics.json: not written by a run"):
        read_metrics(tmp_path)


@pytest.mark.parametrize("name", ["..", "/etc", "a/b", ""])
def test_variants_of_a_record_stay_in_its_folder(tmp_path, name):
    (tmp_path / "study.yaml").write_text(f"name: a\nvariants: ['{name}']\n")
    with pytest.raises(InputError, match="not written by a study"):
        read_study(tmp_path)


def test_no_variant_is_called_like_a_file_beside_it(tmp_path):
    ours = {
        records.STUDY,
        records.RECORD,
        records.LOG,
        records.METRICS,
        records.REPORT,
        resumable_folder.FIGURES,
    }
    assert ours == set(reading.RESERVED_NAMES)
    for name in (*ours, "Report.HTML"):
        path = tmp_path / "a.yaml"
        path.write_text(f"name: a\nwake: {{vortex_pair: {{}}}}\nvariants: {{{name}: {{}}}}\n")
        with pytest.raises(InputError, match="a file of the study has this name"):
            reading.load_variants(path)


def test_variants_of_one_name_are_not_merged(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("name: a\nwake: {vortex_pair: {}}\nvariants: {1: {}, '1': {seed: 3}}\n")
    with pytest.raises(InputError, match=r"variants\.1: not allowed; another variant"):
        reading.load_variants(path)
