"""The nearest valid name, for a mistake in spelling."""

import difflib
from collections.abc import Iterable

SHOWN = 24  # names listed where none is near


def nearest(name: str, known: Iterable[str], listed: int = SHOWN) -> str:
    """Return the names that look like `name` as what is wanted, or all there are, the first `listed` of them."""
    names = list(known)
    close = close_to(name, names)
    if close:
        return f"{close} (the nearest valid name)"
    more = f" and {len(names) - listed} more" if len(names) > listed else ""
    return f"one of {', '.join(names[:listed])}{more}"


def close_to(name: str, known: Iterable[str]) -> str:
    """Return the known name that looks most like `name`, '' for none; letter case counts little."""
    by_lower = {each.lower(): each for each in known}
    found = difflib.get_close_matches(name.lower(), list(by_lower), n=1, cutoff=0.6)
    return by_lower[found[0]] if found else ""
