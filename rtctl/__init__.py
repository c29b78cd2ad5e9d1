"""Reactive torque-level motion control in operational space."""

__version__ = "0.1.0"
