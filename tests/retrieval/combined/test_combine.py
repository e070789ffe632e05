"""The combined wind of both lidars.

Detects an estimate or a covariance that differs from generalised least squares written out over all
nodes (1e-7), errors that are not what the covariance says
(normalised errors and coverage over many draws, 4 sigma), errors of the platform that have another
effect than the geometry says, a field without uncertainty where nothing was measured, and input
that has no answer.
"""

import math

import numpy as np
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.flags import CombinedFlag, Flag
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.doppler_scan import DopplerScan, PlatformErrors, scan_wind
from lidar_mi.retrieval.combined.combine import combine
from lidar_mi.retrieval.common_error import with_common_error

Y, Z = np.arange(-3, 3.1, 1.0), np.arange(-2, 2.1, 1.0)
METRES = {"units": "m"}


def crossflow(v, w, stderr, correlation=0.0, y=Y, z=Z, flag=None, **attrs):
    shape = (len(z), len(y))
    fields = {
        "v": v,
        "w": w,
        "v_stderr": stderr,
        "w_stderr": np.asarray(stderr) * 1.5,
        "vw_correlation": correlation,
    }
    return xr.Dataset(
        {n: (("z", "y"), np.broadcast_to(f, shape).astype(float).copy()) for n, f in fields.items()}
        | {"flag": (("z", "y"), np.zeros(shape, np.uint8) if flag is None else flag)},
        coords={"y": ("y", y, METRES), "z": ("z", z, METRES)},
        attrs={"template": 2, "stride": 1} | attrs,
    )


def lines(places, v_los, std, distance=10.0, range_bin=0.0):
    """Lines through places (y, z) of the plane x = distance, instrument at rest."""
    ends = np.column_stack([np.full(len(places), distance), places])
    reach = np.linalg.norm(ends, axis=1)
    return xr.Dataset(
        {
            "v_los": ("line", v_los),
            "v_los_std": ("line", np.broadcast_to(std, len(places)) * 1.0),
            "range": ("line", reach),
            "range_bin": ((), range_bin),
            "platform_velocity": ("axis", np.zeros(3)),
        },
        coords={"direction": (("line", "axis"), ends / reach[:, None])},
    )


def written_out(flow, scan, u_std, length, window, exponent, mean_std=100.0, common=(0.0, 0.0)):
    """Information of everything that is known, as one big matrix over (u, v, w) of all nodes."""
    zz, yy = (a.ravel() for a in np.meshgrid(flow.z, flow.y, indexing="ij"))
    n = len(zz)
    far = abs(zz[:, None] - zz) ** exponent + abs(yy[:, None] - yy) ** exponent
    prior = np.zeros((3 * n, 3 * n))
    prior[:n, :n] = mean_std**2 + u_std**2 * np.exp(-far / length**exponent)
    overlap = np.eye(n)
    if window:
        overlap = np.clip(1 - abs(zz[:, None] - zz) / window, 0, None) * np.clip(
            1 - abs(yy[:, None] - yy) / window, 0, None
        )
    sv, sw, c = (flow[k].values.ravel() for k in ("v_stderr", "w_stderr", "vw_correlation"))
    # Cholesky factor of each node's errors
    vv, wv, ww = sv, c * sw, np.sqrt(1 - c**2) * sw
    prior[n : 2 * n, n : 2 * n] = np.outer(vv, vv) * overlap
    prior[2 * n :, n : 2 * n] = np.outer(wv, vv) * overlap
    prior[n : 2 * n, 2 * n :] = prior[2 * n :, n : 2 * n].T
    prior[2 * n :, 2 * n :] = (np.outer(wv, wv) + np.outer(ww, ww)) * overlap
    prior[n : 2 * n, n : 2 * n] += common[0] ** 2
    prior[2 * n :, 2 * n :] += common[1] ** 2
    background = np.concatenate([np.zeros(n), flow.v.values.ravel(), flow.w.values.ravel()])
    rows = []
    for k in range(scan.sizes["line"]):
        d = scan.direction.values[k]
        nodes, weights = np.polynomial.legendre.leggauss(5)
        hat = np.zeros(n)
        for node, weight in zip(nodes, weights / 2, strict=True):
            y, z = (float(scan.range[k]) + float(scan.range_bin) / 2 * node) * d[1:]
            hat += weight * (np.clip(1 - abs(y - yy), 0, None) * np.clip(1 - abs(z - zz), 0, None))
        rows.append(np.concatenate([d[0] * hat, d[1] * hat, d[2] * hat]))
    matrix, std = np.array(rows), scan.v_los_std.values
    inverse = np.linalg.inv(prior)
    information = inverse + matrix.T @ (matrix / std[:, None] ** 2)
    covariance = np.linalg.inv(information)
    wind = covariance @ (inverse @ background + matrix.T @ (-scan.v_los.values / std**2))
    return wind.reshape(3, *flow.v.shape), covariance, n


def covariance_at(found, z, y):
    at = found.isel(z=z, y=y)
    std = np.array([float(at[f"{c}_stderr"]) for c in "uvw"])
    matrix = np.eye(3)
    for (i, j), name in (((0, 1), "uv"), ((0, 2), "uw"), ((1, 2), "vw")):
        matrix[i, j] = matrix[j, i] = float(at[f"{name}_correlation"])
    return matrix * np.outer(std, std)


@pytest.mark.parametrize("exponent", [1.0, 2.0])
@pytest.mark.parametrize("window", [0.0, 2.5])
@pytest.mark.parametrize("range_bin", [0.0, 1.5])
def test_generalised_least_squares_written_out(window, range_bin, exponent):
    """35 nodes, 8 oblique lines between them, errors that differ and correlate."""
    random = np.random.default_rng(3)
    shape = (len(Z), len(Y))
    flow = crossflow(
        random.normal(0, 3, shape),
        random.normal(0, 3, shape),
        random.uniform(0.3, 2, shape),
        random.uniform(-0.8, 0.8, shape),
    )
    places = random.uniform([-2.6, -1.6], [2.6, 1.6], (8, 2))
    scan = lines(places, random.normal(0, 3, 8), random.uniform(0.1, 2, 8), range_bin=range_bin)
    found = combine(
        flow, scan, window=window, u_std=1.3, u_length=2.0, u_power=0.0, u_exponent=exponent
    )
    wind, covariance, n = written_out(flow, scan, 1.3, 2.0, window, exponent)
    for index, name in enumerate("uvw"):
        np.testing.assert_allclose(found[name], wind[index], atol=1e-6)
    for z, y in ((0, 0), (2, 3), (4, 6), (1, 5)):
        node = z * len(Y) + y
        pick = [node, n + node, 2 * n + node]
        expected = covariance[np.ix_(pick, pick)]
        np.testing.assert_allclose(covariance_at(found, z, y), expected, atol=1e-6)


COMMON = (1.5, 0.8)


def sharing(flow, offset):
    """Vectors whose errors include those that all share, as stated and as matrices need them."""
    stated = with_common_error(flow, 0.0, offset)
    for name, common in zip("vw", COMMON, strict=True):
        own = flow[f"{name}_stderr"]
        stated[f"{name}_stderr"] = np.hypot(own, common)
        stated[f"{name}_common_stderr"] = common
    both = [f["v_stderr"] * f["w_stderr"] for f in (flow, stated)]
    stated["vw_correlation"] = flow["vw_correlation"] * both[0] / both[1]
    return stated


@pytest.mark.parametrize("offset", ["free", "known"])
def test_error_that_all_vectors_share(offset):
    """Free: least squares with that error in the prior. Known: the estimate without it, whose
    covariance grows by what a shift of all vectors does to it."""
    random = np.random.default_rng(4)
    shape = (len(Z), len(Y))
    flow = crossflow(
        random.normal(0, 3, shape),
        random.normal(0, 3, shape),
        random.uniform(0.3, 2, shape),
        random.uniform(-0.8, 0.8, shape),
    )
    places = random.uniform([-2.6, -1.6], [2.6, 1.6], (8, 2))
    scan = lines(places, random.normal(0, 3, 8), random.uniform(0.1, 2, 8), range_bin=1.5)
    settings = {"window": 2.5, "u_std": 1.3, "u_length": 2.0, "u_power": 0.0, "u_exponent": 1.0}
    found = combine(sharing(flow, offset), scan, **settings)
    given = (1.3, 2.0, 2.5, 1.0)
    wind, covariance, n = written_out(
        flow, scan, *given, common=COMMON if offset == "free" else (0, 0)
    )
    if offset == "known":
        for name, common in zip("vw", COMMON, strict=True):
            moved, _, _ = written_out(flow.assign({name: flow[name] + common}), scan, *given)
            change = (moved - wind).ravel()
            covariance = covariance + np.outer(change, change)
    for index, name in enumerate("uvw"):
        np.testing.assert_allclose(found[name], wind[index], atol=1e-6)
    for z, y in ((0, 0), (2, 3), (4, 6), (1, 5)):
        node = z * len(Y) + y
        pick = [node, n + node, 2 * n + node]
        np.testing.assert_allclose(
            covariance_at(found, z, y), covariance[np.ix_(pick, pick)], atol=2e-6
        )
    left = [float(found[f"{name}_common_stderr"]) for name in "vw"]
    if offset == "known":
        assert left == list(COMMON) and "v_offset" not in found
    else:
        assert left[0] < 0.97 * COMMON[0] and left[1] < 0.999 * COMMON[1]


def test_lines_straight_ahead_do_not_determine_what_all_vectors_share():
    """They see u alone: nothing is subtracted, and all of the error is left."""
    random = np.random.default_rng(6)
    flow = crossflow(random.normal(0, 3, (5, 7)), random.normal(0, 3, (5, 7)), 0.3)
    scan = lines(np.zeros((3, 2)), random.normal(0, 3, 3), 0.1)
    found = combine(with_common_error(flow, 2.0, "free"), scan, window=0.0)
    assert float(found["v_offset"]) == 0 and float(found["w_offset"]) == 0
    assert float(found["v_common_stderr"]) == pytest.approx(2.0)
    np.testing.assert_allclose(found["v"], flow["v"], atol=1e-9)
    np.testing.assert_allclose(found["v_stderr"], np.hypot(0.3, 2.0), rtol=1e-6)


def test_images_that_see_motion_along_x():
    """Images of v - (u - c) y / D and w - (u - c) z / D, and lines: least squares over nodes."""
    random = np.random.default_rng(5)
    shape, distance, gates = (len(Z), len(Y)), 10.0, 1.7
    flow = crossflow(random.normal(0, 3, shape), random.normal(0, 3, shape), 0.6, 0.3)
    scan = lines(random.uniform([-2.6, -1.6], [2.6, 1.6], (8, 2)), random.normal(0, 3, 8), 0.4)
    found = combine(
        flow,
        scan,
        window=0.0,
        u_std=1.3,
        u_length=2.0,
        u_power=0.0,
        u_exponent=1.0,
        distance=distance,
        gate_speed=gates,
    )
    zz, yy = (a.ravel() for a in np.meshgrid(Z, Y, indexing="ij"))
    n, one = len(zz), np.eye(len(zz))
    far = abs(zz[:, None] - zz) + abs(yy[:, None] - yy)
    information = np.zeros((3 * n, 3 * n))
    information[:n, :n] = np.linalg.inv(100.0**2 + 1.3**2 * np.exp(-far / 2.0))
    # the images, node by node
    both = np.linalg.inv(np.array([[0.36, 0.3 * 0.6 * 0.9], [0.3 * 0.6 * 0.9, 0.81]]))
    see = np.zeros((2, n, 3 * n))
    see[0] = np.hstack([-np.diag(yy / distance), one, 0 * one])
    see[1] = np.hstack([-np.diag(zz / distance), 0 * one, one])
    measured = np.stack(
        [
            flow.v.values.ravel() - gates * yy / distance,
            flow.w.values.ravel() - gates * zz / distance,
        ]
    )
    data = np.einsum("anx,ab,bn->x", see, both, measured)
    information += np.einsum("anx,ab,bny->xy", see, both, see)
    for k in range(8):
        d, (y, z) = scan.direction.values[k], float(scan.range[k]) * scan.direction.values[k, 1:]
        hat = np.clip(1 - abs(y - yy), 0, None) * np.clip(1 - abs(z - zz), 0, None)
        row = np.concatenate([d[0] * hat, d[1] * hat, d[2] * hat])
        information += np.outer(row, row) / 0.16
        data -= row * float(scan.v_los[k]) / 0.16
    covariance = np.linalg.inv(information)
    wind = (covariance @ data).reshape(3, *shape)
    for index, name in enumerate("uvw"):
        np.testing.assert_allclose(found[name], wind[index], atol=1e-6)
    for z, y in ((0, 0), (2, 3), (4, 6)):
        pick = [z * len(Y) + y + part * n for part in range(3)]
        np.testing.assert_allclose(
            covariance_at(found, z, y), covariance[np.ix_(pick, pick)], atol=1e-6
        )


# errors


def scene(random, u_std=1.0, length=12.0, noise=0.7, line_std=0.5, std=None):
    """Random truth and measurements as the estimator takes them to be."""
    y, z = np.arange(-24, 24.1, 2.0), np.arange(-16, 16.1, 2.0)
    root = [np.linalg.cholesky(np.exp(-abs(a[:, None] - a) / length)) for a in (z, y)]
    overlap = [
        np.linalg.cholesky(np.clip(1 - abs(a[:, None] - a) / 4, 0, None) + 1e-12 * np.eye(len(a)))
        for a in (z, y)
    ]
    shape = (len(z), len(y))

    def smooth(roots):
        return roots[0] @ random.standard_normal(shape) @ roots[1].T

    truth = {"u": 4.0 + u_std * smooth(root), "v": 3 * smooth(root), "w": 3 * smooth(root)}
    wind = xr.Dataset({k: (("z", "y"), f) for k, f in truth.items()}, coords={"y": y, "z": z})
    errors = noise * smooth(overlap), noise * smooth(overlap)
    flow = crossflow(
        truth["v"] + errors[0], truth["w"] + 1.5 * errors[1], noise, 0.0, y, z, stride=1, template=2
    )
    # narrow beams and short bins, which see the wind of a place
    lidar = DopplerLidar(
        range=76, range_bin=0.2, beam_radius=1e-3, divergence_full=0, pulse_duration=0
    )
    scan = scan_wind(
        wind,
        DopplerScan(azimuth_half="15 deg", elevation_half="10 deg"),
        lidar,
        line_std,
        int(random.integers(2**31)),
        150.0,
    )
    return wind, flow, scan


def reduced_errors(known, draws):
    """Errors over stated errors at good nodes among the lines, of u, v, w, one row a draw."""
    random = np.random.default_rng(11)
    rows = []
    for _ in range(draws):
        wind, flow, scan = scene(random)
        found = combine(flow, scan, **known)
        # far apart, so that nodes hardly know of each other
        pick = {"z": slice(3, -3, 5), "y": slice(3, -3, 6)}
        assert (found.flag.isel(pick) == 0).all()
        rows.append(
            [((found[c] - wind[c]) / found[f"{c}_stderr"]).isel(pick).values.ravel() for c in "uvw"]
        )
    return np.array(rows)


def test_errors_are_as_stated():
    """Statistics of u given: unit variance and coverage to 4 sigma of 40 draws x 12 nodes."""
    reduced = reduced_errors(
        {"u_std": 1.0, "u_length": 12.0, "u_power": 0.0, "u_exponent": 1.0}, 40
    )
    for values in reduced.transpose(1, 0, 2):
        count = values.size / 2  # nodes of a draw share the lines
        assert abs(values.mean()) < 4 / math.sqrt(count)
        assert values.var() == pytest.approx(1, abs=4 * math.sqrt(2 / count))
        for sigmas, fraction in ((1, 0.6827), (2, 0.9545)):
            held = (abs(values) < sigmas).mean()
            assert abs(held - fraction) < 4 * math.sqrt(fraction * (1 - fraction) / count)


def test_statistics_of_u_are_estimated():
    """Most probable values within a factor of 2.5 of 2 m/s and 12 m, in the median of 9 draws."""
    random = np.random.default_rng(6)
    found = [combine(*scene(random, u_std=2.0)[1:]).attrs for _ in range(9)]
    assert 0.8 < np.median([f["u_std"] for f in found]) < 5
    assert 4.8 < np.median([f["u_length"] for f in found]) < 30
    assert np.median([f["misfit"] for f in found]) == pytest.approx(1, abs=0.3)


def test_uniform_wind_is_known_to_the_mean_of_all_lines():
    """u without structure: hardly more than the error of 63 lines' mean, 0.5 / (sqrt(63) cos)."""
    random = np.random.default_rng(8)
    _, flow, scan = scene(random, u_std=1e-6, noise=0.01)
    found = combine(flow, scan)
    assert 0.063 < float(found.u_stderr.min()) < 0.2
    assert float(abs(found.u - 4).max()) < 0.6
    assert found.attrs["u_std"] < 0.5


# what the platform does not know


def still_air(errors, seed, std=0.02):
    """Wind of 3 m/s along x, even, lines from a platform at 70 m/s, images of next to no error."""
    y, z = np.arange(-50, 50.1, 2.0), np.arange(-32, 32.1, 2.0)
    flow = crossflow(0.0, 0.0, 0.01, 0.0, y, z)
    wind = flow[["v", "w"]].assign(u=3 + 0 * flow.v)
    directions = DopplerScan(azimuth_half="16 deg", elevation_half="10 deg")
    lidar = DopplerLidar(range="150 m")
    return flow, scan_wind(wind, directions, lidar, std, seed, 70.0, PlatformErrors(**errors))


def test_an_error_of_the_attitude_is_not_in_the_stated_errors():
    """Yaw by e tilts u by e (V - u) / D along y, to 1 %: lines do not distinguish it from wind.

    The stated errors are far smaller.
    """
    flow, scan = still_air({"yaw": "5 mrad"}, 1)
    found = combine(flow, scan)
    inside = found.flag == 0
    tilt = found.u.where(inside).mean("z").polyfit("y", 1, skipna=True).polyfit_coefficients[0]
    assert float(tilt) == pytest.approx(5e-3 * 67 / 150, rel=0.01 + 3 * 0.02 / math.sqrt(63) / 0.06)
    rim = inside & (abs(found.y) > 30)
    wrong = float(abs(found.u - 3).where(rim).mean())
    assert wrong > 4 * float(found.u_stderr.where(rim).mean())


def test_jitter_of_the_lines_is_taken_for_a_scatter_of_u():
    """5 mrad rms of every line, 0.05 m/s of velocity, not contained in its stated 0.02 m/s.

    The scatter is retrieved and contained in the stated errors, which are then above the true ones
    (3 draws).
    """
    square, stated = [], []
    for seed in range(3):
        found = combine(*still_air({"jitter": "5 mrad"}, seed))
        quiet = combine(*still_air({}, seed))
        inside = found.flag == 0
        square.append(float((((found.u - 3) / found.u_stderr) ** 2).where(inside).mean()))
        stated.append(float((found.u_stderr / quiet.u_stderr).where(inside).mean()))
    assert max(square) < 1.3 and min(stated) > 3


# flags


def test_without_valid_image_vectors_u_remains():
    """A hole of 10 m: no v and w, u with errors that are as stated (12 draws, some 3 degrees of
    freedom each, 4 sigma) and more than without the hole."""
    square = []
    for seed in range(12):
        wind, flow, scan = scene(np.random.default_rng(seed))
        hole = (abs(flow.y - 6) < 5) & (abs(flow.z) < 5)
        flow["flag"] = flow.flag.where(~hole, 4).astype(np.uint8)
        spoiled = flow.assign(v=flow.v.where(~hole, 1e6), w=flow.w.where(~hole))
        found = combine(spoiled, scan)
        square.append(float(((((found.u - wind.u) / found.u_stderr) ** 2).where(hole)).mean()))
    assert abs(np.mean(square) - 1) < 4 * math.sqrt(2 / 3 / 12)
    assert (((found.flag & CombinedFlag.NO_CROSSFLOW) > 0) == hole.transpose("z", "y")).all()
    assert found.v.where(hole, drop=True).isnull().all() and found.u.notnull().all()
    assert found.v_stderr.where(hole, drop=True).isnull().all()
    known = {"u_std": 1.0, "u_length": 12.0, "u_power": 0.0, "u_exponent": 1.0}
    whole = combine(flow.assign(flag=0 * flow.flag), scan, **known)
    less = combine(spoiled, scan, **known)
    assert float(less.u_stderr.where(hole).mean()) > 1.02 * float(whole.u_stderr.where(hole).mean())


def test_beyond_the_lines_u_is_flagged_and_uncertain():
    _, flow, scan = scene(np.random.default_rng(12))
    found = combine(flow, scan, u_std=2.0, u_length=3.0)
    beyond = (found.flag & CombinedFlag.BEYOND_LINES) > 0
    expected = (abs(found.y) > 76 * math.tan(math.radians(15))) | (
        abs(found.z) > 76 * math.tan(math.radians(10))
    )
    assert (beyond == expected.transpose("z", "y")).all()
    assert float(found.u_stderr.where(beyond).max()) > 1.9


def test_lines_that_leave_the_images_or_have_no_velocity_are_not_used():
    _, flow, scan = scene(np.random.default_rng(13))
    fewer = flow.sel(y=slice(-12, 12))
    inside = int((abs(scan.range * scan.direction[:, 1]) < 12).sum())
    assert combine(fewer, scan).attrs["lines_used"] == inside < 63
    scan.v_los[:5] = np.nan
    assert combine(flow, scan).attrs["lines_used"] == 58


def test_chunks_do_not_matter(monkeypatch):
    _, flow, scan = scene(np.random.default_rng(14))
    whole = combine(flow, scan)
    for module in ("combine", "grid_lines"):
        monkeypatch.setattr(f"lidar_mi.retrieval.combined.{module}.CHUNK_NUMBERS", 3e4)
    xr.testing.assert_allclose(combine(flow, scan), whole, rtol=1e-9)


def test_methods_that_know_no_errors():
    _, flow, scan = scene(np.random.default_rng(15))
    bare = flow.assign(
        {n: np.nan * flow.v for n in ("v_stderr", "w_stderr", "vw_correlation")}
    ).assign_attrs(method="cc")
    with pytest.raises(InputError, match=r"crossflow.v_stderr: not known by method 'cc'; give"):
        combine(bare, scan)
    found = combine(bare, scan, crossflow_std=0.7)
    assert float(found.v_stderr.mean()) == pytest.approx(0.7, rel=0.02)
    # as weight shift flags it: an error that is given is known, an outlier remains one
    bare["flag"] = bare["flag"].astype(np.uint16)
    flagged = bare.assign(flag=bare["flag"] | np.uint16(Flag.ERROR_UNKNOWN))
    flagged["flag"][:, :3] = np.uint16(Flag.MEDIAN_OUTLIER | Flag.ERROR_UNKNOWN)
    found = combine(flagged, scan, crossflow_std=0.7)
    bare["flag"][:, :3] = Flag.MEDIAN_OUTLIER.value
    xr.testing.assert_equal(found, combine(bare, scan, crossflow_std=0.7))


def test_data_set_survives_a_file(tmp_path):
    _, flow, scan = scene(np.random.default_rng(16))
    found = combine(flow, scan)
    assert found.u.attrs["standard_name"] == "x_wind" and found.attrs["Conventions"] == "CF-1.11"
    assert all("units" in found[n].attrs for n in found.data_vars if n != "flag")
    found.to_netcdf(tmp_path / "wind.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "wind.nc", engine="h5netcdf") as back:
        xr.testing.assert_identical(back.load(), found)


FLOW = crossflow(0.0, 0.0, 1.0)
LINES = lines(np.array([[0.3, 0.2], [1.0, 1.0]]), [1.0, 2.0], 0.5)


@pytest.mark.parametrize(
    ("call", "start"),
    [
        (
            lambda: combine(FLOW.assign(flag=FLOW.flag + 1), LINES),
            "crossflow.flag: every vector is",
        ),
        (lambda: combine(FLOW.drop_vars("v"), LINES), "crossflow.v: missing"),
        (lambda: combine(FLOW, LINES.drop_vars("range_bin")), "scan.range_bin: missing"),
        (lambda: combine(FLOW, LINES.drop_vars("v_los")), "scan.v_los: missing"),
        (lambda: combine(FLOW, lines(np.array([[9.0, 0]]), [1.0], 0.5)), "scan: none of 1 lines"),
        (lambda: combine(FLOW, LINES.assign(v_los=np.nan * LINES.v_los)), "scan: none of 2 lines"),
        (lambda: combine(FLOW, LINES, window=-1), "window: -1 m"),
        (lambda: combine(FLOW, LINES, crossflow_std=0), "crossflow_std: 0 m/s"),
        (lambda: combine(FLOW, LINES, u_std=0), "u_std: 0 m/s"),
        (lambda: combine(FLOW, LINES, u_length=-2), "u_length: -2 m"),
        (lambda: combine(FLOW, LINES, u_power=-1), "u_power: -1"),
        (lambda: combine(FLOW, LINES, u_exponent=2.5), "u_exponent: 2.5"),
        (lambda: combine(FLOW, LINES, distance=0), "distance: 0 m"),
        (lambda: combine(FLOW.assign_attrs(template=None).drop_attrs(), LINES), "crossflow"),
    ],
)
def test_bad_input_is_named(call, start):
    with pytest.raises(InputError) as error:
        call()
    assert str(error.value).startswith(start) and "\n" not in str(error.value)


def test_an_error_that_all_lines_share():
    """One frame of the laser for all lines: u is off by its error all over, and says so.

    60 draws of a uniform u: normalised errors have a variance of 1 +- 0.18; as if the errors were
    independent it would be above 5.
    """
    rng, places = np.random.default_rng(8), [(y, z) for z in (-2, 0, 2) for y in (-3, -1, 1, 3)]
    flow = crossflow(0.0, 0.0, 0.1)
    own, common, number = 0.1, 0.4, 60
    std = math.hypot(own, common)
    normalised = {"told": [], "not told": []}
    for _ in range(number):
        error = own * rng.standard_normal(len(places)) + common * rng.standard_normal()
        scan = lines(places, error, std, distance=100.0)
        shared = common**2 * (1 - np.eye(len(places)))
        told = scan.assign(v_los_covariance=(("line", "other_line"), shared))
        for name, one in (("told", told), ("not told", scan)):
            middle = combine(flow, one).sel(y=0, z=0)
            normalised[name].append(float(middle["u"] / middle["u_stderr"]))
    assert np.mean(np.square(normalised["told"])) == pytest.approx(1, abs=4 * np.sqrt(2 / number))
    assert np.mean(np.square(normalised["not told"])) > 5
