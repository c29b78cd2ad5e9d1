"""Long runs: rate, memory, descriptors, segments, queues; see `__main__`."""
