"""What comes with the program: robots, scenarios, schemas, layouts and units; beside the source, or in the wheel."""

from pathlib import Path

PLACES = ("", "scenarios", "worlds")


def shipped() -> Path:
    """Return the folder of what comes with the program."""
    source = Path(__file__).parents[2] / "configs"
    return source if (source / "demo.toml").is_file() else Path(__file__).parents[1] / "share" / "configs"


def scenario_file(name: str) -> str:
    """Return the file that is meant: `name` itself, or where no such file is, the shipped scenario of that name."""
    if Path(name).exists() or Path(name).name != name or name.endswith(".toml"):
        return name
    found = (shipped() / place / f"{name}.toml" for place in PLACES)
    return next((str(path) for path in found if path.is_file()), name)
