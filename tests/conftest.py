"""What every test shares: repeatable property tests."""

import signal

from hypothesis import settings

# No deadline: compilation and a busy machine are not failures. Derandomised: a red run is red again.
settings.register_profile("rtctl", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("rtctl")

# A shell's background job ignores SIGINT, and so would every program that a test starts and interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
