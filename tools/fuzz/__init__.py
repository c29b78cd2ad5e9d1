"""Bytes that others choose, given to whatever takes them."""
