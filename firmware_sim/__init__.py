"""The other end of the wire: joint drives with their own firmware rules, a plant in pybullet, a bus, injected faults.

Nothing here shares code with the controller but the kernel's frame layout (`rtctl.protocol.frame`): what the controller
gets wrong must not be got wrong here in the same way.
"""

import rtctl.protocol.frame  # noqa: F401 - before numba: rtctl says where its own compiled code is kept
