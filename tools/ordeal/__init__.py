"""An ordeal: a daemon and its drives among kills, stops, vanishing peers, full disks and broken connections."""
