"""Random scenarios over all robots, judged by an oracle: `python -m tools.stress --help`."""
