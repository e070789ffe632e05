"""Meshes as Mitsuba 3.10 has them: tensors of positions and faces. Unit tier.

Detects, under Mitsuba 3.9, that a scene of meshes is seen differently through the newer functions.
They are those of Mitsuba's pull request 1933, put in place of the older ones.
"""

import numpy as np
import pytest

SMOKE = {"type": "homogeneous", "sigma_t": 5e-3, "albedo": 1.0, "phase": {"type": "isotropic"}}


def image(mi):
    """A gate that two curtains of smoke, each of two open surfaces, stand in."""
    transform = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 6, "height": 4, "rfilter": {"type": "box"}}
    scene = {
        "type": "scene",
        "integrator": {"type": "gated_volpath", "max_order": 1},
        "smoke": SMOKE,
        "lidar": {
            "type": "scanning_lidar",
            "aperture_radius": 0.2,
            "fov_half_mrad": 10,
            "gate_start": 99.0,
            "gate_stop": 101.0,
            "azimuth_min_deg": -2.0,
            "azimuth_max_deg": 2.0,
            "elevation_min_deg": -1.0,
            "elevation_max_deg": 1.0,
            "laser": {"type": "laser"},
            "film": film,
        },
    }
    for number, y in enumerate((-2.0, 2.0)):
        for side, x, inside in (("front", 99.5, "exterior"), ("back", 100.5, "interior")):
            place = transform().translate([x, y, 0]).rotate([0, 1, 0], 90).scale([5, 1, 1])
            scene[f"{side}{number}"] = {
                "type": "rectangle",
                "to_world": place,
                "bsdf": {"type": "null"},
                inside: {"type": "ref", "id": "smoke"},
            }
    return np.array(mi.render(mi.load_dict(scene), spp=64, seed=1))


@pytest.mark.usefixtures("variant")
def test_a_scene_looks_the_same(monkeypatch):
    import mitsuba as mi

    if hasattr(mi.Mesh, "positions"):
        pytest.skip("this Mitsuba has them")
    before, older, made = image(mi), mi.Mesh, []

    class Newer(older):
        """Not instantiated: its class is asked what it has."""

        def __new__(cls, name, *, faces, positions):
            mesh = older(name, positions.shape[0], faces.shape[0])
            parameters = mi.traverse(mesh)
            parameters["vertex_positions"], parameters["faces"] = positions.array, faces.array
            parameters.update()
            made.append(mesh)
            return mesh

        positions = None

    monkeypatch.setattr(mi, "Mesh", Newer)
    as_tensor = {
        "positions": lambda mesh: mi.TensorXf(
            mesh.vertex_positions_buffer(), (mesh.vertex_count(), 3)
        ),
        "faces": lambda mesh: mi.TensorXu(mesh.faces_buffer(), (mesh.face_count(), 3)),
    }
    for name, function in as_tensor.items():
        monkeypatch.setattr(older, name, function, raising=False)
    after = image(mi)
    assert before[..., 0].max() > 0 and np.array_equal(before, after)
    assert made
