"""What every test shares: compiled code that is never stale, and repeatable property tests."""

from hypothesis import settings

import rtctl  # noqa: F401  its import names the kernel cache after the sources, for this process and its children

# No deadline: compilation and a busy machine are not failures. Derandomised: a red run is red again.
settings.register_profile("rtctl", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("rtctl")
