"""What all descriptions have in common: laser, telescope, scan, etalon, sections of a file."""

from pydantic import BaseModel, ConfigDict


class Description(BaseModel):
    """Keys with their units, defaults and limits: frozen, every key known, no NaN or infinity.

    Defaults are validated, too, so that they may be text with a unit
    (`lidar_mi.units.quantity`).
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False
    )
