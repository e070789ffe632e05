"""Scene files that would take the process down.

Detects: tags nested so deeply that Mitsuba's parser ends its stack (a segmentation fault at
20 000), in a scene or in what it includes.
"""

from importlib.resources import files

import pytest

from lidar_mi.errors import InputError
from lidar_mi.io.xml import check_scene_file


def nested(levels):
    return "<scene>" + "<shape>" * levels + "</shape>" * levels + "</scene>"


@pytest.mark.parametrize("levels", [100, 20_000])
def test_deep_scenes_are_refused(tmp_path, levels):
    path = tmp_path / "deep.xml"
    path.write_text(nested(levels))
    with pytest.raises(InputError, match="line 1: <shape> inside 64 others is not allowed"):
        check_scene_file(path)


def test_included_files_are_looked_at(tmp_path):
    (tmp_path / "deep.xml").write_text(nested(20_000))
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene><include filename="deep.xml"/><include filename="scene.xml"/></scene>')
    with pytest.raises(InputError, match=r"deep\.xml: line 1: <shape> inside"):
        check_scene_file(scene)


def test_invalid_xml_is_named(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text("<scene><shape></scene>")
    with pytest.raises(
        InputError, match=r"scene\.xml: not XML .*mismatched tag.*; expected a Mits"
    ):
        check_scene_file(path)


def test_shipped_scenes_pass():
    for path in files("lidar_mi.scenes").glob("*.xml"):
        check_scene_file(path)
