"""Plain values, as JSON and TOML have them; it loads nothing, so that the command line may name them."""

from typing import Any, TypeAlias

Json: TypeAlias = dict[str, Any]  # a table whose members depend on its kind
