"""Random extinction fields on grids, and the lidar signal through them by quadrature.

The fields are those that make estimators of transmittance fail: layers, spikes, voids, one bright
cell anywhere, contrasts over decades; in any pose, with any filter and wrap mode, at rest and
moving, smaller or as large as the medium, alone or in an environment. The quadrature is plain
numpy in double precision: beams and telescope are points, the phase function is isotropic.
"""

from dataclasses import dataclass, replace

import numpy as np

APERTURE = 1e-3
AREA = np.pi * APERTURE**2
PHASE = 1 / (4 * np.pi)
KINDS = ("layers", "spike", "voids", "pieces", "decades", "smooth", "empty but one")


@dataclass(frozen=True)
class Field:
    """An extinction field, its medium's box and the gate that looks through it; SI units.

    ``states`` (t, z, y, x) fill the unit cube, which ``place`` (4 x 4) maps to the world; the
    medium fills the cube from ``-margin`` to ``1 + margin`` of it. Beams look along +x at ``time``.
    """

    kind: str
    states: np.ndarray
    place: np.ndarray
    margin: float
    filter: str
    wrap: str
    scale: float
    environment: float
    gate: tuple[float, float]
    time: float

    @property
    def moving(self) -> bool:
        """Whether the states are those of a moving volume, from time 0 to 1."""
        return len(self.states) > 1

    def local(self, points):
        """Places in the unit cube."""
        inverse = np.linalg.inv(self.place)
        return points @ inverse[:3, :3].T + inverse[:3, 3]

    def extinction(self, points):
        """Extinction coefficient at places (..., 3), m^-1."""
        local = self.local(points)
        inside = ((local > -self.margin) & (local < 1 + self.margin)).all(-1)
        return np.where(inside, self.scale * self._values(local), self.environment)

    def _values(self, local):
        first = self.time * (len(self.states) - 1)
        low = int(min(first, max(len(self.states) - 2, 0)))
        high = min(low + 1, len(self.states) - 1)
        return (1 - (first - low)) * self._state(low, local) + (first - low) * self._state(
            high, local
        )

    def _state(self, index, local):
        state = self.states[index]
        cells = np.array(state.shape[::-1])
        if self.filter == "nearest":
            return state[tuple(self._wrapped(np.floor(local * cells), cells).T[::-1])].T
        place = local * cells - 0.5
        low = np.floor(place)
        weight = place - low
        total = 0.0
        for corner in np.ndindex(2, 2, 2):
            index = self._wrapped(low + corner, cells)
            part = np.prod(np.where(corner, weight, 1 - weight), -1)
            total = total + part * state[tuple(np.moveaxis(index, -1, 0)[::-1])]
        return total

    def _wrapped(self, index, cells):
        index = index.astype(int)
        if self.wrap == "repeat":
            return index % cells
        if self.wrap == "mirror":
            index = index % (2 * cells)
            return np.where(index < cells, index, 2 * cells - 1 - index)
        return np.clip(index, 0, cells - 1)

    def breaks(self, direction, end, start=(0.0, 0.0, 0.0)):
        """Distances along a line, 0 to ``end``, between which the extinction is a polynomial."""
        origin, step = self.local(np.array(start)), np.linalg.inv(self.place)[:3, :3] @ direction
        found = [np.array([0.0, end])]
        for axis, cells in enumerate(self.states.shape[:0:-1]):
            if abs(step[axis]) < 1e-12:
                continue
            faces = np.concatenate(
                [
                    np.arange(-1 - 4 * cells, 8 * cells + 1) / (2 * cells),
                    [-self.margin, 1 + self.margin],
                ]
            )
            found.append((faces - origin[axis]) / step[axis])
        places = np.unique(np.concatenate(found))
        return places[(places >= 0) & (places <= end)]


def field(seed: int) -> Field:
    """The field of a seed."""
    rng = np.random.default_rng(seed)
    return next(made for made in iter(lambda: _drawn(rng), 0) if made)


def _drawn(rng) -> Field | None:
    kind = KINDS[rng.integers(len(KINDS))]
    cells = np.array([rng.integers(2, 200), rng.integers(1, 7), rng.integers(1, 7)])
    times = int(rng.choice([1, 1, 2, 3]))
    start, length = rng.choice([0.5, 30.0, 400.0]), 10 ** rng.uniform(0.7, 2.8)
    states = np.stack([_state(kind, cells[::-1], rng) for _ in range(times)])
    depth = 10 ** rng.uniform(-2, 0.4)  # along the densest line, one way
    states *= depth / (states.sum(-1).max() * length / cells[0])
    sizes, turn = np.array([length, *(10 ** rng.uniform(-0.3, 1.5, 2))]), np.eye(3)
    if rng.random() < 0.4:
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        turn[:, 0] *= np.linalg.det(turn)
        sizes = length * 10 ** rng.uniform(-1, 0, 3)
    margin, place = float(rng.choice([0.0, 0.0, 0.3])), np.eye(4)
    place[:3, :3] = turn * sizes
    # the telescope is outside, and looks at the middle or beside it
    reach = (0.5 + margin) * np.abs(place[:3, :3]).sum(1)
    middle = [start + reach[0], *(rng.uniform(-0.2, 0.2, 2) * sizes.min())]
    place[:3, 3] = middle - place[:3, :3].sum(1) / 2
    moving = times > 1
    made = Field(
        kind=kind,
        states=states.astype(np.float32).astype(float),
        place=place,
        margin=margin,
        filter="trilinear" if moving else str(rng.choice(["nearest", "trilinear"])),
        wrap="clamp" if moving else str(rng.choice(["clamp", "repeat", "mirror"])),
        scale=float(rng.choice([1.0, 0.5])),
        environment=float(rng.choice([0.0, 1e-3])),
        gate=(0.0, 1.0),
        time=float(rng.random()) if moving else 0.0,
    )
    gate = _gate(made, start, start + 2 * reach[0], rng)
    return replace(made, gate=gate) if gate else None


def _gate(made, start, end, rng):
    """A gate whose extinction is not confined to a corner that few samples meet; None: none."""
    for _ in range(20):
        near = rng.uniform(0.5 * start, end)
        gate = near, near + rng.uniform(0.02, 0.3) * (end - start)
        if _filled(made, gate):
            return gate
    return None


def _filled(made, gate):
    """Whether there is air in a gate and more than a corner of it."""
    x = np.linspace(*gate, 4001)
    values = made.extinction(np.stack([x, 0 * x, 0 * x], -1))
    return values.mean() > 0.02 * values.max() > 0


def _state(kind, shape, rng):
    """One state in arbitrary units."""
    base = 10 ** rng.uniform(-4, -1)
    values = np.full(shape, base)
    if kind == "layers":
        for _ in range(rng.integers(1, 4)):
            values[..., rng.integers(shape[2])] = 1.0
    elif kind == "spike":
        values[tuple(rng.integers(shape))] = 1.0
    elif kind == "voids":
        values = np.where(rng.random(shape) < 0.7, 1.0, 0.0)
    elif kind == "pieces":
        steps = np.sort(rng.integers(0, shape[2], 3))
        values = np.broadcast_to(
            rng.random(4)[np.searchsorted(steps, np.arange(shape[2]), "right")], shape
        ).copy()
    elif kind == "decades":
        values = 10 ** rng.uniform(-5, 0, shape)
    elif kind == "smooth":
        x = np.linspace(0, 2 * np.pi, shape[2])
        values = np.broadcast_to(1.01 + np.sin(x * rng.integers(1, 4)), shape).copy()
    else:
        values[:] = 0
        values[tuple(n // 2 for n in shape)] = 1.0
        values[..., rng.integers(shape[2])] = rng.random()
    return values


def gauss(low, high, count):
    """Nodes and weights of Gauss-Legendre quadrature on intervals, (n, count)."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    half = (high - low)[:, None] / 2
    return (low + high)[:, None] / 2 + half * nodes, half * weights


def single_scattering(made: Field, offset: float = 0.0) -> float:
    """Received over emitted energy of the first order; the air is looked up ``offset`` off, m."""
    along = np.array([1.0, 0.0, 0.0])
    edges = made.breaks(along, made.gate[1])
    edges = np.unique(np.concatenate([edges, np.linspace(*made.gate, 1001)]))
    place, weight = gauss(edges[:-1], edges[1:], 3)
    extinction = made.extinction((place[..., None] + offset) * along)
    depth = np.concatenate([[0], np.cumsum((weight * extinction).sum(1))])[:-1]
    # within an interval: to each node as if the extinction were the mean, exact to third order
    mean = (weight * extinction).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
    within = depth[:, None] + mean * (place - edges[:-1, None])
    counted = (place >= made.gate[0]) & (place <= made.gate[1])
    signal = AREA * PHASE * extinction * np.exp(-2 * within) / place**2
    return float((weight * np.where(counted, signal, 0)).sum())


def widened(seed: int) -> Field:
    """A field for multiple scattering: as wide as it is long, of few cells, with a long gate."""
    fields = map(field, range(seed * 1000, seed * 1000 + 1000))
    wide = (_widened(made) for made in fields if _coarse(made))
    return next(made for made in wide if _filled(made, made.gate))


def _widened(made):
    length, *width = np.abs(made.place[:3, :3]).sum(1)
    stretch = np.diag([1.0, *(np.maximum(1.0, 0.5 * length / np.array(width))), 1.0])
    # the farthest corner of a box in any pose
    end = float(made.place[0, 3] + np.maximum(made.place[0, :3], 0).sum())
    return replace(made, place=stretch @ made.place, gate=(0.6 * end, end))


def _coarse(made):
    return max(made.states.shape[1:]) <= 30 and made.states.mean() > 0.02 * made.states.max()


def double_scattering(made: Field, fov_half: float, paths: int, seed: int) -> tuple[float, float]:
    """Received over emitted energy of the second order from the gate, and its standard error.

    Brute force: first vertices uniform along the beam; second ones from two densities, by flights
    in all directions and uniform in the field of view, weighted by their mean (balance heuristic).
    All within the distances at which there is air.
    """
    rng, far = np.random.default_rng(seed), made.gate[1]
    near, longest = _reach(made)
    first = near + (far - near) * rng.random(paths)
    turn, cosine = 2 * np.pi * rng.random(paths), 2 * rng.random(paths) - 1
    in_view = rng.random(paths) < 0.5
    view = 2 * np.pi * (1 - np.cos(fov_half))
    cosine = np.where(in_view, 1 - (1 - cosine) / 2 * (1 - np.cos(fov_half)), cosine)
    part = rng.random(paths)
    length = np.where(in_view, near + (far - near) * part, longest * part)
    sine = np.sqrt(1 - cosine**2)
    ways = np.stack([cosine, sine * np.cos(turn), sine * np.sin(turn)], -1) * length[:, None]
    start = np.stack([first, 0 * first, 0 * first], -1)
    second = np.where(in_view[:, None], ways, start + ways)
    leg, back = np.linalg.norm(second - start, axis=1), np.linalg.norm(second, axis=1)
    whole = first + leg + back
    counted = (whole > 2 * made.gate[0]) & (whole < 2 * made.gate[1])
    counted &= second[:, 0] > back * np.cos(fov_half)
    first, start, second, leg, back = (a[counted] for a in (first, start, second, leg, back))
    density = 0.5 * ((near < back) & (back < far)) / (view * back**2 * (far - near))
    density += 0.5 * (leg < longest) / (4 * np.pi * leg**2 * longest)
    density = np.where(density > 0, density, np.inf)
    value = made.extinction(start) * made.extinction(second) * PHASE**2 * AREA * (far - near)
    value *= second[:, 0] / back / (back**2 * leg**2 * density)
    lit = value > 0
    depth = _depths(made, 0 * start[lit], start[lit], rng)
    depth += _depths(made, start[lit], second[lit], rng)
    depth += _depths(made, second[lit], 0 * start[lit], rng)
    value[lit] *= np.exp(-depth)
    mean = value.sum() / paths
    return mean, float(np.sqrt(((value**2).sum() / paths - mean**2) / paths))


def _reach(made):
    """Distance at which the air begins, and that between the two scatterings at most."""
    if made.environment:
        return 0.0, 2 * made.gate[1]
    local = np.array(list(np.ndindex(2, 2, 2))) * (1 + 2 * made.margin) - made.margin
    corners = local @ made.place[:3, :3].T + made.place[:3, 3]
    apart = np.linalg.norm(corners[:, None] - corners, axis=-1)
    return max(corners[:, 0].min(), 0.0), apart.max()


def _depths(made, start, end, rng, steps=200):
    """Optical depths of straight lines, one random place in each step."""
    total = np.zeros(len(start))
    for step in range(steps):
        along = (step + rng.random(len(start))) / steps
        total += made.extinction(start + along[:, None] * (end - start))
    return total * np.linalg.norm(end - start, axis=1) / steps


def scene(made: Field, fov_half_mrad: float = 5.0, **integrator):
    """The field's Mitsuba scene."""
    import mitsuba as mi

    to_world = mi.ScalarTransform4f(made.place)
    if made.moving:
        volume = {
            "type": "moving_volume",
            "data": mi.TensorXf(made.states.astype(np.float32)),
            "time_start": 0.0,
            "time_stop": 1.0,
        }
    else:
        volume = {
            "type": "gridvolume",
            "grid": mi.VolumeGrid(made.states[0][..., None].astype(np.float32)),
            "filter_type": made.filter,
            "wrap_mode": made.wrap,
        }
    around = {"type": "ref", "id": "environment"}
    environment = made.environment > 0
    beam = np.array([[0.0, 0, 0, 1, 0, 0, made.time]], np.float32)
    isotropic = {"albedo": 1.0, "phase": {"type": "isotropic"}}
    sensor = {
        "type": "scanning_lidar",
        "aperture_radius": APERTURE,
        "fov_half_mrad": fov_half_mrad,
        "gate_start": made.gate[0],
        "gate_stop": made.gate[1],
        "beams": mi.TensorXf(beam),
        "laser": {"type": "laser", "beam_radius": 1e-4, "beam_cut": 1e-4},
        "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}},
    }
    box = {
        "type": "cube",
        "bsdf": {"type": "null"},
        "to_world": to_world @ mi.ScalarTransform4f().translate(0.5).scale(0.5 + made.margin),
        "interior": {
            "type": "heterogeneous",
            "scale": made.scale,
            "sigma_t": {**volume, "to_world": to_world},
            **isotropic,
        },
    }
    described = {"type": "scene", "integrator": {"type": "gated_volpath", **integrator}}
    if environment:
        described["environment"] = {"type": "homogeneous", "sigma_t": made.environment, **isotropic}
        sensor["medium"], box["exterior"] = around, around
    return mi.load_dict({**described, "sensor": sensor, "box": box})


def deviation(made: Field, samples: int, seed: int) -> tuple[float, float, float]:
    """Rendered minus true signal over its error; rendered and true signal.

    The error is the stated one and, where there is hardly any, that of places and ranges in single
    precision.
    """
    import mitsuba as mi

    image = np.array(mi.render(scene(made), spp=samples, seed=seed), float).ravel()
    truth = single_scattering(made)
    spacing = 4 * np.spacing(np.float32(2 * made.gate[1]))
    rounding = abs(single_scattering(made, spacing) - truth) + 2e-5 * truth
    return (image[0] - truth) / np.hypot(image[4], rounding), image[0], truth


def check(seed: int, samples: int = 8192) -> str | None:
    """What is wrong with the signal of a seed's field; None: nothing."""
    made = field(seed)
    z, rendered, truth = deviation(made, samples, seed)
    if abs(z) < 5:
        return None
    return (
        f"field {seed} ({made.kind}, {made.filter}, {made.wrap}, {len(made.states)} states): "
        f"{rendered:.5g} for {truth:.5g}, {z:.1f} standard errors"
    )
