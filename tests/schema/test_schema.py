"""What an experiment file may say. Detects a lost default, limit or message."""

import math
import re
from importlib.resources import files
from typing import get_args

import pytest
import yaml
from pydantic import BaseModel

from lidar_mi.errors import InputError
from lidar_mi.schema.coherent import CoherentDoppler
from lidar_mi.schema.experiment import Experiment
from lidar_mi.schema.reading import check, dump, load
from lidar_mi.units import Unit, Within

LEAST = "name: least\nwake: {file: wake.nc}\n"


@pytest.fixture
def write(tmp_path):
    def write(text=LEAST):
        path = tmp_path / "experiment.yaml"
        path.write_text(text)
        return path

    return write


def test_least_experiment_has_the_papers_values(write):
    experiment = load(write())
    assert experiment.seed == 1
    assert (experiment.platform.speed, experiment.platform.dt) == (150, 0.1)
    assert experiment.lidar.wavelength == pytest.approx(532e-9)
    assert experiment.lidar.fov_half == pytest.approx(5e-3)
    assert (experiment.scan.aim, experiment.scan.range, experiment.scan.thickness) == (
        "grid",
        500,
        2.5,
    )
    assert experiment.wake.second == "advect" and experiment.wake.spacing == 0.5
    assert experiment.wake.extinction.background == pytest.approx(1e-4)
    assert experiment.wake.extinction.maximum == pytest.approx(1.8e-3)
    assert experiment.wake.extinction.stretch == 2
    assert (experiment.retrieval.template, experiment.retrieval.search) == (8, 16)
    assert experiment.scattering.phase == "aerosol"
    assert experiment.render.variant == "llvm_ad_mono_polarized"


def test_every_section_is_read_with_its_units(write):
    experiment = load(
        write("""
name: every_section-1.0
seed: 7
wake:
  file: les.nc
  time: 40 s
  second: 2 min
  x: 20.5 m
  depth: volume
  centre: [1 m, -60.4 m]
  spacing: 50 cm
  names: {v: VLM, y: lateral}
  extinction: {source: speed, tracer: null, background: 0.2 / km, maximum: 2 / km, stretch: 1}
  texture: {rms: 20 %, outer_scale: 0.01 km}
platform: {speed: 540 km/h, dt: 200 ms}
lidar: {wavelength: 355 nm, beam_cut: .inf, divergence_full: 0.1 mrad, stokes: [1, 0, 0, 1]}
scan: {aim: angles, range: 1 km, gates: spherical, gate_count: 3, azimuth_half: [3 deg, 50 mrad]}
scattering: {phase: henyey_greenstein, asymmetry: 0.7, albedo: 0.9}
render: {variant: llvm_ad_rgb, samples_per_beam: 16, estimator: analog}
retrieval: {methods: [ws], template: 6, search: 12, stride: 2}
""")
    )
    wake = experiment.wake
    assert (wake.time, wake.second, wake.x, wake.centre) == (40, 120, 20.5, (1, -60.4))
    assert wake.spacing == 0.5 and wake.names == {"v": "VLM", "y": "lateral"}
    assert wake.extinction.tracer is None and wake.extinction.aerosol == "aerosol"
    assert wake.extinction.maximum == pytest.approx(2e-3)
    assert (wake.texture.rms, wake.texture.outer_scale) == pytest.approx((0.2, 10))
    assert experiment.platform.speed == pytest.approx(150)
    assert experiment.lidar.beam_cut == math.inf and experiment.lidar.stokes == (1, 0, 0, 1)
    assert experiment.scan.azimuth_half == pytest.approx((math.radians(3), 0.05))
    assert experiment.scattering.asymmetry == 0.7
    assert experiment.retrieval.methods == ("ws",)


def test_vortex_pair_in_place_of_a_file(write):
    experiment = load(write("name: a\nwake: {vortex_pair: {circulation: 400, separation: 40 m}}"))
    pair = experiment.wake.vortex_pair
    assert (pair.model, pair.circulation, pair.separation, pair.core_radius) == (
        "lamb_oseen",
        400,
        40,
        3,
    )
    assert experiment.wake.file is None


def test_shipped_experiment_is_valid():
    experiment = load(files("lidar_mi.scenes") / "wake_backscatter.yaml")
    assert experiment.name == "wake_backscatter"
    assert load(files("lidar_mi.scenes") / "wake_backscatter.yaml", ["seed=2"]).seed == 2


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("wake.texture.rms=0.2", lambda e: e.wake.texture.rms == 0.2),
        ("platform.speed = 200 m/s", lambda e: e.platform.speed == 200),
        ("render.samples_per_beam=16", lambda e: e.render.samples_per_beam == 16),
        ("retrieval.methods=[cc]", lambda e: e.retrieval.methods == ("cc",)),
        ("wake.extinction.tracer=null", lambda e: e.wake.extinction.tracer is None),
        ("wake.second=40.1 s", lambda e: e.wake.second == 40.1),
        ("wake={vortex_pair: {}}", lambda e: e.wake.vortex_pair.core_radius == 3),
        ("lidar.stokes=[1, 0, 0, 1]", lambda e: e.lidar.stokes == (1, 0, 0, 1)),
        ("wake.file=a=b.nc", lambda e: e.wake.file == "a=b.nc"),
    ],
)
def test_overrides(write, text, value):
    assert value(load(write(), [text]))


def test_last_override_wins(write):
    assert load(write(), ["seed=2", "seed=3"]).seed == 3


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["lidar.beam_cut=.inf", "wake.second=40.1 s", "wake.time=40 s"],
        ["wake={vortex_pair: {model: burnham_hallock}}", "wake.texture.rms=0"],
        ["scattering={phase: table, table: spheroids.txt}", "scan.aim=angles"],
        ["scattering={phase: mixture, parts: [{phase: molecules, fraction: 1}]}"],
        ["wake.centre=[0.1 m, -1e-9 m]", "wake.names={v: V}", "wake.extinction.aerosol=null"],
    ],
)
def test_written_experiment_is_read_again_exactly(write, tmp_path, overrides):
    experiment = load(write(), overrides)
    again = tmp_path / "again.yaml"
    again.write_text(dump(experiment))
    assert load(again) == experiment
    assert "divergence_full: 2 mrad" in again.read_text()  # as given


def test_experiments_cannot_be_changed(write):
    with pytest.raises(Exception, match="frozen"):
        load(write()).seed = 5


FAULTS = [
    # unknown keys, with a suggestion
    ("wake.texture.rsm=0.1", "wake.texture.rsm: unknown key; did you mean rms? (allowed: rms, "),
    ("lidar.wavelenght=532 nm", "lidar.wavelenght: unknown key; did you mean wavelength?"),
    ("platfrm.speed=1", "platfrm: unknown key; did you mean platform?"),
    ("wake.extinction.sorce=x", "wake.extinction.sorce: unknown key; did you mean source?"),
    ("scan.zzz=1", "scan.zzz: unknown key (allowed: aim, range, "),
    (
        "scattering={phase: mixture, parts: [{phase: molecules, fractio: 1}]}",
        "scattering.parts.0.fractio: unknown key; did you mean fraction? (allowed: aerosol, band, ",
    ),
    (
        "scattering={phase: mixture, parts: [{phase: hg, fraction: 1}]}",
        "scattering.parts.0.phase: 'hg' is not allowed; expected 'rayleigh', 'molecules', "
        "'aerosol' or",
    ),
    (
        "scattering={phase: mixture, parts: [{phase: aerosol, fraction: 1}]}",
        "scattering.parts.0: aerosol: None is not allowed with phase aerosol",
    ),
    (
        "scattering={phase: mixture, parts: [{phase: molecules}]}",
        "scattering.parts.0.fraction: missing",
    ),
    (
        "scattering={phase: mixture, parts: [{phase: molecules, fraction: 0}]}",
        "scattering.parts.0.fraction: 0 is not allowed; expected 1e-09 to 1e+09",
    ),
    ("scattering={phase: mixture}", "scattering: parts: None is not allowed with phase mixture"),
    (
        "scattering={parts: [{phase: molecules, fraction: 1}]}",
        "scattering: parts: 1 parts is not allowed with phase aerosol",
    ),
    ("wake.vortex_pair.gamma=1", "wake.vortex_pair.gamma: unknown key (allowed: model, "),
    # wrong units
    ("lidar.beam_radius=5 s", "lidar.beam_radius: '5 s' is not allowed; expected a quantity in m"),
    ("lidar.fov_half=5", "lidar.fov_half: 5 has no unit; expected an angle such as '2 mrad'"),
    ("wake.extinction.maximum=1.8 km", "wake.extinction.maximum: '1.8 km' is not allowed"),
    ("platform.dt=0,1 s", "platform.dt: '0,1 s' is not allowed; expected a quantity in s"),
    ("wake.second=41 m", "wake.second: '41 m' is not allowed; expected advect, advect_3d or a"),
    ("wake.second=later", "wake.second: 'later' is not allowed; expected advect, advect_3d or"),
    ("wake.centre=[1 m, 2 s]", "wake.centre.1: '2 s' is not allowed"),
    ("wake.centre=[1 m]", "wake.centre.1: missing"),
    # out of range
    ("lidar.beam_radius=-1 m", "lidar.beam_radius: -1 m is not allowed; expected 1e-06 to 10 m"),
    (
        "lidar.aperture_radius=0",
        "lidar.aperture_radius: 0 m is not allowed; expected 1e-06 to 10 m",
    ),
    # metres where nanometres were meant, seconds where nanoseconds were
    ("lidar.wavelength=532", "lidar.wavelength: 532 m is not allowed; expected 1e-07 to 2e-05 m"),
    (
        "doppler={lidar: {wavelength: 355 mm}}",
        "doppler.lidar.wavelength: 0.355 m is not allowed; expected 1e-07 to 2e-05 m",
    ),
    ("lidar.pulse_duration=5", "lidar.pulse_duration: 5 s is not allowed; expected 0 to 0.001 s"),
    (
        "lidar.aperture_radius=150",
        "lidar.aperture_radius: 150 m is not allowed; expected 1e-06 to 10 m",
    ),
    (
        "lidar.pulse_energy=-1 mJ",
        "lidar.pulse_energy: -0.001 J is not allowed; expected 1e-15 to 10000 J",
    ),
    ("lidar.stokes=[1, 1, 1, 0]", "lidar.stokes: (1.0, 1.0, 1.0, 0.0) is not allowed; expected I"),
    ("scan.columns=0", "scan.columns: 0 is not allowed; expected 1 to 10000000"),
    (
        "scan={aim: angles, columns: 100000, rows: 50000}",
        "scan: columns, rows: 100000 x 50000 is not allowed; expected at most 1e+07 beams",
    ),
    ("scan.range=.inf", "scan.range: inf m is not allowed; expected 0.1 to 100000 m"),
    (
        "scan.azimuth_half=[0 deg, 6 deg]",
        "scan.azimuth_half.0: 0 deg is not allowed; expected 5.73e-08 to 85.9 deg",
    ),
    ("platform.dt=0 s", "platform.dt: 0 s is not allowed; expected 1e-06 to 10000 s"),
    ("platform.speed=-1 m/s", "platform.speed: -1 m/s is not allowed; expected 0 to 12000 m/s"),
    ("wake.spacing=0 m", "wake.spacing: 0 m is not allowed; expected 0.001 to 1000 m"),
    ("wake.spacing=.nan", "wake.spacing: nan m is not allowed; expected"),
    ("wake.texture.rms=-0.1", "wake.texture.rms: -0.1 is not allowed; expected 0 to 2"),
    (
        "wake.extinction.stretch=0.5",
        "wake.extinction.stretch: 0.5 is not allowed; expected 1 to 100",
    ),
    (
        "wake.extinction.background=-1",
        "wake.extinction.background: -1 1/m is not allowed; expected 0 to 10 1/m",
    ),
    (
        "scattering.depolarization=0.5",
        "scattering.depolarization: 0.5 is not allowed; expected 0 to below 0.5",
    ),
    ("scattering.asymmetry=1", "scattering.asymmetry: 1 is not allowed; expected -0.999 to 0.999"),
    ("scattering.albedo=1.1", "scattering.albedo: 1.1 is not allowed; expected 0 to 1"),
    (
        "render.samples_per_beam=1",
        "render.samples_per_beam: 1 is not allowed; expected 'auto' or 2 to 2147483647",
    ),
    (
        "render.samples_per_pass=0",
        "render.samples_per_pass: 0 is not allowed; expected 1024 to 2147483647",
    ),
    ("render.max_order=65", "render.max_order: 65 is not allowed; expected 1 to 64"),
    ("retrieval.template=1", "retrieval.template: 1 is not allowed; expected 2 to 4096"),
    ("retrieval.stride=0", "retrieval.stride: 0 is not allowed; expected 1 to 8192"),
    (
        "retrieval.min_correlation=2",
        "retrieval.min_correlation: 2 is not allowed; expected -1 to 1",
    ),
    ("seed=-1", "seed: -1 is not allowed; expected 0 to 2147483647"),
    ("seed=1.5", "seed: 1.5 is not allowed; expected a valid integer"),
    # not among the choices
    (
        "render.variant=scalar_rgb",
        "render.variant: 'scalar_rgb' is not allowed; expected 'llvm_ad_mono",
    ),
    (
        "render.estimator=magic",
        "render.estimator: 'magic' is not allowed; expected 'gated' or 'analog'",
    ),
    (
        "scan.gates=conical",
        "scan.gates: 'conical' is not allowed; expected 'planar' or 'spherical'",
    ),
    ("wake.depth=line", "wake.depth: 'line' is not allowed; expected 'plane' or 'volume'"),
    (
        "retrieval.methods=[cc, xx]",
        "retrieval.methods.1: 'xx' is not allowed; expected 'cc', 'ws', 'multipass', "
        "'variational' or 'vortex_fit'",
    ),
    ("retrieval.methods=[cc, cc]", "retrieval: methods: 'cc' twice is not allowed; expected each"),
    ("retrieval.blur=-1", "retrieval.blur: -1 m is not allowed; expected 'beam' or 0 to 1000 m"),
    ("retrieval.methods=[]", "retrieval.methods: [] is not allowed; expected 1 or more"),
    (
        "retrieval.methods=cc",
        "retrieval.methods: 'cc' is not allowed; expected a list in brackets: [cc]",
    ),
    (
        "retrieval.methods=piv",
        "retrieval.methods: 'piv' is not allowed; expected a list in brackets of cc, ws, multipass,"
        " variational, vortex_fit",
    ),
    ("wake.centre=3 m", "wake.centre: '3 m' is not allowed; expected a list in brackets: [3 m, 3"),
    ("name=a/b", "name: 'a/b' is not allowed; expected at most 100 letters, digits"),
    ("name=..", "name: '..' is not allowed; expected at most 100 letters, digits"),
    # not the right kind
    ("wake=3", "wake: 3 is not allowed; expected a section with keys out of file, vortex_pair, "),
    ("lidar=", "lidar: None is not allowed; expected a section with keys out of wavelength, "),
    ("wake.texture.rms=", "wake.texture.rms: None is not allowed; expected a quantity"),
    (
        "render.samples_per_beam=many",
        "render.samples_per_beam: 'many' is not allowed; expected 'auto' or a valid",
    ),
    # of two kinds of a section
    (
        "doppler={kind: heterodyne}",
        "doppler.kind: 'heterodyne' is not allowed; expected 'fringes' or",
    ),
    ("doppler={kind: coherent, etalon: {}}", "doppler.etalon: unknown key (allowed: kind, laser, "),
    (
        "doppler={kind: coherent, scan: {azimut: 90 deg}}",
        "doppler.scan.azimut: unknown key; did you mean azimuth? (allowed: kind, ",
    ),
    (
        "doppler={kind: coherent, scan: {rate: 5}}",
        "doppler.scan.rate: 5 has no unit; expected a quantity in rad/s such as '500 deg/s'",
    ),
    (
        "doppler={kind: coherent, scan: {elevations: [0 deg, 200 deg]}}",
        "doppler.scan.elevations.1: 200 deg is not allowed; expected 0 to 180 deg (from",
    ),
    (
        "doppler={kind: coherent, scan: 3}",
        "doppler.scan: 3 is not allowed; expected a section with keys out of kind, azimuth, ",
    ),
    # values that exclude each other
    (
        "doppler={kind: coherent, scan: {repeat: 1 s}}",
        "doppler.scan: repeat: 1 s is not allowed with scans of 4 s; expected at least",
    ),
    (
        "doppler={kind: coherent, scan: {elevations: [1 deg, 1.1 deg]}}",
        "doppler.scan: elevations: less than the 0.5 deg of one line is not allowed; expected more",
    ),
    (
        "doppler={kind: coherent, laser: {first_gate: 15 m}}",
        "doppler.laser: first_gate: 15 m is not allowed with gates of 30 m; expected more",
    ),
    (
        # c / 2 over 15 kHz
        "doppler={kind: coherent, laser: {pulse_rate: 15 kHz, gates: 961}}",
        "doppler.laser: gates: the last at 10000 m is not allowed; expected at most 9993 m, ",
    ),
    (
        "doppler={kind: coherent, passage: {decay_time: 9 s, dissipation_rate: 1e-3}}",
        "doppler.passage: expected one of decay_time and dissipation_rate",
    ),
    ("wake.vortex_pair={}", "wake: expected one of file, vortex_pair and turbine"),
    ("wake.file=null", "wake: expected one of file, vortex_pair and turbine"),
    ("wake={vortex_pair: {}, second: 41 s}", "wake: second: 41.0 is not allowed with vortex_pair"),
    ("wake={vortex_pair: {}, depth: volume}", "wake: depth: 'volume' is not allowed with vortex"),
    ("scattering.phase=table", "scattering: table: None is not allowed with phase table"),
    ("scattering.table=a.txt", "scattering: table: 'a.txt' is not allowed with phase aerosol"),
    ("retrieval.search=9", "retrieval: search: 9 is not allowed; expected at least template + 2"),
    ("scan.range=15 m", "scan.range: 15 m is not allowed; expected more than the 15 m flown"),
]


COHERENT, PAIR = "doppler: {kind: coherent}\n", "wake: {vortex_pair: {}}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            PAIR + "scan: {range: 100 m}",
            "scan: not allowed with doppler.kind coherent; expected it under",
        ),
        (
            PAIR + "sensor: {}",
            "sensor: not allowed with doppler.kind coherent, a lidar on the ground",
        ),
        (
            PAIR + "encounter: {}",
            "encounter: not allowed with doppler.kind coherent, a lidar on the",
        ),
        ("wake: {turbine: {}}", "wake.turbine: not allowed with doppler.kind coherent; expected"),
        (
            "wake: {file: a.nc, depth: volume}",
            "wake.depth: volume is not allowed with doppler.kind",
        ),
        ("", "wake: missing; doppler.scan.kind rhi expects one (ppi and dbs measure the wind)"),
    ],
)
def test_a_coherent_lidar_is_alone_with_its_wake(write, text, message):
    with pytest.raises(InputError) as error:
        load(write(f"name: a\n{COHERENT}{text}\n"))
    assert message in str(error.value) and "\n" not in str(error.value)


def test_the_kind_of_a_doppler_lidar(write):
    """Fringes without a word, as ever; settings and what is written again have the kind's keys."""
    fringes = load(write("name: a\ndoppler: {etalon: {gap: 13 mm}}\n"))
    assert fringes.fringes is fringes.doppler and fringes.coherent is None
    coherent = load(write("name: a\n" + PAIR + COHERENT))
    assert coherent.coherent is coherent.doppler and coherent.fringes is None
    assert coherent.imaged_wake is None and coherent.doppler.scan.kind == "rhi"
    again = check(yaml.safe_load(dump(coherent)), "again")
    assert again == coherent and "etalon" not in dump(coherent) and "lidar:" not in dump(coherent)


@pytest.mark.parametrize(("override", "message"), FAULTS, ids=[f for f, _ in FAULTS])
def test_a_fault_is_one_line_that_names_it(write, override, message):
    path = write()
    with pytest.raises(InputError) as error:
        load(path, [override])
    text = str(error.value)
    assert text.startswith(f"{path}: {message}")
    assert "\n" not in text


def numbers(model=Experiment, path=()):
    """Every key that takes numbers: dotted name, annotation and all that is nested in it."""
    for name, field in model.model_fields.items():
        parts = list(nested(field.annotation)) + [p for m in field.metadata for p in nested(m)]
        kinds = dict.fromkeys(p for p in parts if isinstance(p, type) and issubclass(p, BaseModel))
        for section in kinds:
            yield from numbers(section, (*path, name))
        if kinds:
            continue
        if {int, float} & {p for p in parts if isinstance(p, type)}:
            yield ".".join((*path, name)), parts


def nested(annotation):
    yield annotation
    for part in get_args(annotation):
        yield from nested(part)


@pytest.mark.parametrize(("name", "parts"), [pytest.param(*x, id=x[0]) for x in numbers()])
def test_every_number_has_a_range_with_its_reason_and_extremes_are_refused(name, parts):
    """1e308 and its like overflow in squares and ratios, 1e-320 in reciprocals, 2^63 in counters.

    A key that is new is covered by itself. Stokes vectors have a rule of their own.
    """
    within = next((part for part in parts if isinstance(part, Within)), None)
    if name != "lidar.stokes":
        assert within is not None and within.low < within.high and len(within.why) > 5
        assert math.isfinite(within.high) and within.low not in (5e-324, -math.inf)
    unit = next((part.symbol for part in parts if isinstance(part, Unit)), "")
    for number in (1e308, -1e308, 2**63, math.nan, -math.inf):
        value = f"{number!r} {unit}" if unit.startswith("rad") or unit == "J" else number
        *sections, key = name.split(".")
        data = {"name": "extreme", "wake": {"vortex_pair": {}}}
        innermost = data
        for section in sections:
            innermost = innermost.setdefault(section, {})
        pairs = ("scan.azimuth_half", "scan.elevation_half", "wake.centre", "doppler.camera.centre")
        several = ("cycles", "tilt", "elevations", "azimuths", "wind")
        innermost[key] = [value] * 2 if name in pairs or key in several else value
        if name.split(".")[0] == "doppler" and name.split(".")[1] in CoherentDoppler.model_fields:
            data["doppler"]["kind"] = "coherent"
        if key == "position":
            innermost[key] = [value] * 3
        if name.startswith("encounter.air.volume.mann"):
            whole = {"nodes": [8] * 3, "spacing": ["1 m"] * 3, "base": "0 m"}
            innermost |= whole | {key: value if key == "base" else [value] * 3}
        if key in ("v_los", "averaged"):
            innermost[key] = [value]
        if name.startswith("scattering.parts"):
            data["scattering"] = {
                "phase": "mixture",
                "parts": [{"phase": "rayleigh", "fraction": 1}],
            }
            data["scattering"]["parts"][0][key] = value
        if name.startswith("encounter.air.gusts"):
            data["encounter"] = {"air": {"gusts": [{key: value}]}}
        if name.startswith("encounter.air.volume"):
            data["encounter"]["air"]["volume"]["file"] = "air.nc"
        if name.startswith("platform.motion.sinusoids"):
            vibration = {"axis": "y", "amplitude": 1, "frequency": 1}
            data["platform"] = {"motion": {"sinusoids": [vibration | {key: value}]}}
        if name.startswith("platform.motion.attitude"):
            innermost |= {"rms": 0, "bandwidth": 1} | {key: value}
        if key == "stokes":
            innermost[key] = [1, value, 0, 0]
        with pytest.raises(InputError) as error:
            check(data, "file")
        assert re.split(r"\.parts|\.sinusoids|\.gusts", name)[0] in str(
            error.value
        ) and "\n" not in str(error.value)
        if within:
            assert within.words(unit).split(" (")[0] in str(error.value) or number != number


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed", "--set seed: expected KEY=VALUE, such as wake.texture.rms=0.2"),
        ("=3", "--set =3: expected KEY=VALUE"),
        ("name.first=a", "--set name.first=a: name is a value, not a section"),
        ("seed=[", "--set seed=[: '[' is not a YAML value"),
    ],
)
def test_a_broken_override_is_named(write, override, message):
    with pytest.raises(InputError) as error:
        load(write(), [override])
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no keys; expected name, wake, ..."),
        ("- a\n- b\n", "holds no keys"),
        ("name: [a\nwake: b", "not valid YAML"),
        ("a: b: c", "line 1 not valid YAML (mapping values are not allowed here)"),
        ("name: \x00", "not valid YAML (unacceptable character"),
        ("name: !!python/object:os.system 3", "not valid YAML"),
        ("wake: {file: wake.nc}", "name: missing"),
        ("name: a", "expected wake, doppler or both"),
    ],
)
def test_a_broken_file_is_named(write, text, message):
    path = write(text)
    with pytest.raises(InputError) as error:
        load(path)
    assert str(error.value).startswith(f"{path}:") and message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    for path, message in [
        (tmp_path / "absent.yaml", "No such file or directory; expected an experiment file"),
        (tmp_path, "Is a directory; expected an experiment file"),
        (binary, "not a text file; expected an experiment file"),
    ]:
        with pytest.raises(InputError) as error:
            load(path)
        assert str(error.value) == f"{path}: {message}"


def test_checking_a_dictionary_names_its_origin():
    with pytest.raises(InputError, match=r"^here: expected wake, doppler or both$"):
        check({"name": "a"}, "here")
    assert isinstance(check({"name": "a", "wake": {"file": "b.nc"}}, "here"), Experiment)


def test_a_key_that_is_there_twice_is_a_fault(write):
    """YAML's libraries take the last one silently."""
    path = write("name: a\nwake: {file: a.nc}\nscan: {range: 300 m}\nscan: {thickness: 3 m}\n")
    with pytest.raises(InputError, match=r"line 4 not valid YAML .key 'scan' is there twice"):
        load(path)
    with pytest.raises(InputError, match="is not a YAML value"):
        load(write(), ["scan={range: 300 m, range: 400 m}"])


def test_a_wake_is_no_experiment(tmp_path):
    with pytest.raises(InputError, match=r"wake.nc: a wake, not .* wake: \{file: .*wake.nc\}$"):
        load(tmp_path / "wake.nc")


@pytest.mark.parametrize("name", ["a.png", "a.TIF", "a.exr"])
def test_a_picture_is_called_one(tmp_path, name):
    (tmp_path / name).write_bytes(b"\x89PNG\xff")
    with pytest.raises(InputError, match=r"a picture, not an experiment; .* info .* retrieve"):
        load(tmp_path / name)


def test_a_scene_is_no_experiment(tmp_path):
    with pytest.raises(InputError, match=r"slab\.xml: .*expected lidar-mi render .*slab\.xml"):
        load(tmp_path / "slab.xml")
