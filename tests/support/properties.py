"""Properties that hold for any seed: a name, and a check of one seed that says what broke.

Short tests try a few seeds, ``make fuzz`` as many as there is time for, and prints those that fail.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from tests.support import cf_files, defect_families, image_defects, image_files


@cache
def _variant():
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono_polarized")
    mi.set_log_level(mi.LogLevel.Error)


def extinction_fields(seed: int) -> str | None:
    """A random field's signal agrees with the lidar equation by quadrature."""
    from validation.extinction_fields import check

    _variant()
    return check(seed)


def scattering_tables(seed: int) -> str | None:
    """A random table has a density wherever it has a value, up to both poles."""
    import drjit as dr
    import mitsuba as mi

    import lidar_mi as lm

    _variant()
    lm.register_plugins()
    random, number = np.random.default_rng(seed), 20_000
    angle = np.unique(np.concatenate([[0, 180], random.uniform(0, 180, random.integers(1, 200))]))
    a1 = 10 ** np.cumsum(random.normal(0, random.uniform(0.01, 0.5), angle.size)).clip(-6, 6)
    table = np.column_stack([angle, a1, *(0.5 * a1 * random.uniform(-1, 1) for _ in range(5))])
    phase = mi.load_dict({"type": "mueller", "table": mi.TensorXf(table.astype(np.float32))})
    axis = random.standard_normal(3)
    mei = dr.zeros(mi.MediumInteraction3f, number)
    mei.wi = mi.Vector3f(*(axis / np.linalg.norm(axis)).tolist())
    off = 10 ** random.uniform(-8, -3, number) * random.standard_normal((3, number))
    wo = dr.normalize(mi.Vector3f(off) + mei.wi * mi.Float(random.choice([-1.0, 1.0], number)))
    value, density = phase.eval_pdf(mi.PhaseFunctionContext(), mei, wo)
    ratio = np.array(value[0, 0][0] / density, float)
    if np.isfinite(ratio).all() and abs(ratio - 1).max() < 1e-4:
        return None
    return f"value over density between {ratio.min():g} and {ratio.max():g}"


PROPERTIES: dict[str, Callable[[int], str | None]] = {
    "extinction_fields": extinction_fields,
    "cf_files": cf_files.check,
    "defect_families": defect_families.check,
    "image_defects": image_defects.check,
    "image_files": image_files.check,
    "scattering_tables": scattering_tables,
}
