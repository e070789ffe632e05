"""The public names: what ``import lidar_mi as lm`` offers, and where each is made."""

from .aircraft.pose import AircraftPose
from .campaign.collect import open_campaign
from .campaign.engine import run_campaign
from .encounter.control_block.export import export_control
from .encounter.fly import Flights, fly
from .encounter.jsbsim_in_air import JSBSimInAir
from .encounter.lidar.virtual_lidar import VirtualLidar
from .errors import InputError
from .experiment.export import export
from .experiment.image_files import retrieve_files
from .experiment.results import Run
from .experiment.ring_frames import calibrate_etalon, retrieve_v_los
from .experiment.run import run
from .experiment.truth.extinction import make_truth
from .flags import Flag
from .io.exr import read_scan
from .io.images import read_image, read_noise
from .io.lines_of_sight.cfradial import write_cfradial
from .io.lines_of_sight.read import read_lines_of_sight
from .io.vortex_file import read_vortices, write_vortices
from .plugins import register_plugins
from .rendering.labelled import to_xarray
from .rendering.variant import use_variant
from .retrieval.ground_vortices.vortices import fit_vortices_to_lines
from .retrieval.ground_winds.winds import fit_winds_to_lines
from .retrieval.images.common_grid import on_one_grid
from .retrieval.rings.analysis import Rings, analyse_rings
from .retrieval.rings.calibration import Calibration
from .retrieval.rings.gap import Gap, gap_from_fractions, gap_from_lines
from .retrieval.vortices.image_fit import fit_vortices
from .retrieval.vortices.pair import VortexPairFit
from .retrieval.vortices.vector_fit import fit_vortices_to_wind
from .retrieval.wind.options import VectorValidation, WindowSizes
from .retrieval.wind.pair import retrieve_wind
from .retrieval.wind.series import retrieve_winds
from .retrieval.wind.standard_errors import standard_errors
from .retrieval.wind.volume import retrieve_wind_volume
from .schema.experiment import Experiment
from .schema.reading import load_experiment
from .schema.shipped import campaigns, experiments, scene_file
from .system.doctor import doctor

__version__: str

__all__ = [
    "AircraftPose",
    "Calibration",
    "Experiment",
    "Flag",
    "Flights",
    "Gap",
    "InputError",
    "JSBSimInAir",
    "Rings",
    "Run",
    "VectorValidation",
    "VirtualLidar",
    "VortexPairFit",
    "WindowSizes",
    "__version__",
    "analyse_rings",
    "calibrate_etalon",
    "campaigns",
    "doctor",
    "experiments",
    "export",
    "export_control",
    "fit_vortices",
    "fit_vortices_to_lines",
    "fit_vortices_to_wind",
    "fit_winds_to_lines",
    "fly",
    "gap_from_fractions",
    "gap_from_lines",
    "load_experiment",
    "make_truth",
    "on_one_grid",
    "open_campaign",
    "read_image",
    "read_lines_of_sight",
    "read_noise",
    "read_scan",
    "read_vortices",
    "register_plugins",
    "retrieve_files",
    "retrieve_v_los",
    "retrieve_wind",
    "retrieve_wind_volume",
    "retrieve_winds",
    "run",
    "run_campaign",
    "scene_file",
    "standard_errors",
    "to_xarray",
    "use_variant",
    "write_cfradial",
    "write_vortices",
]
