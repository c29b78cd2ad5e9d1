"""The problems of MotionBenchMaker, played by the controller: `python -m tools.benchmark --help`."""
