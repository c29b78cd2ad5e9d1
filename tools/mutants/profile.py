"""Property tests as they are run for mutants: repeatable, few examples, and none made smaller."""

from typing import Any

from hypothesis import Phase, settings

EXAMPLES = 60


def pytest_collection(session: Any) -> None:
    """Load the profile once the tests' own conftest is there, whose profile it replaces, and before any test is."""
    quick = (Phase.explicit, Phase.generate)
    settings.register_profile(
        "mutants", deadline=None, derandomize=True, database=None, max_examples=EXAMPLES, phases=quick
    )
    settings.load_profile("mutants")
