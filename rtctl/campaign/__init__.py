"""Campaigns: many runs on many processes, kept as Parquet, resumed where they stopped, and judged by their rates."""
