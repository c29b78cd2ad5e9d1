"""The installed simulator, found through an entry point: the controller never imports it."""

from importlib.metadata import entry_points
from pathlib import Path

from rtctl.errors import ConfigError, RtctlError, UsageError, lacking
from rtctl.spec.scenario import Scenario, scenario_dict
from rtctl.types import Simulator


def open_simulator(config_path: Path, scenario: Scenario, path: str | Path) -> Simulator:
    """Return the installed simulator, playing the scenario of the file `path`.

    Raises ConfigError when none is installed, RtctlError with what it refuses.
    """
    found = {e.name: e for e in entry_points(group="rtctl.simulator")}
    if "pybullet" not in found:
        raise ConfigError("entry point rtctl.simulator", sorted(found) or "none", "one named pybullet: pip install .")
    try:
        play = scenario_dict(scenario, path)
        simulator: Simulator = found["pybullet"].load()(str(config_path), play, seed=scenario.seed)
    except RtctlError:
        raise
    except ModuleNotFoundError as error:
        raise UsageError(lacking(error) or f"simulator: {error}") from None
    except Exception as error:  # another program's refusal: its words, not its traceback
        raise RtctlError(f"simulator: {error}") from error
    return simulator
