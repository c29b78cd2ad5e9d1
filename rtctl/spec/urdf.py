"""Where a URDF and its meshes are."""

import os
import sys
from pathlib import Path

from rtctl.errors import ConfigError


def share_folders() -> list[Path]:
    """Return the folders that packages of robot descriptions are looked for in: installed ones, then ROS's."""
    installed = [Path(entry) / "cmeel.prefix" / "share" for entry in sys.path if entry]
    ros = [Path(entry) for entry in os.environ.get("ROS_PACKAGE_PATH", "").split(":") if entry]
    return [folder for folder in (*installed, *ros) if folder.is_dir()]


def urdf_file(urdf: str, config: Path) -> Path:
    """Return the file that `robot.urdf` of the config file names.

    `package://NAME/path` is looked for in the installed packages, anything else relative to the config file.
    Raises ConfigError.
    """
    place = f"{config}: robot.urdf"
    if not urdf.startswith("package://"):
        path = config.resolve().parent / urdf
        if not path.is_file():
            raise ConfigError(place, urdf, f"a URDF file; {path} is none")
        return path
    inside = urdf.removeprefix("package://")
    folders = share_folders()
    found = next((folder / inside for folder in folders if (folder / inside).is_file()), None)
    if found is None:
        package = inside.partition("/")[0]
        known = any((folder / package).is_dir() for folder in folders)
        raise ConfigError(place, urdf, "a file of that package" if known else f"the package {package} installed")
    return found


def package_folders(urdf: Path) -> list[Path]:
    """Return what package:// inside the URDF resolves against: the shares, then the folders above the URDF."""
    return [*share_folders(), *list(urdf.parents)[:4]]
