"""Total variation on a GPU: the plain form, which torch runs there."""

from .reference import total_variation

__all__ = ["total_variation"]
