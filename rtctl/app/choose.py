"""Which vehicle a file or a log describes: the one place that asks for its kind."""

from pathlib import Path

from rtctl.app.vehicle import SomeVehicle
from rtctl.errors import ConfigError
from rtctl.spec.base import is_base


def vehicle_of(path: Path) -> SomeVehicle:
    """Return the vehicle of a robot file. Raises ConfigError for one that is no TOML."""
    return vehicle_named("base" if is_base(path) else "arm")


def vehicle_named(kind: str) -> SomeVehicle:
    """Return the vehicle of a kind: `base`, or else an arm."""
    if kind == "base":
        from rtctl.app.rover import ROVER  # pymavlink is not needed for an arm

        return ROVER
    from rtctl.app.arm import ARM  # nor the arm's model for a base

    return ARM


def refuse_law(vehicle: SomeVehicle, where: Path) -> None:
    """Raise ConfigError for a vehicle that takes no law but its own."""
    if not vehicle.takes_law:
        raise ConfigError(f"{where}: robot.kind", "base", "arm: a law of one's own gives joint torques")
